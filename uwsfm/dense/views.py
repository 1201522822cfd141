"""Which images get a depth map, from which partner, and which others can check it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from uwsfm.colmap.model import Model
from uwsfm.dense.rectify import Pair, rectifications
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene
from uwsfm.sfm.frontend.pixels import read_color, size_fault

MIN_POINTS = 10
"""Of a frame, to know its depths from; with fewer those of all frames serve."""
NUM_SOURCES = 6
"""Neighbouring frames that one camera's image is compared with."""
MIN_PARALLAX, GOOD_PARALLAX, MAX_PARALLAX = 0.03, 0.12, 0.8
"""Angles between the sights of a point: too little for its depth, enough, and so much
that it looks like another."""
MAX_CANDIDATES = 60
"""Frames that share most points, among which neighbours are chosen."""
DEPTH_PERCENTILES = (1.0, 99.0)
DEPTH_MARGIN = 0.15
"""Of the inverse depths, on both sides: the scene goes on between its points."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One depth map to make."""

    camera: int
    """The left one, whose pixels have depths."""
    frame: int
    name: str
    """Path of the image below the image folder."""
    others: tuple[tuple[int, int], ...]
    """Camera and frame of the images it is compared with: that of the other camera of a
    pair, or neighbouring frames of the same camera."""
    other_names: tuple[str, ...]
    near: float
    """Depths along the axis of the camera, metres."""
    far: float

    @property
    def pair(self) -> tuple[int, int]:
        """Its camera and another one of the same frame; twice its own if none is."""
        beside = (c for c, frame in self.others if frame == self.frame)
        return self.camera, next(beside, self.camera)

    @property
    def is_stereo(self) -> bool:
        """Whether it is compared with the other camera of a pair, and nothing else."""
        return len(self.others) == 1


def stereo_views(model: Model) -> tuple[list[View], dict[tuple[int, int], str]]:
    """Depth maps of all pairs of cameras that see enough together.

    Returns:
        The views, and why a pair of cameras was left out.

    Raises:
        InputError: no pair remains.
    """
    scene, rig = model.scene, model.rig
    views: list[View] = []
    refused: dict[tuple[int, int], str] = {}
    depths = scene.points_in_cam()[:, 2]
    for left in range(len(scene.cameras)):
        for right in range(left + 1, len(scene.cameras)):
            of_left = depths[scene.camera_idx == left]
            if not np.isfinite(of_left).any():
                refused[left, right] = "the first one sees no point"
                continue
            try:
                rectifications(pair_of(model, left, right, *_limits(of_left)))
            except InputError as error:
                refused[left, right] = str(error)
                continue
            for frame in range(scene.num_frames):
                if model.has_image(left, frame) and model.has_image(right, frame):
                    rows = (scene.camera_idx == left) & (scene.frame_idx == frame)
                    own = depths[rows & np.isfinite(depths)]
                    near, far = _limits(own if len(own) >= MIN_POINTS else of_left)
                    views.append(
                        View(
                            camera=left,
                            frame=frame,
                            name=model.image_name(left, frame),
                            others=((right, frame),),
                            other_names=(model.image_name(right, frame),),
                            near=near,
                            far=far,
                        )
                    )
    if not views:
        reasons = "; ".join(
            f"{rig.cameras[a].name} and {rig.cameras[b].name}: {reason}"
            for (a, b), reason in refused.items()
        )
        raise InputError(
            "no two cameras can be compared: "
            + (reasons or "no frame has images of two cameras")
        )
    return views, refused


def image_views(model: Model) -> list[View]:
    """Depth maps of all images, each from others that see the same from elsewhere.

    Raises:
        InputError: no image has two such neighbours.
    """
    scene = model.scene
    seen = _points_of_images(scene)
    depths = scene.points_in_cam()[:, 2]
    views = []
    for camera in range(len(scene.cameras)):
        for frame in range(scene.num_frames):
            if not model.has_image(camera, frame):
                continue
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            own = depths[rows & np.isfinite(depths)]
            if len(own) < MIN_POINTS:
                continue
            chosen = [
                other
                for other in _partners(scene, seen, (camera, frame))
                if model.has_image(*other)
            ][:NUM_SOURCES]
            if len(chosen) < 2:
                continue
            near, far = _limits(own)
            views.append(
                View(
                    camera=camera,
                    frame=frame,
                    name=model.image_name(camera, frame),
                    others=tuple(chosen),
                    other_names=tuple(model.image_name(*other) for other in chosen),
                    near=near,
                    far=far,
                )
            )
    if not views:
        raise InputError(
            "no frame can be compared: depth takes at least two other images that see "
            "the same points from elsewhere, such as neighbouring frames"
        )
    return views


