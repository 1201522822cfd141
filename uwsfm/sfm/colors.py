"""Colours of points, from the images they were seen in."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._progress import Progress, silent
from uwsfm.errors import InputError
from uwsfm.scene import Scene


def point_colors(
    scene: Scene, image_paths: list[list[Path]], progress: Progress = silent
) -> NDArray[np.uint8]:
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
    total = np.zeros((scene.num_points, 3))
    count = np.bincount(scene.point_idx, minlength=scene.num_points)
    num_images = len(image_paths) * scene.num_frames
    for camera, paths in enumerate(image_paths):
        for frame, path in enumerate(paths):
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            if not np.any(rows):  # nothing to colour: the image need not be there
                continue
            image = cv2.imread(
                str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            )
            if image is None:
                raise InputError(f"image {path} can no longer be read")
            # The pixel that holds a position: centres are at half-integers.
            column, row = np.floor(scene.xy[rows]).astype(np.int64).T
            column = np.clip(column, 0, image.shape[1] - 1)
            row = np.clip(row, 0, image.shape[0] - 1)
            np.add.at(total, scene.point_idx[rows], image[row, column, ::-1])
            progress("colours", camera * scene.num_frames + frame + 1, num_images)
    return np.round(total / np.maximum(count, 1)[:, None]).astype(np.uint8)
