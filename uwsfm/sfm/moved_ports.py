"""Can the ports alone explain what the rig file and the images disagree about?

A ruler's distance is some centimetres off, a port tilts by ten degrees: the images of
two cameras then turn and stretch against each other as if lens or placement were wrong.
The adjustment will find such ports; a rig is not to be refused for them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.models.port import FLAT, KIND, DomePort, FlatPort, Port
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.same_frame import PairMatches
from uwsfm.solver.layout import build_layout
from uwsfm.solver.levenberg_marquardt import LevenbergMarquardtOptions, minimize
from uwsfm.solver.state import State

NUM_MATCHES = 600
FREEDOM = {
    "refine_cam_from_rig": False,
    "normal_stddev_deg": 8.0,
    "distance_stddev_m": 0.05,
    "center_stddev_m": 0.01,
}
"""How far ports are from what a person writes down, about."""
MAX_TILT_DEG = 15.0
MAX_DISTANCE_M = 0.25
MAX_BEHIND_M = 0.01
"""A distance may come out below zero, its bound, by what noise does to it."""
MAX_MISFIT = 1e-3
"""Radians, median over all matches: half a pixel, noise and wrong matches included."""
LOSS_PX = 3.0
QUINTILE = 1.9
"""Fourth quintile over median of |x| for normal x."""


@dataclass(frozen=True, kw_only=True)
class MovedPorts:
    """Two cameras whose ports were moved until they fit their matches best."""

    misfit: float
    """Median angle between rays and their epipolar plane, radians."""
    typical: float
    """`typical_angle` of the same, radians."""
    strain: float
    """How far the ports moved, in the standard deviations of `FREEDOM`, all together:
    root of the sum of squares."""


def typical_angle(angles: Array) -> float:
    """The larger of two estimates of the median size of angles (N,): itself, and by the
    fourth quintile of normal ones. A mistake in less than half of the frames leaves the
    median as it is. NaN counts as far off."""
    sizes = np.nan_to_num(np.abs(angles), nan=np.pi)
    return float(max(np.median(sizes), np.quantile(sizes, 0.8) / QUINTILE))


def ports_explain(rig: Rig, cam_from_rig: Array, pair: PairMatches) -> bool:
    """Whether ports that moved and tilted make two cameras fit their matches.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras.
        pair: Matches of two of them, of the same frames.
    """
    moved = moved_ports(rig, cam_from_rig, pair)
    return moved is not None and moved.misfit <= MAX_MISFIT


def moved_ports(rig: Rig, cam_from_rig: Array, pair: PairMatches) -> MovedPorts | None:
    """Move the ports of two cameras until they fit their matches best.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras, which stay.
        pair: Matches of two of them, of the same frames.

    Returns:
        None: too few points are in front of both, or no housing has such ports.
    """
    scene = _one_frame(rig, cam_from_rig, pair)
    if scene.num_points < len(pair.xy_a[:: _step(pair)]) // 2:
        return None
    settings = CalibrateOptions.parsed(FREEDOM)
    columns = settings.border_columns(scene.cameras, np.zeros(2, dtype=bool))
    options = LevenbergMarquardtOptions(
        loss="cauchy",
        loss_scale_px=LOSS_PX,
        max_iterations=30,
        initial_damping=1e-2,
        min_relative_decrease=1e-4,
    )
    state = minimize(
        build_layout(scene, columns),
        State.from_scene(scene),
        options,
        border_priors(scene, settings, columns, 1.0),
    ).state
    ports = state.ports.copy()
    behind = (ports[:, KIND] == FLAT) & (ports[:, 3] < 0.0)
    if np.any(ports[behind, 3] < -MAX_BEHIND_M):
        return None
    ports[behind, 3] = 0.0
    try:
        found = replace(state, ports=ports).to_scene(scene)
    except InputError:  # a dome in front of its lens, a normal that points inwards
        return None
    if not all(_possible(port) for port in found.ports):
        return None
    step, (first, second) = _step(pair), found.cameras
    xy_a, xy_b = pair.xy_a[::step], pair.xy_b[::step]
    rays = ray_pairs(first, second, found.cam_from_rig[1], xy_a, xy_b)
    angles = np.nan_to_num(np.abs(rays.epipolar_angles()), nan=np.pi)
    moves = [
        _moves(before, after)
        for before, after in zip(scene.ports, found.ports, strict=True)
    ]
    return MovedPorts(
        misfit=float(np.median(angles)),
        typical=typical_angle(angles),
        strain=float(np.linalg.norm(moves)),
    )


def _moves(before: Port, after: Port) -> float:
    """How far one port moved, in standard deviations of `FREEDOM`."""
    if isinstance(before, FlatPort) and isinstance(after, FlatPort):
        tilt = np.degrees(angle_between(before.normal, after.normal))
        along = after.distance - before.distance
        return math.hypot(
            float(tilt) / FREEDOM["normal_stddev_deg"],
            along / FREEDOM["distance_stddev_m"],
        )
    if isinstance(before, DomePort) and isinstance(after, DomePort):
        step = np.subtract(after.center, before.center)
        return float(np.linalg.norm(step)) / FREEDOM["center_stddev_m"]
    return 0.0


def _step(pair: PairMatches) -> int:
    return -(-len(pair) // NUM_MATCHES)


def _possible(port: object) -> bool:
    if isinstance(port, FlatPort):
        tilt = np.degrees(np.arccos(np.clip(port.normal[2], -1.0, 1.0)))
        return bool(tilt <= MAX_TILT_DEG and 0.0 <= port.distance <= MAX_DISTANCE_M)
    if isinstance(port, DomePort):
        return float(np.linalg.norm(port.center)) < port.radius
    return True


def _one_frame(rig: Rig, cam_from_rig: Array, pair: PairMatches) -> Scene:
    """Two cameras and their matches, all as if of one frame: a pose moves nothing.
    Only points in front of both are kept."""
    both = rig.refractive_cameras()
    step = _step(pair)
    xy_a, xy_b = pair.xy_a[::step], pair.xy_b[::step]
    num = len(xy_a)
    b_from_a = relative_pose(cam_from_rig, pair.camera_a, pair.camera_b)
    scene = Scene(
        cameras=(both[pair.camera_a], both[pair.camera_b]),
        cam_from_rig=np.stack([rigid3.IDENTITY, b_from_a]),
        rig_from_world=rigid3.IDENTITY[None],
        points=np.empty((num, 3)),
        camera_idx=np.repeat(np.arange(2), num),
        frame_idx=np.zeros(2 * num, dtype=np.int64),
        point_idx=np.tile(np.arange(num), 2),
        xy=np.concatenate([xy_a, xy_b]),
    )
    origins, dirs = scene.water_rays()
    points = triangulate_tracks(origins, dirs, scene.point_idx, num)
    scene = replace(scene, points=points)
    seen = np.isfinite(scene.residuals()).all(axis=1).reshape(2, -1).all(axis=0)
    return scene.select(np.tile(seen, 2))[0]
