"""COLMAP models that others made, in terms of a rig: cameras, frames, pixels.

Any of COLMAP's formats: binary or text, with rigs and frames (4.x) or without (3.x,
where every image has its own free pose), cameras shared, per folder or per image. What
the model says of lenses is not used, for they stand for the port as well; its poses are
a start, its tracks are the observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm.colmap.model import FARTHEST, read_reconstruction
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.from_colmap.model_points import triangulated
from uwsfm.sfm.frontend.background import quiet_colmap
from uwsfm.sfm.frontend.images import natural_key

SPARSE = "sparse"
"""Where COLMAP and its programs keep the folders 0, 1, ... of their models."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageModel:
    """The registered images of a COLMAP model, by camera and frame of a rig.

    Lengths are in the unit of the model, whatever it is.
    """

    folder: Path
    frame_names: tuple[str, ...]
    """(F,) file names below the folders of the cameras, in natural order."""
    cam_from_world: Array
    """(C, F, 7) pose of each image; NaN rows where the model has none."""
    lens_models: frozenset[str]
    """COLMAP's names of the camera models, in the water."""
    points: Array
    """(P, 3)"""
    colors: NDArray[np.uint8]
    """(P, 3) RGB"""
    camera_idx: IndexArray
    """(N,) of each observation."""
    frame_idx: IndexArray
    """(N,)"""
    point_idx: IndexArray
    """(N,)"""
    keypoint_idx: IndexArray
    """(N,) index of the keypoint in its image."""
    xy: Array
    """(N, 2) pixels"""
    own_error_px: Array
    """(N,) reprojection error of the model's own cameras; NaN behind one of them."""
    keypoints: tuple[tuple[Array, ...], ...]
    """[camera][frame] -> (n, 2) all keypoints of an image; none if it is not there."""
    warnings: tuple[str, ...]
    """What the user should know, one sentence each."""

    @property
    def registered(self) -> NDArray[np.bool_]:
        """Mask (C, F) of the images that have a pose."""
        return np.asarray(np.isfinite(self.cam_from_world).all(axis=2))


@dataclass(frozen=True, kw_only=True)
class FoundModel:
    """The folder of a COLMAP model."""

    folder: Path
    warnings: tuple[str, ...] = ()
    """A word on the choice, if there was one."""


def find_model(source: Path) -> FoundModel | None:
    """A COLMAP model in a folder that may be one or hold one; None: there is none.

    Looked for in the folder, in its ``sparse`` and in numbered folders of both; of
    several, the one with most registered images is taken.
    """
    for folder in (source, source / SPARSE):
        if _is_model(folder):
            return FoundModel(folder=folder)
    found = sorted(
        folder
        for parent in (source / SPARSE, source)
        if parent.is_dir()
        for folder in parent.iterdir()
        if folder.name.isdecimal() and _is_model(folder)
    )
    if len(found) <= 1:
        return FoundModel(folder=found[0]) if found else None
    sizes = [_num_registered(folder) for folder in found]
    largest = found[int(np.argmax(sizes))]
    choice = (
        f"{source} holds {len(found)} models, of {', '.join(map(str, sizes))} images: "
        f"{largest} was taken, the largest"
    )
    return FoundModel(folder=largest, warnings=(choice,))


def _is_model(folder: Path) -> bool:
    return any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))


def _num_registered(folder: Path) -> int:
    with quiet_colmap():
        return read_reconstruction(folder).num_reg_images()


