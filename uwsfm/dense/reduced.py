"""Smaller images, and the cameras that see them."""

from __future__ import annotations

import copy
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.models.refractive import RefractiveCamera


def reduced_camera(camera: RefractiveCamera, factor: int) -> RefractiveCamera:
    """Of an image in which a square of pixels became one; what is over is cut off."""
    if factor == 1:
        return camera
    # A `pycolmap.Camera`, which the mathematics knows only by what it reads of it.
    lens: Any = copy.deepcopy(camera.camera)
    params = np.array(lens.params, dtype=np.float64)
    for index in (*lens.focal_length_idxs(), *lens.principal_point_idxs()):
        params[index] /= factor
    lens.params = params
    lens.width, lens.height = camera.width // factor, camera.height // factor
    return RefractiveCamera(lens, camera.port)


def reduced_image(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Means of squares of pixels, as `reduced_camera` sees them."""
    if factor == 1:
        return image
    height, width = (n // factor for n in image.shape[:2])
    cut = image[: height * factor, : width * factor]
    return cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)


def for_scale(image: NDArray[Any], scale: int) -> NDArray[Any]:
    """A grey image in float32 for a coarse scale, its border repeated to fill up."""
    plane = image.astype(np.float32)
    if scale == 1:
        return plane
    height, width = (-(-n // scale) for n in image.shape)
    pad = height * scale - image.shape[0], width * scale - image.shape[1]
    filled = cv2.copyMakeBorder(plane, 0, pad[0], 0, pad[1], cv2.BORDER_REPLICATE)
    return cv2.resize(filled, (width, height), interpolation=cv2.INTER_AREA)
