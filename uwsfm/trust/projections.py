"""By how much two calibrations of one rig project differently, over image and range.

As the cross-validation of mrcal: numbers of a lens, a port and a placement trade
against each other, and what counts is where they put a pixel. Points on the water rays
of the first calibration, at the ranges of the scene, are projected by the second one,
after the one motion of the whole rig that brings both closest together: the frame of a
rig is as much an estimate as its ports.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene

COLUMNS, ROWS = 8, 6
"""Cells of the map across an image."""
RANGES = (5.0, 50.0, 95.0)
"""Percentiles of the distances of the points from the cameras."""
LEAST = 3
"""Observations in a cell of the map, of all images of a camera together: beyond, no
calibration speaks of the image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectionMap:
    """By how much two calibrations project differently."""

    ranges_m: Array
    """(R,) from a camera, along its water rays."""
    px: Array
    """(C, R, ROWS, COLUMNS) length of the difference in the image; NaN where neither
    calibration has observations."""
    mm: Array
    """The same in the water, across the ray: 1e3 times the unit of the model."""

    def rms_px(self, range_idx: int) -> float:
        return float(np.sqrt(np.nanmean(self.px[:, range_idx] ** 2)))

    def rms_mm(self, range_idx: int) -> float:
        return float(np.sqrt(np.nanmean(self.mm[:, range_idx] ** 2)))


def projection_map(
    first: Scene, second: Scene, whole: Scene, rig: Rig, *, with_scale: bool
) -> ProjectionMap:
    """Compare two calibrations of a rig, of disjoint frames of a scene.

    Args:
        first, second: their scenes.
        whole: the scene with all observations, for places and ranges.
        rig: how far its lenses were calibrated.
        with_scale: the unit of length is arbitrary, and each scene's own.
    """
    ranges = _ranges(whole)
    in_rig, seen, places = [], [], []
    for c, camera in enumerate(first.cameras):
        xy = _grid(camera.width, camera.height)
        good = rig.cameras[c].covers(xy) & _observed(whole, c)
        origins, dirs = camera.ray_from_img(xy)
        points = origins + ranges[:, None, None] * dirs  # (R, cells, 3)
        rig_from_cam = rigid3.inverse(first.cam_from_rig[c])
        in_rig.append(rigid3.transform(rig_from_cam, points))
        seen.append(np.broadcast_to(good, points.shape[:2]))
        places.append(np.broadcast_to(xy, (*points.shape[:2], 2)))
    # One central camera sees the same at every size of the scene.
    sized = len(rig.cameras) > 1 or rig.cameras[0].port.refracts
    motion = _best_motion(second, in_rig, places, seen, with_scale and sized)
    px, mm = [], []
    for c in range(len(first.cameras)):
        moved = _moved(motion, in_rig[c])
        gap = _projected(second, c, moved) - places[c]
        length = np.where(seen[c], np.linalg.norm(gap, axis=2), np.nan)
        across = np.where(seen[c], _across(second, c, moved, places[c]), np.nan)
        shape = (len(ranges), ROWS, COLUMNS)
        px.append(length.reshape(shape))
        mm.append(1e3 * across.reshape(shape))
    return ProjectionMap(ranges_m=ranges, px=np.array(px), mm=np.array(mm))


def _grid(width: int, height: int) -> Array:
    """Centres of the cells (ROWS COLUMNS, 2), px."""
    x = (np.arange(COLUMNS) + 0.5) * width / COLUMNS
    y = (np.arange(ROWS) + 0.5) * height / ROWS
    return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)


def _observed(scene: Scene, camera: int) -> NDArray[np.bool_]:
    """Mask (ROWS COLUMNS,) of the cells with enough observations."""
    lens = scene.cameras[camera]
    xy = scene.xy[scene.camera_idx == camera]
    cell = np.clip(
        (xy * [COLUMNS / lens.width, ROWS / lens.height]).astype(np.int64),
        0,
        [COLUMNS - 1, ROWS - 1],
    )
    counts = np.bincount(cell[:, 1] * COLUMNS + cell[:, 0], minlength=ROWS * COLUMNS)
    enough: NDArray[np.bool_] = counts >= LEAST
    return enough


def _ranges(scene: Scene) -> Array:
    lengths = np.linalg.norm(scene.points_in_cam(), axis=1)
    return np.asarray(np.nanpercentile(lengths, RANGES))


def _best_motion(
    scene: Scene,
    in_rig: list[Array],
    places: list[Array],
    seen: list[NDArray[np.bool_]],
    with_scale: bool,
) -> Array:
    """(7,) rotation vector, translation and logarithm of the scale of all points that
    projects them nearest to their places."""
    size = 7 if with_scale else 6

    def misses(step: Array) -> Array:
        motion = np.append(step, np.zeros(7 - size))
        parts = []
        for c, points in enumerate(in_rig):
            gap = _projected(scene, c, _moved(motion, points))[seen[c]]
            parts.append((gap - places[c][seen[c]]).ravel())
        # What does not project misses by much, and stays where it is.
        return np.nan_to_num(np.concatenate(parts), nan=1e3)

    found = least_squares(misses, np.zeros(size), x_scale="jac", method="trf")
    return np.append(found.x, np.zeros(7 - size))


def _moved(motion: Array, points: Array) -> Array:
    pose = np.append(rigid3.quat_from_rotvec(motion[:3]), motion[3:6])
    return rigid3.transform(pose, np.exp(motion[6]) * points)


def _projected(scene: Scene, camera: int, in_rig: Array) -> Array:
    in_cam = rigid3.transform(scene.cam_from_rig[camera], in_rig).reshape(-1, 3)
    xy, _ = scene.cameras[camera].img_from_point(in_cam)
    return xy.reshape(*in_rig.shape[:-1], 2)


def _across(scene: Scene, camera: int, in_rig: Array, xy: Array) -> Array:
    """Distance of each point from the water ray of its pixel."""
    origins, dirs = scene.cameras[camera].ray_from_img(xy.reshape(-1, 2))
    in_cam = rigid3.transform(scene.cam_from_rig[camera], in_rig).reshape(-1, 3)
    miss = np.linalg.norm(np.cross(in_cam - origins, dirs), axis=1)
    return miss.reshape(in_rig.shape[:-1])