def _partners(
    scene: Scene, seen: csr_array, image: tuple[int, int]
) -> list[tuple[int, int]]:
    """Images to compare one with, the most useful first: camera and frame.

    Each adds points with parallax, and those that others have seen already count less:
    so all of the image is seen by some.

    Args:
        scene: the reconstruction.
        seen: of `_points_of_images`.
        image: camera and frame.
    """
    index = image[0] * scene.num_frames + image[1]
    points = seen[[index]].indices
    points = points[np.isfinite(scene.points[points]).all(axis=1)]
    shared = seen[:, points]
    counts = np.asarray(shared.sum(axis=1)).ravel()
    counts[index] = 0.0
    candidates = np.argsort(-counts, kind="stable")[:MAX_CANDIDATES]
    candidates = candidates[counts[candidates] >= MIN_POINTS]
    if not len(candidates):
        return []

    def sights(other: int) -> Array:
        camera, frame = divmod(int(other), scene.num_frames)
        pose = rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world[frame])
        sight = scene.points[points] - rigid3.inverse(pose)[4:]
        return sight / np.linalg.norm(sight, axis=1, keepdims=True)

    own = sights(index)
    worth = shared[candidates].toarray()
    for row, other in zip(worth, candidates, strict=True):
        angle = np.arccos(np.clip(np.sum(own * sights(other), axis=1), -1.0, 1.0))
        row *= np.clip(angle / GOOD_PARALLAX, 0.0, 1.0) * (angle > MIN_PARALLAX)
        row *= np.clip((MAX_PARALLAX - angle) / (0.5 * MAX_PARALLAX), 0.05, 1.0)
    needed = np.ones(len(points))
    found: list[tuple[int, int]] = []
    for _ in range(min(len(candidates), 2 * NUM_SOURCES)):
        gains = worth @ needed
        best = int(np.argmax(gains))
        if gains[best] < 1.0:
            break
        camera, frame = divmod(int(candidates[best]), scene.num_frames)
        found.append((camera, frame))
        needed *= 1.0 - 0.5 * np.clip(worth[best], 0.0, 1.0)
        worth[best] = 0.0
    return found


def pair_of(model: Model, left: int, right: int, near: float, far: float) -> Pair:
    """Two cameras of a rig."""
    scene = model.scene
    return Pair(
        left=scene.cameras[left],
        right=scene.cameras[right],
        right_from_left=rigid3.compose(
            scene.cam_from_rig[right], rigid3.inverse(scene.cam_from_rig[left])
        ),
        near=near,
        far=far,
    )


def cam_from_world(model: Model, camera: int, frame: int) -> Array:
    """Pose (7,) of an image."""
    return rigid3.compose(
        model.scene.cam_from_rig[camera], model.scene.rig_from_world[frame]
    )


def neighbours(model: Model, views: list[View], limit: int) -> list[list[int]]:
    """For each view the indices of those that share most points with it."""
    shared = _shared_points(model.scene)
    of_frame: dict[int, list[int]] = {}
    for index, view in enumerate(views):
        of_frame.setdefault(view.frame, []).append(index)
    found = []
    for index, view in enumerate(views):
        row = shared[[view.frame]].tocoo()
        counts = dict(zip(row.coords[1].tolist(), row.data.tolist(), strict=True))
        # Other pairs of the same frame come first: they see the same.
        frames = sorted(counts, key=lambda f: (f != view.frame, -counts[f], f))
        near = [i for f in frames for i in of_frame.get(f, []) if i != index]
        found.append(near[:limit])
    return found


def _seen_points(rows: NDArray[Any], num_rows: int, scene: Scene) -> csr_array:
    """Which points some rows, images or frames, see (num_rows, N).

    Args:
        rows: (M,) row of each observation.
        num_rows: how many there are.
        scene: the reconstruction.
    """
    pairs = np.unique(np.stack([rows, scene.point_idx], axis=1), axis=0)
    shape = num_rows, scene.num_points
    ones = np.ones(len(pairs))
    return coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape).tocsr()


def _points_of_images(scene: Scene) -> csr_array:
    """Which points images see, row camera * F + frame, (C * F, N)."""
    images = scene.camera_idx * scene.num_frames + scene.frame_idx
    return _seen_points(images, len(scene.cameras) * scene.num_frames, scene)


def _shared_points(scene: Scene) -> csr_array:
    """How many points two frames share, (F, F)."""
    seen = _seen_points(scene.frame_idx, scene.num_frames, scene)
    return (seen @ seen.T).tocsr()


def image_path(folder: Path, name: str) -> Path:
    """Of an image of the model.

    Raises:
        InputError: it is missing.
    """
    path = folder / name
    if not path.is_file():
        raise InputError(f"image {path} is missing: say with --images where it is")
    return path


def load_image(model: Model, folder: Path, camera: int, name: str):
    """An image (H, W, 3), blue, green, red.

    Raises:
        InputError: it is missing, damaged, or of another size than its camera's.
    """
    path = image_path(folder, name)
    image = read_color(path)
    lens = model.scene.cameras[camera]
    fault = size_fault(path, image, (lens.width, lens.height))
    if fault is not None:
        raise InputError(fault)
    return image


def _limits(depths: Array) -> tuple[float, float]:
    """Nearest and farthest depth of a scene from those of its points."""
    near, far = np.nanpercentile(depths, DEPTH_PERCENTILES)
    margin = DEPTH_MARGIN * max(1.0 / near - 1.0 / far, 0.2 / near)
    closest = 1.0 / near + margin
    return 1.0 / closest, 1.0 / max(1.0 / far - margin, 0.3 / far)