def read_image_model(
    found: FoundModel, rig: Rig, database: Path | None = None
) -> ImageModel:
    """Read a COLMAP model of raw images that lie in the folders of a rig.

    Args:
        found: The model.
        rig: Its images are in the folders of this rig.
        database: Of the model: where this has poses only, points come from its matches.

    Raises:
        InputError: not a model; one without points and matches to make them from; an
            image that is in no folder of the rig, of another size than its camera, or
            with a pose that is not finite; a camera of the rig that has no image.
    """
    folder = found.folder
    with quiet_colmap():
        reconstruction = read_reconstruction(folder)
    notes: tuple[str, ...] = ()
    images = _registered_images(folder, reconstruction)
    if database is not None and not reconstruction.num_points3D():
        reconstruction = triangulated(reconstruction, folder, database)
        images = _registered_images(folder, reconstruction)
        notes = (
            f"the model has poses without points: {reconstruction.num_points3D()} were "
            f"triangulated from the matches of {database}",
        )
    places, warnings = _places(folder, [image.name for image in images], rig)
    _require_raw_images(folder, reconstruction, rig, images, places)
    names = sorted({name for _, name in places}, key=natural_key)
    index_of = {name: index for index, name in enumerate(names)}
    num_cameras = len(rig.cameras)
    poses = np.full((num_cameras, len(names), 7), np.nan)
    none = np.empty((0, 2))
    keypoints = [[none] * len(names) for _ in range(num_cameras)]
    points = _Points(reconstruction)
    rows = []
    for image, (camera, name) in zip(images, places, strict=True):
        frame = index_of[name]
        pose = np.array(image.cam_from_world().params)
        poses[camera, frame] = pose
        keypoints[camera][frame], seen = points.seen_by(image)
        lens = reconstruction.cameras[image.camera_id]
        rows.append(points.observations(pose, lens, camera, frame, *seen))
    for camera, entry in enumerate(rig.cameras):
        if not np.isfinite(poses[camera]).any():
            raise InputError(
                f"{folder}: no registered image is in {entry.images}/, the folder of "
                f"camera {entry.name!r}"
            )
    table = np.concatenate(rows)  # (N, 7)
    table = table[np.lexsort((table[:, 0], table[:, 1], table[:, 2]))]
    if not len(table):
        raise InputError(
            f"{folder}: the model has poses, but no points that its images see: give "
            "its database to uwsfm refine (--database), or make points with COLMAP's "
            "point_triangulator"
        )
    if not np.isfinite(table[:, 6]).any():
        raise InputError(f"{folder}: every point lies behind the images that see it")
    index = table[:, :4].astype(np.int64)
    return ImageModel(
        folder=folder,
        frame_names=tuple(names),
        cam_from_world=poses,
        lens_models=frozenset(
            reconstruction.cameras[image.camera_id].model_name for image in images
        ),
        points=points.xyz,
        colors=points.colors,
        camera_idx=index[:, 0].copy(),
        frame_idx=index[:, 1].copy(),
        point_idx=index[:, 2].copy(),
        keypoint_idx=index[:, 3].copy(),
        xy=table[:, 4:6].copy(),
        own_error_px=table[:, 6].copy(),
        keypoints=tuple(tuple(of_camera) for of_camera in keypoints),
        warnings=(*found.warnings, *notes, *warnings),
    )


class _Points:
    """The points of a reconstruction, and who sees them."""

    def __init__(self, reconstruction: pycolmap.Reconstruction) -> None:
        self.ids = np.array(sorted(reconstruction.points3D), dtype=np.uint64)
        found = [reconstruction.points3D[int(i)] for i in self.ids]
        self.xyz = np.array([point.xyz for point in found]).reshape(-1, 3)
        self.xyz[np.any(np.abs(self.xyz) > FARTHEST, axis=1)] = np.nan
        colors = np.array([point.color for point in found], dtype=np.uint8)
        self.colors = colors.reshape(-1, 3)

    def seen_by(
        self, image: pycolmap.Image
    ) -> tuple[Array, tuple[IndexArray, IndexArray, Array]]:
        """All keypoints of an image (n, 2); of those with a point: index, point, xy."""
        found = image.points2D
        xy = np.array([point.xy for point in found]).reshape(-1, 2)
        ids = np.array([point.point3D_id for point in found], dtype=np.uint64)
        which = np.searchsorted(self.ids, ids)
        known = np.append(self.ids, 0)[which] == ids
        # Junk is no observation: a pixel or a point that is not a number.
        known &= finite_rows(xy) & np.all(np.abs(xy) < FARTHEST, axis=1)
        rows = np.nonzero(known)[0]
        return xy, (rows, which[rows].astype(np.int64), xy[rows])

    def observations(
        self,
        pose: Array,
        lens: pycolmap.Camera,
        camera: int,
        frame: int,
        keypoint_idx: IndexArray,
        point_idx: IndexArray,
        xy: Array,
    ) -> Array:
        """Rows (n, 7): camera, frame, point, keypoint, x, y, error of the model's."""
        in_cam = rigid3.transform(pose, self.xyz[point_idx])
        error = np.full(len(xy), np.nan)
        front = in_cam[:, 2] > 0.0
        if np.any(front):
            found = np.asarray(lens.img_from_cam(in_cam[front]))
            error[front] = np.linalg.norm(found - xy[front], axis=1)
        place = np.broadcast_to([float(camera), float(frame)], (len(xy), 2))
        return np.column_stack([place, point_idx, keypoint_idx, xy, error])


