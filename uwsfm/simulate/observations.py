"""Observations of a simulated dive, with the truth they came from.

Points lie on a `Relief`; every camera of the rig sees those it could see through its
port; Gaussian noise and outliers are added to the exact projections.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.simulate.footprints import footprints
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rigs import known_cam_from_rig

MAX_ROUNDS = 50
FRAMES_AT_ONCE = 200


@dataclass(frozen=True, kw_only=True)
class ObservationOptions:
    """How points are seen. Lengths in metres.

    Raises:
        InputError: a value out of its range.
    """

    num_points: int = 800
    """Points with at least ``min_observations``; the others are not kept."""
    noise_px: float = 0.0
    """Standard deviation per image coordinate; 0.3-0.5 is typical of SIFT."""
    outlier_ratio: float = 0.0
    """Fraction of the observations moved anywhere in their image."""
    detection_rate: float = 1.0
    """Chance that a visible point is observed: features do not repeat everywhere."""
    min_observations: int = 2
    """One stereo pair is enough to triangulate."""
    max_range: float = 10.0
    """From the camera to the point; beyond it the water hides everything."""
    max_incidence_deg: float = 75.0
    """Between the floor's normal and the line of sight; features do not match beyond,
    and within it a smooth relief hides next to nothing behind itself."""
    seed: int = 0

    def __post_init__(self) -> None:
        ranges = {
            "num_points": (1, np.inf),
            "noise_px": (0.0, 100.0),
            "outlier_ratio": (0.0, 1.0),
            "detection_rate": (1e-9, 1.0),
            "min_observations": (1, np.inf),
            "max_range": (1e-9, np.inf),
            "max_incidence_deg": (1e-9, 90.0),
            "seed": (0, np.inf),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(
                    f"{name} must be between {low:g} and {high:g}, "
                    f"got {getattr(self, name)}"
                )


@dataclass(frozen=True, kw_only=True)
class SimulatedScene:
    """What the program would be given, and the truth it should return."""

    scene: Scene
    """True parameters and points; observations with noise and outliers."""
    truth: Scene
    """The same, with the exact projections: observation i is observation i."""
    is_outlier: NDArray[np.bool_]
    """(N,) observations that were moved anywhere."""


def simulate_scene(
    rig: Rig,
    rig_from_world: ArrayLike,
    relief: Relief | None = None,
    options: ObservationOptions | None = None,
) -> SimulatedScene:
    """Observe random points of a sea floor with a rig.

    Args:
        rig: The true rig; its ``cam_from_rig`` must be known.
        rig_from_world: Poses (F, 7), for instance from `uwsfm.simulate.trajectories`.
        relief: The sea floor; flat by default.
        options: How points are seen.

    Returns:
        The scene, with observations ordered by point, then frame, then camera.

    Raises:
        InputError: poses that are not finite.
        UwsfmError: the rig sees too little of the floor to find the points asked for.
    """
    relief, options = relief or Relief(), options or ObservationOptions()
    rng = np.random.default_rng(options.seed)
    rig_from_world = np.asarray(rig_from_world, dtype=np.float64)  # (F, 7)
    if not np.all(np.isfinite(rig_from_world)):
        raise InputError("rig_from_world has poses that are not finite")
    dive = _Dive(
        rig.refractive_cameras(),
        known_cam_from_rig(rig),
        rig_from_world,
        relief,
        footprints(
            rig,
            rig_from_world,
            half_depth=3.0 * relief.stddev,
            max_range=options.max_range,
        ),
        options.max_range,
        float(np.cos(np.radians(options.max_incidence_deg))),
    )
    points, table = _draw_points(dive, options, rng)
    truth = Scene.from_arrays(
        cameras=dive.cameras,
        cam_from_rig=dive.cam_from_rig,
        rig_from_world=rig_from_world,
        points=points,
        camera_idx=table[:, 2].astype(np.int64),
        frame_idx=table[:, 1].astype(np.int64),
        point_idx=table[:, 0].astype(np.int64),
        xy=table[:, 3:],
    )
    return _with_noise(truth, options, rng)


@dataclass(frozen=True)
class _Dive:
    cameras: tuple[RefractiveCamera, ...]
    cam_from_rig: Array
    rig_from_world: Array
    relief: Relief
    boxes: Array  # (F, C, 2, 2), see footprints
    max_range: float
    min_cos: float


def _draw_points(
    dive: _Dive, options: ObservationOptions, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Points (P, 3), and their observations (N, 5): point, frame, camera, x, y."""
    low = dive.boxes[..., 0, :].min(axis=(0, 1))
    high = dive.boxes[..., 1, :].max(axis=(0, 1))
    points: list[Array] = []
    rows: list[Array] = []
    num_points = 0
    for _ in range(MAX_ROUNDS):
        xy = rng.uniform(low, high, size=(options.num_points, 2))
        seen = _observe(dive, xy)
        if options.detection_rate < 1.0:
            seen = seen[rng.uniform(size=len(seen)) < options.detection_rate]
        point_idx = seen[:, 0].astype(np.int64)
        counts = np.bincount(point_idx, minlength=len(xy))
        kept = np.flatnonzero(counts >= options.min_observations)
        kept = kept[: options.num_points - num_points]
        new_idx = np.full(len(xy), -1)
        new_idx[kept] = num_points + np.arange(len(kept))
        seen[:, 0] = new_idx[point_idx]
        points.append(dive.relief.points(xy[kept]))
        rows.append(seen[seen[:, 0] >= 0])
        num_points += len(kept)
        if num_points == options.num_points:
            table = np.concatenate(rows)
            order = np.lexsort((table[:, 2], table[:, 1], table[:, 0]))
            return np.concatenate(points), table[order]
    raise UwsfmError(
        f"only {num_points} of {options.num_points} points are seen at least "
        f"{options.min_observations} times: does the rig look at the sea floor?"
    )


