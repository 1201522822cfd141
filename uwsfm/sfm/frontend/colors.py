"""Colours of points, from the images they were seen in."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import replaced_file
from uwsfm._base.paths import inside
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.frontend.background import DAMAGE, damaged
from uwsfm.sfm.frontend.pixels import read_color

Colors = NDArray[np.uint8]
"""(N, 3) RGB"""


def point_colors(
    scene: Scene, image_paths: list[list[Path]], progress: Progress = silent
) -> Colors:
    """Mean colour of each point's observations.

    Args:
        scene: its observations.
        image_paths: [camera][frame].
        progress: called once per image.

    Returns:
        RGB (P, 3).

    Raises:
        InputError: an image can no longer be read.
    """

    def seen(camera: int, frame: int, rows: IndexArray) -> Colors:
        path = image_paths[camera][frame]
        image = read_color(path)
        if image is None:
            raise InputError(f"image {path} can no longer be read")
        progress("colours", camera * scene.num_frames + frame + 1, num_images)
        return pixel_colors(image, scene.xy[rows])

    num_images = len(image_paths) * scene.num_frames
    return _mean(scene, seen)


def stored_point_colors(
    scene: Scene,
    keypoint_idx: IndexArray,
    image_names: list[list[str]],
    colors_dir: Path,
) -> Colors:
    """`point_colors` from what was found beneath the keypoints.

    Args:
        scene: its observations.
        keypoint_idx: (N,) of the observations, within their images.
        image_names: [camera][frame].
        colors_dir: has their colours.

    Raises:
        UwsfmError: the folder lacks an image, or keypoints of it.
    """

    def seen(camera: int, frame: int, rows: IndexArray) -> Colors:
        path = colors_path(colors_dir, image_names[camera][frame])
        try:
            return np.load(path)[keypoint_idx[rows]]
        except (*DAMAGE, IndexError) as error:
            raise damaged(colors_dir, error) from None

    return _mean(scene, seen)


def _mean(scene: Scene, seen: Callable[[int, int, IndexArray], Colors]) -> Colors:
    """Of what ``seen(camera, frame, observations)`` gives, if there are any."""
    total = np.zeros((scene.num_points, 3))
    count = np.bincount(scene.point_idx, minlength=scene.num_points)
    num_frames = scene.num_frames
    image = scene.camera_idx * num_frames + scene.frame_idx
    order = np.argsort(image, kind="stable")
    ends = np.searchsorted(image[order], np.arange(len(scene.cameras) * num_frames + 1))
    for i, (begin, end) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        if begin < end:
            rows = order[begin:end]
            colors = seen(i // num_frames, i % num_frames, rows)
            np.add.at(total, scene.point_idx[rows], colors)
    return np.round(total / np.maximum(count, 1)[:, None]).astype(np.uint8)


def pixel_colors(image: NDArray[np.uint8], xy: NDArray) -> Colors:
    """Of the pixels that hold some positions: centres are at half-integers.

    Args:
        image: (height, width, 3) blue, green, red.
        xy: (N, 2)
    """
    column, row = np.floor(xy).astype(np.int64).T
    column = np.clip(column, 0, image.shape[1] - 1)
    row = np.clip(row, 0, image.shape[0] - 1)
    return np.ascontiguousarray(image[row, column, ::-1])


def colors_path(colors_dir: Path, image_name: str) -> Path:
    return inside(colors_dir, f"{image_name}.npy")


def write_colors(colors_dir: Path, image_name: str, colors: Colors) -> None:
    """Keep the colours beneath the keypoints of an image."""
    path = colors_path(colors_dir, image_name)
    with replaced_file(path) as partial, partial.open("wb") as file:
        np.save(file, colors)
