"""The depth maps of a result: made one by one, kept in its workspace, read again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.propagation import Propagation
from uwsfm.dense.calibration_error import calibration_error
from uwsfm.dense.depth_map import DepthMap, pixel_rows, read_depth_map, write_depth_map
from uwsfm.dense.exposure import SeenColors
from uwsfm.dense.fuse import Placed, placed
from uwsfm.dense.lookup import looked_up
from uwsfm.dense.options import MAX_PIXELS, MAX_STEREO_PIXELS, DenseOptions
from uwsfm.dense.patchmatch_maps import PatchMatchMaps
from uwsfm.dense.pose_error import range_errors
from uwsfm.dense.range_error import RangeError
from uwsfm.dense.stereo_maps import StereoMaps
from uwsfm.dense.views import (
    View,
    cam_from_world,
    image_path,
    image_views,
    stereo_views,
)
from uwsfm.errors import InputError
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.results.files import WORK
from uwsfm.results.folder import Result, open_result

FOLDER = "dense"
"""In the workspace."""


def depth_maps(
    out: str | Path,
    images: str | Path | None = None,
    quality: str = "medium",
    matcher: str = "auto",
) -> Iterator[tuple[View, DepthMap]]:
    """The depth maps that `dense_cloud` made of a result folder.

    Args:
        out: the folder.
        images: the images' folder; default: where they were.
        quality: that they were made with.
        matcher: likewise.

    Raises:
        InputError: the folder or an image is not usable, or a depth map is missing.
    """
    result = open_result(out, images)
    options = DenseOptions(quality=quality, matcher=matcher)
    maps = DepthMaps(result, result.require_images(), options)
    for index, view in enumerate(maps.views):
        yield view, maps.read(index)


class DepthMaps:
    """What depth maps a result has, and where.

    Args:
        result: the reconstruction.
        images: folder of its images.
        options: of them, quality and matcher.

    Raises:
        InputError: no two cameras of the rig can be compared, or no two frames.
    """

    def __init__(
        self, result: Result, images: Path, options: DenseOptions | None = None
    ) -> None:
        options = options or DenseOptions()
        self.model, self.images = result.model, images
        self._work = result.folder / WORK / FOLDER
        self.views, self.refused = self._views(options.matcher)
        self._maker: StereoMaps | PatchMatchMaps
        if self.views[0].is_stereo:
            pixels = MAX_STEREO_PIXELS[options.quality]
            self._maker = StereoMaps(self.model, images, self.views, pixels)
        else:
            self._maker = PatchMatchMaps(
                *(self.model, images, self._work),
                self.views,
                MAX_PIXELS[options.quality],
            )
        self._calibrated = result.calibration
        self._errors: list[RangeError | None] = []

    def _views(self, matcher: str) -> tuple[list[View], dict[tuple[int, int], str]]:
        """The views, and why pairs of cameras are not compared in rectified images."""
        if matcher == "patchmatch" or len(self.model.scene.cameras) == 1:
            return image_views(self.model), {}
        try:
            return stereo_views(self.model)
        except InputError:
            if matcher == "stereo":
                raise
            # Cameras that turn away from each other: frames are compared instead.
            return image_views(self.model), {}

    @property
    def is_stereo(self) -> bool:
        """Whether pairs of cameras are compared, in rectified images."""
        return self._maker.is_stereo

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
                camera = self.camera(view)
                needed += self._maker.bytes_on_disk * camera.width * camera.height
        return needed

    def camera(self, view: View) -> RefractiveCamera:
        """The camera of a depth map: reduced as it is."""
        return self._maker.camera(view.camera)

    def color(self, index: int) -> NDArray[np.uint8]:
        """The image of a depth map (H, W, 3), blue, green, red."""
        view = self.views[index]
        return self._maker.color(view.camera, view.name)

    def point_colors(self, index: int) -> SeenColors:
        """What the image of a depth map shows around the points of the model."""
        view, scene = self.views[index], self.model.scene
        at = (scene.camera_idx == view.camera) & (scene.frame_idx == view.frame)
        xy = scene.xy[at] / self._maker.factor(view.camera)
        image = cv2.blur(self.color(index), (3, 3))
        colors = looked_up(image, xy, cv2.BORDER_REPLICATE).astype(np.float32)
        return SeenColors(rows=scene.point_idx[at], colors=colors)

    @property
    def num_passes(self) -> int:
        """Over all views, before the depth maps are there."""
        return 2 if self._maker.has_search else 1

    def search(self, index: int) -> None:
        """The first pass over a view, where there are two; none if its map is there."""
        view = self.views[index]
        if read_depth_map(self._path(view), self._maker.key(index)) is None:
            self._maker.search(index)

    def make(self, index: int, budget: float) -> dict[str, Any]:
        """Make a depth map unless it is there; what is known of it.

        Args:
            index: of the view.
            budget: bytes that may be allocated.
        """
        view = self.views[index]
        path, key = self._path(view), self._maker.key(index)
        depth = read_depth_map(path, key)
        reused = depth is not None
        if depth is None:
            depth = self._maker.depth(index, budget)
            write_depth_map(depth, path, key)
        return {
            "image": view.name,
            "compared_with": list(view.other_names),
            "near": view.near,
            "far": view.far,
            **self._maker.facts(index),
            "share_matched": depth.num_valid / depth.ranges.size,
            "reused": reused,
        }

    def bytes_of(self, index: int) -> float:
        """Bytes that `make` needs of a view, at least."""
        return self._maker.bytes_of(index)

    def _path(self, view: View) -> Path:
        return self._work / self._maker.name(view)

    def read(self, index: int) -> DepthMap:
        """A depth map that was made.

        Raises:
            InputError: it was not, or not of these images and this calibration.
        """
        view = self.views[index]
        depth = read_depth_map(self._path(view), self._maker.key(index))
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
            self._calibration(index, depth),
            frozenset({(view.camera, view.frame), *view.others}),
        )

    def _calibration(self, index: int, depth: DepthMap) -> Any:
        height, width = depth.ranges.shape
        found = np.zeros((height, width), dtype=np.float32)
        view, error = self.views[index], self._errors[index]
        if error is None:
            return found
        rows = max(1, 200_000 // width)
        camera, factor = self.camera(view), self._maker.factor(view.camera)
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            values = error.stddev(
                factor * pixel_rows(camera, top, bottom),
                depth.ranges[top:bottom].ravel(),
            )
            found[top:bottom] = values.reshape(bottom - top, width)
        return np.nan_to_num(found)

    def prepare_errors(self) -> None:
        """Find what calibration and poses add, before `placed` is called."""
        if self.is_stereo:
            of_pairs = {key: self._pair_error(key) for key in self._pairs()}
            self._errors = [of_pairs[view.pair] for view in self.views]
        else:
            propagation = Propagation(self._calibrated)
            self._errors = range_errors(self.model.scene, propagation, self.views)

    def largest_errors(self) -> dict[tuple[int, int], float | None]:
        """What `prepare_errors` found at most, of each pair of cameras."""
        found: dict[tuple[int, int], float | None] = dict.fromkeys(self._pairs())
        for view, error in zip(self.views, self._errors, strict=True):
            if error is not None:
                found[view.pair] = max(found[view.pair] or 0.0, error.largest)
        return found

    def _pairs(self) -> list[tuple[int, int]]:
        return sorted({view.pair for view in self.views})

    def _pair_error(self, pair: tuple[int, int]) -> RangeError | None:
        covariance = self._calibrated.covariance
        if not (covariance.determined and len(covariance.border)):
            return None
        of_pair = [view for view in self.views if view.pair == pair]
        return calibration_error(
            self.model.scene,
            covariance,
            pair,
            0.8 * min(view.near for view in of_pair),
            1.5 * max(view.far for view in of_pair),
        )