def _registered_images(
    folder: Path, reconstruction: pycolmap.Reconstruction
) -> list[pycolmap.Image]:
    images = [image for image in reconstruction.images.values() if image.has_pose]
    if not images:
        raise InputError(f"{folder}: the COLMAP model has no registered image")
    return sorted(images, key=lambda image: natural_key(image.name))


def places_in_rig(names: Sequence[str], rig: Rig) -> dict[str, tuple[int, str]]:
    """Camera index and file name below its folder, of the images that are in one.

    A single camera owns all images if none names its folder: there is no doubt.
    """
    folders = [camera.images for camera in rig.cameras]
    found = {
        name: (c, name[len(folder) + 1 :])
        for name in names
        for c, folder in enumerate(folders)
        if name.startswith(f"{folder}/")
    }
    if len(folders) == 1 and not found:
        return {name: (0, name) for name in names}
    return found


def _places(
    folder: Path, names: Sequence[str], rig: Rig
) -> tuple[list[tuple[int, str]], tuple[str, ...]]:
    """Camera index and file name of each image, and what to say about it."""
    folders = [camera.images for camera in rig.cameras]
    found = places_in_rig(names, rig)
    if len(found) == len(names):
        places = [found[name] for name in names]
        if places[0][1] != names[0]:
            return places, ()
        return places, (
            f"the model does not name the folder of its images: {folders[0]}/ was put "
            "in front of their names",
        )
    stray = next(name for name in names if name not in found)
    raise InputError(
        f"{folder}: image {stray} is in no folder of the rig "
        f"({', '.join(f'{item}/' for item in folders)}){_hint(stray, folders)}"
    )


def _hint(name: str, folders: Sequence[str]) -> str:
    """How names and folders could be made to agree, or ''."""
    for item in folders:
        before, found, _ = name.partition(f"/{item}/")
        if found:
            return f"; write images: {before}/{item} in the rig file"
    if any(name.startswith(item) for item in folders):
        return (
            "; cameras are told apart by folders, not by the beginnings of file names: "
            "put the images of each camera into its folder, equally named, and run "
            "COLMAP on the folder above"
        )
    if "/" not in name:
        return "; run COLMAP on the folder that holds the cameras' folders"
    return ""


def _require_raw_images(
    folder: Path,
    reconstruction: pycolmap.Reconstruction,
    rig: Rig,
    images: Sequence[pycolmap.Image],
    places: Sequence[tuple[int, str]],
) -> None:
    """Refuse models of undistorted or reduced images: their pixels are others."""
    for image, (camera, _) in zip(images, places, strict=True):
        seen, item = reconstruction.cameras[image.camera_id], rig.cameras[camera]
        size = item.camera.width, item.camera.height
        if (seen.width, seen.height) != size:
            raise InputError(
                f"{folder}: image {image.name} has {seen.width} x {seen.height} "
                f"pixels there, camera {item.name!r} of the rig has {size[0]} x "
                f"{size[1]}: give a model of the raw images"
            )