def _observe(dive: _Dive, xy_in_world: Array) -> Array:
    """Rows (n, 5) [point, frame, camera, x, y] of what is visible of the floor."""
    points = dive.relief.points(xy_in_world)
    normals = dive.relief.normals(xy_in_world)
    by_x = np.argsort(xy_in_world[:, 0], kind="stable")
    sorted_xy = xy_in_world[by_x]
    rows = []
    for first in range(0, len(dive.rig_from_world), FRAMES_AT_ONCE):
        frames = range(first, min(first + FRAMES_AT_ONCE, len(dive.rig_from_world)))
        block = []
        for c in range(len(dive.cameras)):
            near = [_inside(sorted_xy, dive.boxes[f, c]) for f in frames]
            candidate = by_x[np.concatenate(near)]
            frame = np.repeat(frames, [len(part) for part in near])
            xy, seen = _views(dive, frame, c, points[candidate], normals[candidate])
            frame, camera = frame[seen], np.full(np.count_nonzero(seen), c)
            block.append(np.column_stack([candidate[seen], frame, camera, xy[seen]]))
        table = np.concatenate(block)
        rows.append(table[np.lexsort((table[:, 0], table[:, 2], table[:, 1]))])
    return np.concatenate(rows)


def _inside(sorted_xy: Array, box: Array) -> IndexArray:
    """Indices of the rows (n, 2), which rise in x, within a box [low, high]."""
    first, last = np.searchsorted(sorted_xy[:, 0], box[:, 0])
    y = sorted_xy[first:last, 1]
    return first + np.flatnonzero((y >= box[0, 1]) & (y <= box[1, 1]))


def _views(
    dive: _Dive, frame: IndexArray, camera_idx: int, points: Array, normals: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (n, 2) of points (n, 3) in as many frames, and whether they are seen."""
    camera = dive.cameras[camera_idx]
    cams_from_world = rigid3.compose(dive.cam_from_rig[camera_idx], dive.rig_from_world)
    cam_from_world = cams_from_world[frame]
    in_cam = rigid3.transform(cam_from_world, points)
    ranges = np.linalg.norm(in_cam, axis=1)
    facing = -np.sum(in_cam * rigid3.rotate(cam_from_world, normals), axis=1)
    xy, valid = camera.img_from_point(in_cam)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = ((xy >= 0.0) & (xy <= size)).all(axis=1)
    seen = valid & inside & (ranges <= dive.max_range)
    return xy, seen & (facing >= dive.min_cos * ranges)


def _with_noise(
    truth: Scene, options: ObservationOptions, rng: np.random.Generator
) -> SimulatedScene:
    noisy = truth.xy + options.noise_px * rng.normal(size=truth.xy.shape)
    num_outliers = round(options.outlier_ratio * len(noisy))
    outliers = rng.choice(len(noisy), num_outliers, replace=False)
    sizes = np.array([[camera.width, camera.height] for camera in truth.cameras])
    noisy[outliers] = sizes[truth.camera_idx[outliers]] * rng.uniform(
        size=(num_outliers, 2)
    )
    is_outlier = np.zeros(len(noisy), dtype=np.bool_)
    is_outlier[outliers] = True
    return SimulatedScene(
        scene=replace(truth, xy=noisy), truth=truth, is_outlier=is_outlier
    )
