"""Smaller images, and the cameras that see them."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.colmap.model import Model
from uwsfm.dense.views import View, image_path, load_image
from uwsfm.models.refractive import RefractiveCamera


class Reduced:
    """The images of a model, reduced where they are larger than they need to be.

    Args:
        model: the reconstruction.
        images: folder of its images.
        max_pixels: larger images are reduced by a whole number.
    """

    def __init__(self, model: Model, images: Path, max_pixels: float) -> None:
        self._model, self._images, self._max_pixels = model, images, max_pixels

    def factor(self, camera: int) -> int:
        """Pixels of an image, across, that become one."""
        lens = self._model.scene.cameras[camera]
        return max(1, math.ceil(math.sqrt(lens.width * lens.height / self._max_pixels)))

    def camera(self, camera: int) -> RefractiveCamera:
        """The camera of the reduced images."""
        return reduced_camera(self._model.scene.cameras[camera], self.factor(camera))

    def image(self, camera: int, name: str) -> NDArray[Any]:
        """A reduced image (h, w, 3), blue, green, red."""
        image = load_image(self._model, self._images, camera, name)
        return reduced_image(image, self.factor(camera))

    def gray(self, camera: int, name: str) -> NDArray[Any]:
        """The same in grey, (h, w)."""
        return cv2.cvtColor(self.image(camera, name), cv2.COLOR_BGR2GRAY)

    def content(self, view: View) -> list[Any]:
        """What a depth map depends on besides the poses, for its key."""
        scene = self._model.scene
        used = sorted({view.camera, *(camera for camera, _ in view.others)})
        cameras = [
            (
                scene.cameras[c].lens.tolist(),
                scene.cameras[c].port.row.tolist(),
                self.factor(c),
            )
            for c in used
        ]
        files = []
        for name in (view.name, *view.other_names):
            status = image_path(self._images, name).stat()
            files.append((name, status.st_size, status.st_mtime_ns))
        return [used, cameras, files, view.near, view.far]


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
