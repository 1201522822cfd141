"""Depth maps of pairs of cameras, by rectified images: fast, one image at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uwsfm.colmap.model import Model
from uwsfm.dense.depth_map import DepthMap
from uwsfm.dense.match import COST_BYTES, MULTIPLE
from uwsfm.dense.rectify import Pair, Rectification, rectifications
from uwsfm.dense.reduced import Reduced
from uwsfm.dense.stereo import BYTES_PER_PIXEL, stereo_depth
from uwsfm.dense.views import View, pair_of
from uwsfm.sfm.steps import fingerprint

FORMAT = 4
"""Format of the depth maps, and of what makes them: others are made again."""
SMALLEST_TILE = (16 * MULTIPLE) ** 2 * COST_BYTES * 512
"""Bytes of the matcher."""


class StereoMaps:
    """Depth maps of the views of `stereo_views`.

    Args:
        model: the reconstruction.
        images: folder of its images.
        views: one per pair of cameras and frame.
        max_pixels: larger images are reduced by a whole number.
    """

    bytes_on_disk = 8
    """Per pixel: two floats in single precision."""
    has_search = False
    is_stereo = True

    def __init__(
        self, model: Model, images: Path, views: list[View], max_pixels: float
    ) -> None:
        self._model, self._views = model, views
        self._reduced = Reduced(model, images, max_pixels)
        self.camera, self.factor = self._reduced.camera, self._reduced.factor
        self.color = self._reduced.image

    def name(self, view: View) -> str:
        """File of its depth map."""
        return f"{view.frame:06d}_{view.camera}-{view.others[0][0]}.npz"

    def search(self, index: int) -> None:
        """There is no first pass."""

    def depth(self, index: int, budget: float) -> DepthMap:
        """Match the pair of a view and triangulate.

        Args:
            index: of the view.
            budget: bytes that may be allocated.
        """
        view = self._views[index]
        left = self._reduced.gray(view.camera, view.name)
        right = self._reduced.gray(view.others[0][0], view.other_names[0])
        return stereo_depth(self._slabs(view), left, right, budget)

    def facts(self, index: int) -> dict[str, Any]:
        """What the summary reports of the rectified images."""
        slabs = self._slabs(self._views[index])
        return {
            "num_slabs": len(slabs),
            "deviation_px": max(slab.deviation_px for slab in slabs),
        }

    def key(self, index: int) -> str:
        """Fingerprint of everything that a depth map depends on."""
        view = self._views[index]
        # Of the rig, to the last digit, wherever the frame is.
        pair = [view.camera, view.others[0][0]]
        poses = self._model.scene.cam_from_rig[pair].tolist()
        return fingerprint([FORMAT, self._reduced.content(view), poses])

    def bytes_of(self, index: int) -> float:
        """Bytes that `depth` needs, with the smallest tiles."""
        sizes = [slab.size for slab in self._slabs(self._views[index])]
        pixels = max(width * height for width, height in sizes)
        return BYTES_PER_PIXEL * pixels + SMALLEST_TILE

    def _slabs(self, view: View) -> tuple[Rectification, ...]:
        right = view.others[0][0]
        pair = pair_of(self._model, view.camera, right, view.near, view.far)
        return rectifications(
            Pair(
                left=self.camera(view.camera),
                right=self.camera(right),
                right_from_left=pair.right_from_left,
                near=view.near,
                far=view.far,
            )
        )
