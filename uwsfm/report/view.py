"""The three-dimensional view of a report: points, frusta, trajectory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.result import Covariance
from uwsfm.colmap.model import Model
from uwsfm.errors import UwsfmError
from uwsfm.export.scene_ply import camera_lines
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.files import depth_stddev
from uwsfm.surface.level import level_by_plane

MAX_POINTS = 100_000
"""More are thinned out at random: a browser turns so many smoothly."""
MAX_FRUSTA = 200
"""Per camera; of more frames every so many-th is drawn, and the whole trajectory."""
FRUSTUM_SHARE = 0.12
"""Length of a frustum, as a share of the median distance of the points."""
OUTLYING = 0.8
"""Points further from the middle than so many times the span of the 1st to the 99th
percentile would shrink the rest to a dot."""
_FAR_ORIGIN = 1e3
"""Spans: coordinates so much larger lose digits as 32-bit numbers."""


@dataclass(frozen=True, kw_only=True)
class View:
    """What is drawn, in a level frame: x along the scene, z up; units of the model.

    A place of the world is drawn at ``axes @ (place - origin)``.
    """

    origin: Array
    """(3,) in the world."""
    axes: Array
    """(3, 3) right-handed; rows: the axes of the view in the world."""
    points: Array
    """(P, 3)"""
    point_idx: NDArray[np.int64]
    """(P,) in the model, whose ids are larger by one."""
    colors: NDArray[np.uint8]
    """(P, 3) RGB"""
    error_px: Array
    """(P,) mean true error."""
    stddev_m: Array
    """(P,) along the mean line of sight; NaN: not determined."""
    num_all_points: int
    num_outlying: int
    """That are too far out to be drawn."""
    frusta: tuple[Array, ...]
    """Per camera: (V, 3) polylines, parted by rows of NaN."""
    frusta_step: int
    """Every so many-th frame has its frusta drawn."""
    trajectory: Array
    """(F, 3) centres of the rig."""
    sight: Array
    """(3,) unit, mean direction that the cameras look in."""
    up: Array
    """(3,) unit, mean direction of the top of the images."""


def view_of(model: Model, covariance: Covariance) -> View:
    """What the view of a result shows."""
    scene = model.scene
    errors = model.errors_px()
    known = np.isfinite(errors)
    count = np.bincount(scene.point_idx[known], minlength=scene.num_points)
    total = np.bincount(scene.point_idx[known], errors[known], scene.num_points)
    world_from_rig = rigid3.inverse(scene.rig_from_world)
    centers = world_from_rig[:, 4:]
    shown, outlying = _shown_points(scene.points, centers)
    kept = _thinned(shown)
    points = scene.points[kept]
    origin = _origin(np.concatenate([points, centers]))
    tops = rigid3.rotate(world_from_rig, [0.0, -1.0, 0.0])
    axes = level_axes(points, centers, _mean_direction(tops))

    def drawn(places: Array) -> Array:
        return (places - origin) @ axes.T

    step = -(-scene.num_frames // MAX_FRUSTA)
    return View(
        origin=origin,
        axes=axes,
        points=drawn(points),
        point_idx=kept,
        colors=model.colors[kept],
        error_px=total[kept] / np.maximum(count[kept], 1),
        stddev_m=depth_stddev(model, covariance.points)[kept],
        num_all_points=scene.num_points,
        num_outlying=outlying,
        frusta=tuple(drawn(_frusta(model, c, step)) for c in range(len(scene.cameras))),
        frusta_step=step,
        trajectory=drawn(centers),
        sight=axes @ _mean_direction(rigid3.rotate(world_from_rig, [0.0, 0.0, 1.0])),
        up=axes @ _mean_direction(tops),
    )


def level_axes(points: Array, centers: Array, top: Array) -> Array:
    """Axes (3, 3) of a level view, as rows: up as in maps, x along the scene.

    Args:
        points: (P, 3).
        centers: (F, 3) of the cameras, which are above the points.
        top: (3,) unit, of the images: up where the points span no plane.
    """
    finite = points[finite_rows(points)]
    try:
        level = level_by_plane(finite, centers.mean(axis=0))
        up = rigid3.rotate(rigid3.inverse(level.map_from_world), [0.0, 0.0, 1.0])
    except UwsfmError:
        up = top
    spread = np.concatenate([finite, centers])
    spread = spread - spread.mean(axis=0)
    spread -= np.outer(spread @ up, up)
    x = np.linalg.svd(spread, full_matrices=False)[2][0]
    x -= (x @ up) * up
    if not np.linalg.norm(x) > 0.5:  # all at one place, or on a plumb line
        x = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _shown_points(points: Array, centers: Array) -> tuple[NDArray[np.int64], int]:
    """Indices of the points to draw, and how many lie too far out."""
    finite = np.flatnonzero(finite_rows(points))
    if not len(finite):
        return finite, 0
    low, high = np.percentile(points[finite], [1.0, 99.0], axis=0)
    low = np.minimum(low, centers.min(axis=0))
    high = np.maximum(high, centers.max(axis=0))
    room = OUTLYING * float((high - low).max())
    near = np.all(np.abs(points[finite] - 0.5 * (low + high)) <= room, axis=1)
    return finite[near], int(np.count_nonzero(~near))


def _thinned(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    if len(rows) <= MAX_POINTS:
        return rows
    rng = np.random.default_rng(0)
    return np.sort(rng.choice(rows, MAX_POINTS, replace=False))


def _origin(places: Array) -> Array:
    """Zero, or of a world that is far from its own zero, a round place in it."""
    middle = np.median(places, axis=0)
    span = float(np.ptp(places, axis=0).max())
    if np.abs(middle).max() <= _FAR_ORIGIN * span:
        return np.zeros(3)
    return np.round(middle)


def _frusta(model: Model, camera: int, step: int) -> Array:
    """Polylines (V, 3) in the world, parted by rows of NaN."""
    scene = model.scene
    mine = scene.camera_idx == camera
    ranges = np.linalg.norm(scene.points_in_cam()[mine], axis=1)
    if not len(ranges):
        return np.empty((0, 3))
    length = FRUSTUM_SHARE * float(np.nanmedian(ranges))
    lines = camera_lines(scene.cameras[camera], length, np.zeros(3, dtype=np.uint8))
    gap = np.full((1, 3), np.nan)
    parts = [(part, gap) for part in strips(lines.vertices, lines.edges)]
    strip = np.concatenate([row for pair in parts for row in pair])
    world_from_cam = rigid3.inverse(
        rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world)
    )
    drawn = [
        rigid3.transform(world_from_cam[frame], strip)
        for frame in range(0, scene.num_frames, step)
        if model.has_image(camera, frame)
    ]
    return np.concatenate(drawn) if drawn else np.empty((0, 3))


def strips(vertices: Array, edges: NDArray[np.int64]) -> list[Array]:
    """Edges between neighbouring vertices as polylines (K, 3)."""
    breaks = np.flatnonzero(np.diff(edges[:, 0]) != 1) + 1
    runs = np.split(edges, breaks)
    return [vertices[run[0, 0] : run[-1, 1] + 1] for run in runs]


def _mean_direction(directions: Array) -> Array:
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 1e-3 else directions[0]
