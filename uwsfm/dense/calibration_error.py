"""What the uncertain calibration does to a depth: through the covariance of ports, lens
and rig, by the change of the triangulated range with each of their parameters.

This part of a standard deviation is the same error in every frame: averaging does not
make it smaller.
"""

from __future__ import annotations

import numpy as np

from uwsfm.calibration.result import Covariance
from uwsfm.dense.range_error import RangeError, RangeGrid
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import closest_points
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.state import State

_GRID = (9, 7, 4)
"""Columns, rows and inverse ranges at which the deviation is computed."""
_STEP = 1e-6
"""Metres, radians, pixels: differences lose six digits of sixteen to it."""


def calibration_error(
    scene: Scene,
    covariance: Covariance,
    pair: tuple[int, int],
    near: float,
    far: float,
) -> RangeError:
    """Standard deviation of a pair's ranges from the covariance of its calibration.

    Args:
        scene: cameras and rig at the optimum.
        covariance: of its border.
        pair: left and right camera.
        near, far: limits of the ranges, metres.
    """
    left, right = pair
    camera = scene.cameras[left]
    columns, rows, depths = _GRID
    grid = RangeGrid(
        x=np.linspace(0.5, camera.width - 0.5, columns),
        y=np.linspace(0.5, camera.height - 0.5, rows),
        inverse=np.linspace(1.0 / far, 1.0 / near, depths),
    )
    xy, inverse = grid.nodes()
    origins, dirs = camera.ray_from_img(xy)
    points = origins + dirs / inverse[:, None]
    right_from_left = _relative(scene.cam_from_rig, pair)
    shown, _ = scene.cameras[right].img_from_point(
        rigid3.transform(right_from_left, points)
    )
    at_optimum = _ranges(scene.cameras, right_from_left, pair, xy, shown)
    jac = np.zeros((len(xy), len(covariance.border)))
    for column, moved in _moved_scenes(scene, covariance, pair):
        relative = _relative(moved.cam_from_rig, pair)
        ranges = _ranges(moved.cameras, relative, pair, xy, shown)
        jac[:, column] = (ranges - at_optimum) / _STEP
    variance = np.einsum("na,ab,nb->n", jac, covariance.border, jac)
    # What the right image does not show has the deviation of what it does.
    known = np.isfinite(variance)
    fallback = float(np.median(variance[known])) if known.any() else np.nan
    return RangeError(
        grid, np.sqrt(np.where(known, np.maximum(variance, 0.0), fallback))
    )


def _moved_scenes(scene: Scene, covariance: Covariance, pair: tuple[int, int]):
    """The parameters that the pair depends on, and the scene with each moved a step."""
    few = np.zeros(scene.num_observations, dtype=bool)
    for camera in range(len(scene.cameras)):
        few[np.flatnonzero(scene.camera_idx == camera)[:1]] = True
    scene, _ = scene.select(few)
    layout = build_layout(scene, covariance.border_cols)
    state = State.from_scene(scene)
    of_pair = np.unique(covariance.border_cols[list(pair)])
    for column in of_pair[of_pair != HELD]:
        step = np.zeros(layout.num_frame_cols + layout.num_border_cols)
        step[layout.num_frame_cols + column] = _STEP
        moved = state.moved(layout, step, np.zeros((scene.num_points, 3)))
        yield int(column), moved.to_scene(scene)


def _relative(cam_from_rig: Array, pair: tuple[int, int]) -> Array:
    left, right = pair
    return rigid3.compose(cam_from_rig[right], rigid3.inverse(cam_from_rig[left]))


def _ranges(
    cameras: tuple[RefractiveCamera, ...],
    right_from_left: Array,
    pair: tuple[int, int],
    xy: Array,
    shown: Array,
) -> Array:
    """Ranges (N,) along the left rays of pixels and their matches."""
    origins, dirs = cameras[pair[0]].ray_from_img(xy)
    starts, ways = cameras[pair[1]].ray_from_img(shown)
    back = rigid3.inverse(right_from_left)
    starts, ways = rigid3.transform(back, starts), rigid3.rotate(back, ways)
    return closest_points(origins, dirs, starts, ways)[1][:, 0]
