"""Depth maps by PatchMatch, of images of any cameras, in two passes over all of them.

The first finds hypotheses by likeness alone, the second goes on from there with what
the neighbours found at hand: what they object to becomes dear. Hypotheses wait in the
workspace, so that a run that was stopped goes on.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm.colmap.model import Model
from uwsfm.dense.depth_map import DepthMap, read_planes, write_planes
from uwsfm.dense.patchmatch_depth import (
    Hypotheses,
    Neighbour,
    PatchMatch,
    depth_map_of,
    patchmatch_bytes,
)
from uwsfm.dense.reduced import Reduced
from uwsfm.dense.views import View, cam_from_world
from uwsfm.dense.warp import Placement
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.sfm.steps import fingerprint

FORMAT = 8
"""Of the hypotheses and of what is made of them: others are made again."""
KEPT_IMAGES = 16
"""Grey images in memory."""


class PatchMatchMaps:
    """Depth maps of the views of `image_views`.

    Args:
        model: the reconstruction.
        images: folder of its images.
        work: folder of the hypotheses.
        views: one per image.
        max_pixels: larger images are reduced by a whole number.
    """

    bytes_on_disk = 37
    """Per pixel: two floats in single precision, three of a normal, one of the spread,
    a mark, and a quarter of three of the first pass."""
    has_search = True
    is_stereo = False

    def __init__(
        self,
        model: Model,
        images: Path,
        work: Path,
        views: list[View],
        max_pixels: float,
    ) -> None:
        self._model, self._work = model, work
        self._views = views
        self._reduced = Reduced(model, images, max_pixels)
        self.camera, self.factor = self._reduced.camera, self._reduced.factor
        self.color = self._reduced.image
        # Neighbours are needed again and again, and large images take long to read.
        self._gray = lru_cache(KEPT_IMAGES)(self._reduced.gray)
        self._index = {(view.camera, view.frame): i for i, view in enumerate(views)}

    def name(self, view: View) -> str:
        """File of its depth map."""
        return f"{view.frame:06d}_{view.camera}-patchmatch.npz"

    def facts(self, index: int) -> dict[str, Any]:
        """What the summary reports of rectified images: there are none."""
        return {"num_slabs": None, "deviation_px": None}

    def search(self, index: int) -> None:
        """The first pass over a view, unless its hypotheses are there."""
        path, key = self._path(index), self.search_key(index)
        if read_planes(path, key) is not None:
            return
        planes = self._patchmatch(index).search(self._points(index))
        write_planes(path, key, {"planes": planes})

    def depth(self, index: int, budget: float) -> DepthMap:
        """The second pass; the first must have been made of all views."""
        view = self._views[index]
        found = [self._hypotheses(other) for other in view.others]
        nothing = np.full((1, 1, 3), np.nan, dtype=np.float32)
        known = [nothing if planes is None else planes for planes in found]
        planes = self._hypotheses((view.camera, view.frame))
        assert planes is not None, "the first pass comes first"
        settled = self._patchmatch(index, known).settled(planes)
        return depth_map_of(self.camera(view.camera), *settled)

    def key(self, index: int) -> str:
        """Of all that a depth map depends on: hypotheses of its own and of others."""
        view = self._views[index]
        own = (view.camera, view.frame)
        near = [self._index[o] for o in (own, *view.others) if o in self._index]
        return fingerprint([FORMAT, [self.search_key(i) for i in near]])

    def search_key(self, index: int) -> str:
        """Of all that the first pass depends on."""
        view = self._views[index]
        poses = [pose.tolist() for pose in self._poses(view)]
        return fingerprint([FORMAT, self._reduced.content(view), poses])

    def bytes_of(self, index: int) -> float:
        """What a pass needs of a view."""
        view = self._views[index]
        full = self._model.scene.cameras[view.camera]
        images = 4.0 * full.width * full.height  # one at a time, read and grey
        small = self.camera(view.camera)
        images += KEPT_IMAGES * small.width * small.height
        return images + patchmatch_bytes(small, len(view.others))

    def _patchmatch(
        self, index: int, planes: list[Hypotheses] | None = None
    ) -> PatchMatch:
        view = self._views[index]
        nothing: list[Hypotheses | None] = [None] * len(view.others)
        known = nothing if planes is None else planes
        neighbours = [
            Neighbour(
                placement=Placement(camera=self.camera(camera), from_reference=pose),
                image=self._gray(camera, name),
                planes=found,
            )
            for (camera, _), name, pose, found in zip(
                view.others, view.other_names, self._poses(view), known, strict=True
            )
        ]
        return PatchMatch(
            self.camera(view.camera),
            self._gray(view.camera, view.name),
            neighbours,
            (view.near, view.far),
            seed=index,
        )

    def _points(self, index: int) -> Array:
        """Where the view sees points of the model (N, 3): pixel and inverse depth."""
        view, scene = self._views[index], self._model.scene
        rows = (scene.camera_idx == view.camera) & (scene.frame_idx == view.frame)
        points = scene.points[scene.point_idx[rows]]
        pose = cam_from_world(self._model, view.camera, view.frame)
        in_cam = rigid3.transform(pose, points)
        xy, valid = self.camera(view.camera).img_from_point(in_cam)
        found = np.column_stack([xy, 1.0 / in_cam[:, 2]])
        return found[valid & np.isfinite(found).all(axis=1)]

    def _poses(self, view: View) -> list[Array]:
        own = rigid3.inverse(cam_from_world(self._model, view.camera, view.frame))
        return [
            rigid3.compose(cam_from_world(self._model, *other), own)
            for other in view.others
        ]

    def _hypotheses(self, image: tuple[int, int]) -> Hypotheses | None:
        if image not in self._index:
            return None
        index = self._index[image]
        found = read_planes(self._path(index), self.search_key(index))
        return None if found is None else found["planes"]

    def _path(self, index: int) -> Path:
        view = self._views[index]
        return self._work / f"{view.frame:06d}_{view.camera}-search.npz"
