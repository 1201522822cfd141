"""Random cameras behind ports, and matches of them with known truth.

The protocol of Refractive COLMAP (She et al., IROS 2024): pixels anywhere in the
image, points along their water rays, Gaussian noise, and wrong matches that are 200 px
off. Lengths in metres.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap

from uwsfm import DomePort, FlatPort, RefractiveCamera
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array

SIZE = np.array([1920.0, 1080.0])
FOCAL_PX = 1297.37
NUM_MATCHES = 200
WRONG = 0.3
WRONG_STDDEV_PX = 200.0
N_GLASS, N_WATER = 1.52, 1.334
PORTS = ("flat", "dome")


@dataclass(frozen=True)
class AbsoluteTrial:
    camera: RefractiveCamera
    xy: Array
    points: Array
    cam_from_world: Array
    right: Array
    depths: Array
    """(3,) percentiles 10, 50 and 90 of depth: what the pinhole is told."""


@dataclass(frozen=True)
class RelativeTrial:
    camera: RefractiveCamera
    xy_a: Array
    xy_b: Array
    b_from_a: Array
    right: Array
    depths: Array


def random_camera(port: str, rng: np.random.Generator) -> RefractiveCamera:
    lens = pycolmap.Camera(
        model="PINHOLE",
        width=int(SIZE[0]),
        height=int(SIZE[1]),
        params=[FOCAL_PX, FOCAL_PX, *(0.5 * SIZE)],
    )
    if port == "dome":
        centre = rng.uniform(-1.0, 1.0, 3) * [0.01, 0.01, 0.03]
        radius, thickness = rng.uniform(0.05, 0.07), rng.uniform(0.005, 0.02)
        window = DomePort(tuple(centre), radius, thickness, N_GLASS, N_WATER)
        return RefractiveCamera(lens, window)
    normal = np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.8, 1.2)])
    normal /= np.linalg.norm(normal)
    distance, thickness = rng.uniform(0.001, 0.05), rng.uniform(0.002, 0.2)
    return RefractiveCamera(
        lens, FlatPort(tuple(normal), distance, thickness, N_GLASS, N_WATER)
    )


def absolute_trial(port: str, noise_px: float, seed: int) -> AbsoluteTrial:
    """200 points 0.5 to 10 m from the camera, which is anywhere, turned anyhow."""
    rng = np.random.default_rng([PORTS.index(port), seed])
    camera = random_camera(port, rng)
    xy = rng.uniform(0.5, SIZE - 0.5, (NUM_MATCHES, 2))
    origins, dirs = camera.ray_from_img(xy)
    in_cam = _at_distance(origins, dirs, rng.uniform(0.5, 10.0, NUM_MATCHES))
    pose = np.concatenate(
        [rigid3.quat_from_rotvec(rng.normal(size=3)), rng.uniform(0.0, 1.0, 3)]
    )
    right = _mostly_right()
    return AbsoluteTrial(
        camera=camera,
        xy=_observed(xy, right, noise_px, rng),
        points=rigid3.transform(rigid3.inverse(pose), in_cam),
        cam_from_world=pose,
        right=right,
        depths=np.percentile(in_cam[:, 2], [10, 50, 90]),
    )


def _at_distance(origins: Array, dirs: Array, distances: Array) -> Array:
    """Points (N, 3) on rays, so far from the camera (Sedlazeck & Koch 2011, eq. 5)."""
    along = np.einsum("ni,ni->n", origins, dirs)
    gap = distances**2 - np.einsum("ni,ni->n", origins, origins)
    return origins + (np.sqrt(along**2 + gap) - along)[:, None] * dirs


def relative_trial(port: str, noise_px: float, seed: int) -> RelativeTrial:
    """Two views 8 to 10 m apart of points at 6 to 8 m, both turned to the scene."""
    rng = np.random.default_rng([10 + PORTS.index(port), seed])
    camera = random_camera(port, rng)
    pose = _second_view(rng)
    found: list[tuple[Array, Array, Array]] = []
    while sum(len(xy) for xy, _, _ in found) < NUM_MATCHES:
        xy = rng.uniform(0.5, SIZE - 0.5, (1000, 2))
        origins, dirs = camera.ray_from_img(xy)
        in_a = origins + rng.uniform(6.0, 8.0, (len(xy), 1)) * dirs
        seen, valid = camera.img_from_point(rigid3.transform(pose, in_a))
        with np.errstate(invalid="ignore"):
            valid &= ((seen > 0.0) & (seen < SIZE)).all(axis=1)
        found.append((xy[valid], seen[valid], in_a[valid, 2]))
    xy_a, xy_b, depths = (
        np.concatenate(parts)[:NUM_MATCHES] for parts in zip(*found, strict=True)
    )
    right = _mostly_right()
    return RelativeTrial(
        camera=camera,
        xy_a=_observed(xy_a, right, noise_px, rng),
        xy_b=_observed(xy_b, right, noise_px, rng),
        b_from_a=pose,
        right=right,
        depths=np.percentile(depths, [10, 50, 90]),
    )


def _second_view(rng: np.random.Generator) -> Array:
    """Pose (7,) of a camera to the side that looks at a point straight ahead."""
    centre = np.array([rng.uniform(8.0, 10.0), *rng.uniform(-2.5, 2.5, 2)])
    forward = np.array([0.0, 0.0, rng.uniform(6.0, 8.0)]) - centre
    forward /= np.linalg.norm(forward)
    aside = np.cross(forward, [0.0, -1.0, 0.0])
    aside /= np.linalg.norm(aside)
    rotmat = np.stack([aside, np.cross(forward, aside), forward])
    return rigid3.from_rotmat(rotmat, -rotmat @ centre)


def _mostly_right() -> Array:
    return np.arange(NUM_MATCHES) < round((1.0 - WRONG) * NUM_MATCHES)


def _observed(
    xy: Array, right: Array, noise_px: float, rng: np.random.Generator
) -> Array:
    # The same draws at each level: levels differ by the noise alone.
    noise = rng.standard_normal(xy.shape)
    return xy + np.where(right, noise_px, WRONG_STDDEV_PX)[:, None] * noise
