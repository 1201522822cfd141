"""Can the ports alone explain what the rig file and the images disagree about?

A ruler's distance is some centimetres off, a port tilts by ten degrees: the images of
two cameras then turn and stretch against each other as if lens or placement were wrong.
The adjustment will find such ports; a rig is not to be refused for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.models.ports.port import DomePort, PlanePort, Port, behind_camera
from uwsfm.models.ports.row import DISTANCE
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.poses.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches
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
MAX_DISTANCE_SHARE = 0.5
"""Of what its kind may have: a quarter of a metre, of a flat port."""
MAX_BEHIND_M = 0.01
"""A distance may come out below zero, its bound, by what noise does to it."""
MAX_MISFIT = 1e-3
"""Radians, median over all matches: half a pixel, noise and wrong matches included."""
MAX_STRAIN = 2.5
"""Two ports that both tilt by 12 degrees, and are a hand's breadth from the ruler's
distance: more is another mistake."""
NEARLY_ALL = 0.8
"""Of the matches, 15 % of which may be wrong and lie anywhere."""
MIN_SHARE = 0.25
"""Of the matches must have points in front of both cameras to begin with: ports that
tilt away from each other make far points meet behind them."""
FEW_IN_FRONT = 0.9
BEGINNINGS_DEG = (-10.0, -5.0, 5.0, 10.0)
"""Of each port, along the baseline: the rays of two that lean by ten degrees away from
each other are turned by five."""
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
    in_front: float
    """Share of the points that lie in front of both then."""

    @property
    def explain(self) -> bool:
        """Whether the two cameras fit their matches with them."""
        return self.misfit <= MAX_MISFIT

    @property
    def are_likely(self) -> bool:
        """Whether they do so for nearly all matches, and are ports as housings have."""
        return (
            self.typical <= MAX_MISFIT
            and self.in_front >= NEARLY_ALL
            and self.strain <= MAX_STRAIN
        )


def typical_angle(angles: Array) -> float:
    """The larger of two estimates of the median size of angles (N,): itself, and by the
    fourth quintile of normal ones. A mistake in less than half of the frames leaves the
    median as it is. NaN counts as far off."""
    sizes = np.nan_to_num(np.abs(angles), nan=np.pi)
    return float(max(np.median(sizes), np.quantile(sizes, 0.8) / QUINTILE))


def moved_ports(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, *, leaning: bool = False
) -> MovedPorts | None:
    """Move the ports of two cameras until they fit their matches best.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras, which stay.
        pair: Matches of two of them, of the same frames.
        leaning: Where few points lie in front of both, begin with ports that lean
            against each other as well: rays that diverge have no points.

    Returns:
        None: too few points are in front of both, or no housing has such ports.
    """
    best: MovedPorts | None = None
    for scene, given in _beginnings(rig, cam_from_rig, pair, leaning):
        found = _moved(scene, given, pair)
        if found is not None and (best is None or found.typical < best.typical):
            best = found
        if best is not None and best.are_likely:
            break
    return best


def _moved(scene: Scene, given: Scene, pair: PairMatches) -> MovedPorts | None:
    """From one beginning; ``given`` has the ports as given."""
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
        border_priors(given, settings, columns, 1.0),
    ).state
    ports = state.ports.copy()
    behind = behind_camera(ports)
    if np.any(ports[behind, DISTANCE] < -MAX_BEHIND_M):
        return None
    ports[behind, DISTANCE] = 0.0
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
        for before, after in zip(given.ports, found.ports, strict=True)
    ]
    return MovedPorts(
        misfit=float(np.median(angles)),
        typical=typical_angle(angles),
        strain=float(np.linalg.norm(moves)),
        in_front=float(np.mean(rays.triangulate()[1])),
    )


def _moves(before: Port, after: Port) -> float:
    """How far one port moved, in standard deviations of `FREEDOM`."""
    if isinstance(before, PlanePort) and isinstance(after, PlanePort):
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
    if isinstance(port, PlanePort):
        tilt = np.degrees(np.arccos(np.clip(port.normal[2], -1.0, 1.0)))
        most = MAX_DISTANCE_SHARE * port.max_distance_m
        return bool(tilt <= MAX_TILT_DEG and 0.0 <= port.distance <= most)
    if isinstance(port, DomePort):
        return float(np.linalg.norm(port.center)) < port.radius
    return True


def _beginnings(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, leaning: bool
) -> Iterator[tuple[Scene, Scene]]:
    """Two cameras and their matches to move the ports of, and the same as given."""
    both = rig.refractive_cameras()
    cameras = both[pair.camera_a], both[pair.camera_b]
    b_from_a = relative_pose(cam_from_rig, pair.camera_a, pair.camera_b)
    count = len(pair.xy_a[:: _step(pair)])
    scene = _one_frame(cameras, b_from_a, pair)
    scenes = [scene]
    if leaning and scene.num_points < FEW_IN_FRONT * count:
        tilted = (_tilted(cameras, b_from_a, angle) for angle in BEGINNINGS_DEG)
        scenes += [_one_frame(each, b_from_a, pair) for each in tilted]
    scenes.sort(key=lambda one: -one.num_points)
    for each in scenes:
        if each.num_points >= MIN_SHARE * count:
            yield each, replace(each, cameras=cameras)


def _tilted(
    cameras: tuple[RefractiveCamera, RefractiveCamera],
    b_from_a: Array,
    angle_deg: float,
) -> tuple[RefractiveCamera, RefractiveCamera]:
    """Flat ports that lean along the baseline, by opposite angles."""
    along = rigid3.inverse(b_from_a)[4:].copy()
    along[2] = 0.0
    along /= max(float(np.linalg.norm(along)), 1e-12)
    first, second = (
        camera.with_port(_leaning(camera.port, sign * math.radians(angle_deg) * along))
        for camera, sign in zip(cameras, (1.0, -1.0), strict=True)
    )
    return first, second


def _leaning(port: Port, by: Array) -> Port:
    if not isinstance(port, PlanePort):
        return port
    x, y, z = (np.asarray(port.normal) + by).tolist()
    length = math.sqrt(x * x + y * y + z * z)
    return port.changed(normal=(x / length, y / length, z / length))


def _one_frame(
    cameras: tuple[RefractiveCamera, RefractiveCamera],
    b_from_a: Array,
    pair: PairMatches,
) -> Scene:
    """Two cameras and their matches, all as if of one frame: a pose moves nothing.
    Only points in front of both are kept."""
    step = _step(pair)
    xy_a, xy_b = pair.xy_a[::step], pair.xy_b[::step]
    num = len(xy_a)
    scene = Scene(
        cameras=cameras,
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
