"""What uncertain poses do to the depths of an image, with ports, lens and rig: through
their joint covariance, by how far places that the image and its neighbours show move
along its lines of sight.

The factor by which all lengths err together is left out: the scale has a standard
deviation of its own. What stays is the same error for all depths of an image, so that
averaging over pixels does not make it smaller.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from uwsfm.calibration.propagation import Propagation
from uwsfm.dense.range_error import RangeError, RangeGrid
from uwsfm.dense.views import View
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD

_GRID = (6, 5, 3)
"""Columns, rows and inverse ranges at which the deviation is computed: in the middle of
as many cells."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Moves:
    """How places that a view shows move along its sights."""

    grid: RangeGrid
    shown: NDArray[np.bool_]
    """(G,) bool, of the grid: whether a neighbour shows it, too."""
    ranges: Array
    """(S,) of those."""
    by_unknowns: sp.csr_array
    """(S, n) derivative by the unknowns of the reduced system."""


def range_errors(
    scene: Scene, propagation: Propagation, views: list[View]
) -> list[RangeError | None]:
    """Of each view; None where no neighbour shows a place, or nothing is determined.

    Args:
        scene: cameras, rig and frames at the optimum.
        propagation: of the calibration of that scene.
        views: of `uwsfm.dense.views.image_views`.
    """
    if not propagation.determined:
        return [None for _ in views]
    moves = [_moves(scene, propagation, view) for view in views]
    known = [each for each in moves if each is not None]
    if not known:
        return [None for _ in views]
    count = sum(len(each.ranges) for each in known)
    common = sum(each.by_unknowns.T @ (1.0 / each.ranges) for each in known) / count
    found: list[RangeError | None] = []
    for each in moves:
        if each is None:
            found.append(None)
            continue
        alone = each.by_unknowns.T.toarray() - common[:, None] * each.ranges
        stddev = np.full(len(each.shown), np.nan)
        stddev[each.shown] = np.sqrt(propagation.shared_variances(alone))
        known_here = np.isfinite(stddev)
        stddev[~known_here] = np.median(stddev[known_here])
        found.append(RangeError(each.grid, stddev))
    return found


def _moves(scene: Scene, propagation: Propagation, view: View) -> _Moves | None:
    """None: no neighbour shows anything of what the view does."""
    camera = scene.cameras[view.camera]
    rig_from_world = scene.rig_from_world[view.frame]
    rig_from_cam = rigid3.inverse(scene.cam_from_rig[view.camera])
    columns, rows, depths = _GRID
    grid = RangeGrid(
        x=_middles(0.0, camera.width, columns),
        y=_middles(0.0, camera.height, rows),
        inverse=_middles(1.0 / view.far, 1.0 / view.near, depths),
    )
    at, inverse = grid.nodes()
    origins, dirs = camera.ray_from_img(at)
    ranges = 1.0 / inverse
    in_rig = rigid3.transform(rig_from_cam, origins + ranges[:, None] * dirs)
    points = rigid3.transform(rigid3.inverse(rig_from_world), in_rig)
    images = (view.camera, view.frame), *view.others
    pixels = np.array([_shown(scene, image, points) for image in images])
    there = np.isfinite(pixels[..., 0])
    shown = np.count_nonzero(there, axis=0) > 1
    if not shown.any():
        return None
    image, place = np.nonzero(there & shown)
    seen = replace(
        scene,
        points=points[shown],
        camera_idx=np.array(images, dtype=np.int64)[image, 0],
        frame_idx=np.array(images, dtype=np.int64)[image, 1],
        point_idx=(np.cumsum(shown) - 1)[place],
        xy=pixels[image, place],
    )
    moved = propagation.of_rays(seen, np.zeros(len(seen.points)))
    sights = rigid3.rotate(rig_from_cam, dirs)[shown]
    in_world = rigid3.rotate(rigid3.inverse(rig_from_world), sights)
    along = sp.block_diag(list(in_world[:, None]), format="csr")
    return _Moves(
        grid=grid,
        shown=shown,
        ranges=ranges[shown],
        by_unknowns=sp.csr_array(along @ moved.pull)
        + _by_frame(propagation, view.frame, in_rig[shown], sights),
    )


def _by_frame(
    propagation: Propagation, frame: int, in_rig: Array, sights: Array
) -> sp.csr_array:
    """(S, n) how far resting places move along sights when the frame does.

    Args:
        in_rig, sights: (S, 3) in the rig.
    """
    layout = propagation.optimum.layout
    size = layout.num_frame_cols + layout.num_border_cols
    first = layout.frame_col[frame]
    if first == HELD:
        return sp.csr_array((len(sights), size))
    # x -> Exp(w) x + v moves it by w cross x + v.
    values = np.concatenate([np.cross(in_rig, sights), sights], axis=1)
    columns = np.tile(first + np.arange(6), len(sights))
    return sp.csr_array(
        (values.ravel(), columns, 6 * np.arange(len(sights) + 1)),
        shape=(len(sights), size),
    )


def _shown(scene: Scene, image: tuple[int, int], points: Array) -> Array:
    """Pixels (N, 2) of points in an image, NaN where it does not show them."""
    camera, frame = image
    lens = scene.cameras[camera]
    pose = rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world[frame])
    xy, ok = lens.img_from_point(rigid3.transform(pose, points))
    ok &= np.all((xy >= 0.0) & (xy <= [lens.width, lens.height]), axis=1)
    return np.where(ok[:, None], xy, np.nan)


def _middles(low: float, high: float, count: int) -> Array:
    """Of cells (count,)."""
    return low + (high - low) * (np.arange(count) + 0.5) / count
