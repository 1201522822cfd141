"""The depth maps of a result: made one by one, kept in its workspace, read again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uwsfm.dense.calibration_error import CalibrationError
from uwsfm.dense.depth_map import DepthMap, pixel_rows, read_depth_map, write_depth_map
from uwsfm.dense.fuse import Placed, placed
from uwsfm.dense.match import COST_BYTES, MULTIPLE, Gray
from uwsfm.dense.stereo import BYTES_PER_PIXEL, stereo_depth
from uwsfm.dense.sweep import Source, smallest_band, sweep_depth
from uwsfm.dense.views import (
    View,
    cam_from_world,
    image_path,
    load_image,
    slabs_of,
    stereo_views,
    sweep_views,
)
from uwsfm.errors import InputError
from uwsfm.export.files import WORK
from uwsfm.geometry import rigid3
from uwsfm.result_folder import Result, open_result
from uwsfm.sfm.steps import fingerprint

FOLDER = "dense"
"""In the workspace."""
BYTES_ON_DISK = 8
"""Per pixel: two floats in single precision."""
SMALLEST_TILE = (16 * MULTIPLE) ** 2 * COST_BYTES * 512
"""Bytes of the matcher."""
FORMAT = 3
"""Of the depth maps, what makes them included: others are made again."""


def depth_maps(
    out: str | Path, images: str | Path | None = None
) -> Iterator[tuple[View, DepthMap]]:
    """The depth maps that `dense_cloud` made of a result folder.

    Args:
        out: the folder.
        images: the images' folder; default: where they were.

    Raises:
        InputError: the folder or an image is not usable, or a depth map is missing.
    """
    result = open_result(out, images)
    maps = DepthMaps(result, result.require_images())
    for index, view in enumerate(maps.views):
        yield view, maps.read(index)


class DepthMaps:
    """What depth maps a result has, and where.

    Args:
        result: the reconstruction.
        images: folder of its images.

    Raises:
        InputError: no two cameras of the rig can be compared, or, of a single one, no
            two frames.
    """

    def __init__(self, result: Result, images: Path) -> None:
        self.model, self.images = result.model, images
        self.refused: dict[tuple[int, int], str] = {}
        if len(self.model.scene.cameras) > 1:
            self.views, self.refused = stereo_views(self.model)
        else:
            self.views = sweep_views(self.model)
        self._work = result.folder / WORK / FOLDER
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
        lenses = [
            self.model.scene.cameras[view.camera]
            for view in self.views
            if not self._path(view).exists()
        ]
        return sum(BYTES_ON_DISK * lens.width * lens.height for lens in lenses)

    def make(self, index: int, budget: float) -> dict[str, Any]:
        """Make a depth map unless it is there; what is known of it.

        Args:
            index: of the view.
            budget: bytes that may be allocated.
        """
        view = self.views[index]
        path, key = self._path(view), self._key(view)
        slabs = slabs_of(self.model, view) if view.is_stereo else ()
        depth = read_depth_map(path, key)
        reused = depth is not None
        if depth is None:
            image = self._gray(view.camera, view.name)
            others = [
                self._gray(camera, name)
                for (camera, _), name in zip(view.others, view.other_names, strict=True)
            ]
            if view.is_stereo:
                depth = stereo_depth(slabs, image, others[0], budget)
            else:
                camera = self.model.scene.cameras[view.camera]
                sources = self._sources(view, others)
                depth = sweep_depth(camera, image, sources, view.near, view.far, budget)
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
        """What `make` needs of a view, with the smallest tiles or bands."""
        view = self.views[index]
        if view.is_stereo:
            pixels = max(s.size[0] * s.size[1] for s in slabs_of(self.model, view))
            return BYTES_PER_PIXEL * pixels + SMALLEST_TILE
        return smallest_band(self.model.scene.cameras[view.camera].width)

    def _gray(self, camera: int, name: str) -> Gray:
        image = load_image(self.model, self.images, camera, name)
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

    def _sources(self, view: View, images: list[Gray]) -> list[Source]:
        own = rigid3.inverse(cam_from_world(self.model, view.camera, view.frame))
        return [
            Source(
                camera=self.model.scene.cameras[camera],
                from_reference=rigid3.compose(
                    cam_from_world(self.model, camera, frame), own
                ),
                image=image,
            )
            for (camera, frame), image in zip(view.others, images, strict=True)
        ]

    def _path(self, view: View) -> Path:
        other = view.key[1] if view.is_stereo else "sweep"
        name = f"{view.frame:06d}_{view.camera}-{other}.npz"
        return self._work / name

    def _key(self, view: View) -> str:
        """Of all that a depth map depends on."""
        scene = self.model.scene
        cameras = [
            (scene.cameras[c].lens.tolist(), scene.cameras[c].port.row.tolist())
            for c in view.key
        ]
        files = []
        for name in (view.name, *view.other_names):
            status = image_path(self.images, name).stat()
            files.append((name, status.st_size, status.st_mtime_ns))
        own = rigid3.inverse(cam_from_world(self.model, view.camera, view.frame))
        poses = [
            rigid3.compose(cam_from_world(self.model, *other), own).tolist()
            for other in view.others
        ]
        if view.is_stereo:
            # Of the rig, to the last digit, wherever the frame is.
            poses = scene.cam_from_rig[list(view.key)].tolist()
        return fingerprint([FORMAT, cameras, files, poses, view.near, view.far])

    def read(self, index: int) -> DepthMap:
        """A depth map that was made.

        Raises:
            InputError: it was not, or not of these images and this calibration.
        """
        view = self.views[index]
        depth = read_depth_map(self._path(view), self._key(view))
        if depth is None:
            raise InputError(f"{self._path(view)} is missing or old: run uwsfm dense")
        return depth

    def placed(self, index: int) -> Placed:
        """A depth map in the world, with what the calibration adds to its errors."""
        view = self.views[index]
        depth = self.read(index)
        camera = self.model.scene.cameras[view.camera]
        return placed(
            camera,
            cam_from_world(self.model, view.camera, view.frame),
            depth.ranges,
            depth.sensitivity,
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
