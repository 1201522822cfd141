"""How many observations of a model are right, where the images were rendered.

The true water ray of a keypoint meets the rendered floor in the point that the keypoint
is of. An observation is right if that of its track which most of the track agrees with
is projected onto it within `RIGHT_PX`; a track of which two images do not agree has no
right observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.simulate.rigs import known_cam_from_rig
from uwsfm.simulate.sequence import SequenceSpec, floor_in_view, frame_names

RIGHT_PX = 3.0
"""Features are placed to a third of a pixel; a neighbouring feature is farther off."""
SAME_PX = 0.01
"""COLMAP keeps two keypoints at one position, if it has two orientations."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """What a model sees where."""

    names: Sequence[str]
    """Of the images: folder/file."""
    image: IndexArray
    """(N,) index in ``names``."""
    xy: Array
    """(N, 2) pixels of the image file."""
    point: IndexArray
    """(N,) point of the model."""

    def num_places(self, chosen: NDArray[np.bool_] | None = None) -> int:
        """How many different positions some of them are at, by default all."""
        keys = np.column_stack([self.image, np.rint(self.xy / SAME_PX)])
        return len(np.unique(keys if chosen is None else keys[chosen], axis=0))


class TrueImages:
    """The true cameras at their true poses, over the true floor."""

    def __init__(self, spec: SequenceSpec, names: Sequence[str]) -> None:
        frame_of = {
            name: f for f, name in enumerate(frame_names(len(spec.rig_from_world)))
        }
        camera_of = {item.images: c for c, item in enumerate(spec.rig.cameras)}
        cameras, placed = spec.rig.refractive_cameras(), known_cam_from_rig(spec.rig)
        self._floor = floor_in_view(spec)
        self._images = []
        for name in names:
            folder, _, file = name.rpartition("/")
            c, pose = camera_of[folder], spec.rig_from_world[frame_of[file]]
            self._images.append((cameras[c], rigid3.compose(placed[c], pose)))

    def floor_points(self, image: int, xy: Array) -> Array:
        """What pixels (n, 2) of an image show (n, 3), NaN if that is not the floor."""
        camera, cam_from_world = self._images[image]
        world_from_cam = rigid3.inverse(cam_from_world)
        origins, dirs = camera.ray_from_img(xy)
        origins = rigid3.transform(world_from_cam, origins)
        dirs = rigid3.rotate(world_from_cam, dirs)
        distance = self._floor.cast(origins, dirs).distance
        distance = np.where(np.isfinite(distance), distance, np.nan)
        return origins + distance[:, None] * dirs

    def pixels(self, image: int, points: Array) -> Array:
        """Where an image shows points (n, 3): (n, 2)."""
        camera, cam_from_world = self._images[image]
        xy, _ = camera.img_from_point(rigid3.transform(cam_from_world, points))
        return xy


def right_ones(
    spec: SequenceSpec, seen: Observations, limit_px: float = RIGHT_PX
) -> NDArray[np.bool_]:
    """Mask (N,) of the observations that are right."""
    truth = TrueImages(spec, seen.names)
    points = np.full((len(seen.xy), 3), np.nan)
    for image in range(len(seen.names)):
        mine = np.flatnonzero(seen.image == image)
        points[mine] = truth.floor_points(image, seen.xy[mine])
    proposal, judged = _pairs_within(seen.point)
    near = np.zeros(len(proposal), dtype=bool)
    for image in range(len(seen.names)):
        mine = np.flatnonzero(seen.image[judged] == image)
        xy = truth.pixels(image, points[proposal[mine]])
        gaps = np.linalg.norm(xy - seen.xy[judged[mine]], axis=1)
        near[mine] = gaps <= limit_px  # NaN compares false
    votes = np.bincount(proposal[near], minlength=len(seen.xy))
    order = np.lexsort((-votes, seen.point))
    first = np.diff(seen.point[order], prepend=-1) != 0
    best = np.zeros(len(seen.xy), dtype=bool)
    best[order[first]] = True
    best &= votes >= 2
    right = np.zeros(len(seen.xy), dtype=bool)
    right[judged[near & best[proposal]]] = True
    return right


def _pairs_within(point: IndexArray) -> tuple[IndexArray, IndexArray]:
    """All ordered pairs of observations of one point, each with itself too."""
    order = np.argsort(point, kind="stable")
    _, start, counts = np.unique(point[order], return_index=True, return_counts=True)
    own, size = np.repeat(start, counts), np.repeat(counts, counts)  # (N,)
    first = np.repeat(np.arange(len(point)), size)
    step = np.arange(len(first)) - np.repeat(np.cumsum(size) - size, size)
    return order[first], order[own[first] + step]
