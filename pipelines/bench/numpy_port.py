"""The flat port in plain numpy, vectorised over the points: what one writes first."""

import numpy as np

from uwsfm.geometry.rigid3 import Array, rotmat_from_quat
from uwsfm.models.ports.port import FlatPort
from uwsfm.scene import Scene

MAX_STEPS = 50
TOLERANCE = 1e-13
"""Metres that the ray may miss the point by."""


def unproject(xy: Array, pinhole: Array, port: FlatPort) -> tuple[Array, Array]:
    """Water rays of pixels (N, 2): origins and unit directions (N, 3) each."""
    fx, fy, cx, cy = pinhole
    dirs = np.column_stack(
        [(xy[:, 0] - cx) / fx, (xy[:, 1] - cy) / fy, np.ones(len(xy))]
    )
    dirs /= np.linalg.norm(dirs, axis=1)[:, None]
    normal = np.asarray(port.normal)
    origins = port.distance / (dirs @ normal)[:, None] * dirs
    dirs = _refract(dirs, normal, port.n_air / port.n_glass)
    origins += port.thickness / (dirs @ normal)[:, None] * dirs
    return origins, _refract(dirs, normal, port.n_glass / port.n_water)


def _refract(dirs: Array, normal: Array, mu: float) -> Array:
    cosine = dirs @ normal
    root = np.sqrt(1.0 - mu**2 * (1.0 - cosine**2))
    return mu * dirs + (root - mu * cosine)[:, None] * normal


def _air_rays(points: Array, port: FlatPort) -> tuple[Array, ...]:
    """Of points (N, 3): depth along the normal, unit vector across it, distance across,
    tangent of the angle in air, and the derivatives of the miss."""
    normal = np.asarray(port.normal)
    depth = points @ normal
    across = points - depth[:, None] * normal
    reach = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    glass, water = port.n_glass / port.n_air, port.n_water / port.n_air
    in_water = depth - port.distance - port.thickness
    # The reach is concave in the tangent: Newton's steps come to the root from below.
    tangent = reach / (port.distance + port.thickness / glass + in_water / water)
    for _ in range(MAX_STEPS):
        sine = tangent / np.sqrt(1.0 + tangent**2)
        g, w = glass**2 - sine**2, water**2 - sine**2
        miss = sine * (port.thickness / np.sqrt(g) + in_water / np.sqrt(w))
        miss += port.distance * tangent - reach
        slope = port.thickness * glass**2 / g**1.5 + in_water * water**2 / w**1.5
        slope = port.distance + slope * (1.0 + tangent**2) ** -1.5
        if np.max(np.abs(miss)) < TOLERANCE:
            break
        tangent -= miss / slope
    by_depth = sine / np.sqrt(water**2 - sine**2)
    return normal, across / reach[:, None], reach, tangent, slope, by_depth


def project(points: Array, pinhole: Array, port: FlatPort) -> Array:
    """Pixels (N, 2) of points (N, 3)."""
    normal, across, _, tangent, _, _ = _air_rays(points, port)
    v = normal + tangent[:, None] * across
    return pinhole[:2] * v[:, :2] / v[:, 2:] + pinhole[2:]


def project_with_jac(
    points: Array, pinhole: Array, port: FlatPort
) -> tuple[Array, Array]:
    """Pixels (N, 2), and their derivative by the point alone (N, 2, 3)."""
    normal, across, reach, tangent, slope, by_depth = _air_rays(points, port)
    v = normal + tangent[:, None] * across
    flat = np.eye(3) - np.outer(normal, normal)
    turn = (tangent / reach)[:, None, None] * (
        flat - across[:, :, None] * across[:, None, :]
    )
    bend = (across - by_depth[:, None] * normal) / slope[:, None]
    by_point = turn + across[:, :, None] * bend[:, None, :]
    uv = v[:, :2] / v[:, 2:]
    rows = by_point[:, :2] - uv[:, :, None] * by_point[:, 2:]
    jac = pinhole[:2, None] * rows / v[:, 2, None, None]
    return pinhole[:2] * uv + pinhole[2:], jac


def cost(scene: Scene) -> float:
    """0.5 sum |residual|^2 of a scene of pinholes behind flat ports, px^2."""
    turns = rotmat_from_quat(scene.rig_from_world[:, :4])[scene.frame_idx]
    in_rig = np.einsum("nij,nj->ni", turns, scene.points[scene.point_idx])
    in_rig += scene.rig_from_world[scene.frame_idx, 4:]
    total = 0.0
    for c, camera in enumerate(scene.cameras):
        rows = scene.camera_idx == c
        pose = scene.cam_from_rig[c]
        in_cam = in_rig[rows] @ rotmat_from_quat(pose[:4]).T + pose[4:]
        xy = project(in_cam, camera.lens[:4], camera.port)
        total += 0.5 * float(np.sum((xy - scene.xy[rows]) ** 2))
    return total
