"""The depth maps of a result: made one by one, kept in its workspace, read again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.dense.calibration_error import CalibrationError
from uwsfm.dense.depth_map import DepthMap, pixel_rows, read_depth_map, write_depth_map
from uwsfm.dense.fuse import Placed, placed
from uwsfm.dense.match import COST_BYTES, MULTIPLE, Gray
from uwsfm.dense.mono_maps import MonoMaps
from uwsfm.dense.options import MAX_PIXELS
from uwsfm.dense.stereo import BYTES_PER_PIXEL, stereo_depth
from uwsfm.dense.views import (
    View,
    cam_from_world,
    image_path,
    load_image,
    mono_views,
    slabs_of,
    stereo_views,
)
from uwsfm.errors import InputError
from uwsfm.export.files import WORK
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.result_folder import Result, open_result
from uwsfm.sfm.steps import fingerprint

FOLDER = "dense"
"""In the workspace."""
BYTES_ON_DISK, MONO_BYTES_ON_DISK = 8, 36
"""Per pixel: two floats in single precision; those, three of a normal and one of its
noise, and three of a hypothesis."""
SMALLEST_TILE = (16 * MULTIPLE) ** 2 * COST_BYTES * 512
"""Bytes of the matcher."""
FORMAT = 3
"""Of the depth maps, what makes them included: others are made again."""


def depth_maps(
    out: str | Path, images: str | Path | None = None, quality: str = "medium"
) -> Iterator[tuple[View, DepthMap]]:
    """The depth maps that `dense_cloud` made of a result folder.

    Args:
        out: the folder.
        images: the images' folder; default: where they were.
        quality: that they were made with.

    Raises:
        InputError: the folder or an image is not usable, or a depth map is missing.
    """
    result = open_result(out, images)
    maps = DepthMaps(result, result.require_images(), quality)
    for index, view in enumerate(maps.views):
        yield view, maps.read(index)


class DepthMaps:
    """What depth maps a result has, and where.

    Args:
        result: the reconstruction.
        images: folder of its images.
        quality: one of `MAX_PIXELS`, for the images of single cameras.

    Raises:
        InputError: no two cameras of the rig can be compared, or, of a single one, no
            two frames.
    """

    def __init__(self, result: Result, images: Path, quality: str = "medium") -> None:
        self.model, self.images = result.model, images
        self.refused: dict[tuple[int, int], str] = {}
        if len(self.model.scene.cameras) > 1:
            self.views, self.refused = stereo_views(self.model)
        else:
            self.views = mono_views(self.model)
        self._work = result.folder / WORK / FOLDER
        pixels = MAX_PIXELS[quality]
        self._mono: MonoMaps | None = None
        if not self.views[0].is_stereo:
            self._mono = MonoMaps(self.model, images, self._work, self.views, pixels)
        self._covariance = result.calibration.covariance
        self.errors: dict[tuple[int, int], CalibrationError | None] = {}

    def require_images(self) -> None:
        """Look for all images before the first is matched.

        Raises:
            InputError: one is missing.
        """
        for view in self.views:
            for name in (view.name, *view.other_names):
                image_path(self.images, name)

    def missing_bytes(self) -> int:
        """What the depth maps that are not there will take on the disk."""
        needed = 0
        for view in self.views:
            if not self._path(view).exists():
                each = BYTES_ON_DISK if view.is_stereo else MONO_BYTES_ON_DISK
                camera = self.camera(view)
                needed += each * camera.width * camera.height
        return needed

    def camera(self, view: View) -> RefractiveCamera:
        """Of the depth map: reduced as it is."""
        if self._mono is not None:
            return self._mono.camera(view.camera)
        return self.model.scene.cameras[view.camera]

    def color(self, index: int) -> NDArray[np.uint8]:
        """The image of a depth map (H, W, 3), blue, green, red."""
        view = self.views[index]
        if self._mono is not None:
            return self._mono.color(view.camera, view.name)
        return load_image(self.model, self.images, view.camera, view.name)

    @property
    def num_passes(self) -> int:
        """Over all views, before the depth maps are there."""
        return 1 if self._mono is None else 2

    def search(self, index: int) -> None:
        """The first pass over a view, where there are two; none if its map is there."""
        view = self.views[index]
        assert self._mono is not None
        if read_depth_map(self._path(view), self._key(index)) is None:
            self._mono.search(index)

    def make(self, index: int, budget: float) -> dict[str, Any]:
        """Make a depth map unless it is there; what is known of it.

        Args:
            index: of the view.
            budget: bytes that may be allocated.
        """
        view = self.views[index]
        path, key = self._path(view), self._key(index)
        slabs = slabs_of(self.model, view) if view.is_stereo else ()
        depth = read_depth_map(path, key)
        reused = depth is not None
        if depth is None:
            if self._mono is not None:
                depth = self._mono.depth(index)
            else:
                left = self._gray(view.camera, view.name)
                right = self._gray(view.others[0][0], view.other_names[0])
                depth = stereo_depth(slabs, left, right, budget)
            write_depth_map(depth, path, key)
        return {
            "image": view.name,
            "compared_with": list(view.other_names),
            "near": view.near,
            "far": view.far,
            "num_slabs": len(slabs) or None,
            "deviation_px": max((slab.deviation_px for slab in slabs), default=None),
            "share_matched": depth.num_valid / depth.ranges.size,
            "reused": reused,
        }

    def bytes_of(self, index: int) -> float:
        """What `make` needs of a view, with the smallest tiles."""
        view = self.views[index]
        if self._mono is not None:
            return self._mono.bytes_of(index)
        pixels = max(s.size[0] * s.size[1] for s in slabs_of(self.model, view))
        return BYTES_PER_PIXEL * pixels + SMALLEST_TILE

    def _gray(self, camera: int, name: str) -> Gray:
        image = load_image(self.model, self.images, camera, name)
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

    def _path(self, view: View) -> Path:
        other = view.key[1] if view.is_stereo else "patchmatch"
        name = f"{view.frame:06d}_{view.camera}-{other}.npz"
        return self._work / name

    def _key(self, index: int) -> str:
        """Of all that a depth map depends on."""
        if self._mono is not None:
            return self._mono.key(index)
        view, scene = self.views[index], self.model.scene
        cameras = [
            (scene.cameras[c].lens.tolist(), scene.cameras[c].port.row.tolist())
            for c in view.key
        ]
        files = []
        for name in (view.name, *view.other_names):
            status = image_path(self.images, name).stat()
            files.append((name, status.st_size, status.st_mtime_ns))
        # Of the rig, to the last digit, wherever the frame is.
        poses = scene.cam_from_rig[list(view.key)].tolist()
        return fingerprint([FORMAT, cameras, files, poses, view.near, view.far])

    def read(self, index: int) -> DepthMap:
        """A depth map that was made.

        Raises:
            InputError: it was not, or not of these images and this calibration.
        """
        view = self.views[index]
        depth = read_depth_map(self._path(view), self._key(index))
        if depth is None:
            raise InputError(f"{self._path(view)} is missing or old: run uwsfm dense")
        return depth

    def placed(self, index: int) -> Placed:
        """A depth map in the world, with what the calibration adds to its errors."""
        view = self.views[index]
        depth = self.read(index)
        return placed(
            self.camera(view),
            cam_from_world(self.model, view.camera, view.frame),
            depth,
            self._calibration(view, depth),
        )

    def _calibration(self, view: View, depth: DepthMap) -> Any:
        height, width = depth.ranges.shape
        found = np.zeros((height, width), dtype=np.float32)
        error = self.errors.get(view.key)
        if error is None:
            return found
        rows = max(1, 200_000 // width)
        camera = self.model.scene.cameras[view.camera]
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            values = error.stddev(
                pixel_rows(camera, top, bottom), depth.ranges[top:bottom].ravel()
            )
            found[top:bottom] = values.reshape(bottom - top, width)
        return np.nan_to_num(found)

    def prepare_errors(self) -> None:
        """Find what the calibration adds, before `placed` is called."""
        covariance = self._covariance
        for key in {view.key for view in self.views}:
            of_key = [view for view in self.views if view.key == key]
            self.errors[key] = None
            if key[0] == key[1]:
                continue  # between frames it is the poses that err
            if covariance.determined and len(covariance.border):
                self.errors[key] = CalibrationError(
                    self.model.scene,
                    covariance,
                    key,
                    0.8 * min(view.near for view in of_key),
                    1.5 * max(view.far for view in of_key),
                )
