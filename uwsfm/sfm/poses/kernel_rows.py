"""Rigs and water rays as the pose kernels read them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

IndexArray = NDArray[np.int64]
RigRows = tuple[Array, Array, Array]
"""Rows of cam_from_rig (C, 12), of lenses and of ports."""


def rig_rows(
    cameras: Sequence[RefractiveCamera], cam_from_rig: ArrayLike
) -> tuple[RigRows, Array]:
    """The rows of a rig, and cam_from_rig (C, 7) as an array.

    Raises:
        InputError: not one pose per camera, or a lens that cannot be projected with.
    """
    poses = np.asarray(cam_from_rig, dtype=np.float64)
    if poses.shape != (len(cameras), 7):
        raise InputError(f"{poses.shape=}, expected ({len(cameras)}, 7): cam_from_rig")
    lenses = np.array([camera.lens for camera in cameras])
    ports = np.array([camera.port.row for camera in cameras])
    return (rigid3.matrix_rows(poses), lenses, ports), poses


def checked_views(
    num_cameras: int, camera_idx: ArrayLike, xy: ArrayLike
) -> tuple[IndexArray, Array]:
    """Camera indices (N,) and pixels (N, 2) of observations.

    Raises:
        InputError: arrays of other shapes, or an index without a camera.
    """
    index = np.ascontiguousarray(camera_idx, dtype=np.int64)
    pixels = np.ascontiguousarray(xy, dtype=np.float64)
    if index.ndim != 1:
        raise InputError(f"camera_idx.shape={index.shape}, expected (N,)")
    if pixels.shape != (len(index), 2):
        raise InputError(f"xy.shape={pixels.shape}, expected ({len(index)}, 2)")
    if len(index) and not (index.min() >= 0 and index.max() < num_cameras):
        raise InputError(f"camera_idx must be in 0..{num_cameras - 1}")
    return index, pixels


def near_rays(
    cameras: Sequence[RefractiveCamera], camera_idx: IndexArray, xy: Array
) -> tuple[Array, Array]:
    """Water rays (N, 6) in their cameras, and where those of each nearly meet (C, 3).

    Their origins are moved, along the rays, to the nearest point to that centre. NaN
    where a pixel has no ray; a camera without two rays has its own centre.
    """
    rays, centres = np.full((len(xy), 6), np.nan), np.zeros((len(cameras), 3))
    for c, camera in enumerate(cameras):
        rows = np.flatnonzero(camera_idx == c)
        if not len(rows):
            continue
        origins, dirs = camera.ray_from_img(xy[rows])
        centre = triangulate_tracks(origins, dirs, np.zeros(len(rows), np.int64), 1)[0]
        if np.isfinite(centre).all():
            centres[c] = centre
        along = np.einsum("ni,ni->n", centres[c] - origins, dirs)
        rays[rows, :3] = origins + along[:, None] * dirs
        rays[rows, 3:] = dirs
    return rays, centres


def rays_in_rig(rays: Array, camera_idx: IndexArray, cam_from_rig: Array) -> Array:
    """Rays (N, 6), of their cameras, in the frame of the rig."""
    rig_from_cam = rigid3.inverse(cam_from_rig)[camera_idx]
    origins = rigid3.transform(rig_from_cam, rays[:, :3])
    return np.concatenate([origins, rigid3.rotate(rig_from_cam, rays[:, 3:])], axis=1)
