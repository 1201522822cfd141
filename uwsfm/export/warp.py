"""Images as the virtual pinhole of `uwsfm.export.pinhole` would have taken them.

Every pixel's ray is followed to the interpolated depth of the scene, and its point
projected exactly through the port into the real image.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import replaced_file
from uwsfm._base.paths import inside
from uwsfm.errors import InputError
from uwsfm.export.image_depth import ImageDepth
from uwsfm.export.pinhole import img_from_virtual
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.rig_checks.pinhole_fit import VirtualPinhole

_BAND_PIXELS = 500_000
"""Projected at a time: bounds the memory of large images."""
_JPEG_QUALITY = 98
# cv2.remap addresses pixels by 16-bit integers.
_MAX_SIDE = 32_000
Image = NDArray[Any]
"""(height, width) or (height, width, channels), as stored."""


def warp_maps(
    camera: RefractiveCamera, pinhole: VirtualPinhole, depth: ImageDepth
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where each pixel of the virtual image comes from.

    Returns:
        Real pixels (height, width, 2), NaN where there are none, and a mask (height,
        width) of the pixels that come from inside the real image and whose depth lies
        between those of points.
    """
    width, height = pinhole.width, pinhole.height
    maps = np.empty((height, width, 2), dtype=np.float32)
    known = np.empty((height, width), dtype=bool)
    columns = np.arange(width) + 0.5
    step = max(1, _BAND_PIXELS // width)
    for top in range(0, height, step):
        rows = np.arange(top, min(top + step, height)) + 0.5
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        xy, valid = img_from_virtual(camera, pinhole, grid, depth)
        inside = valid & np.all((xy >= 0) & (xy <= (camera.width, camera.height)), 1)
        shape = len(rows), width
        maps[top : top + len(rows)] = xy.reshape(*shape, 2)
        known[top : top + len(rows)] = (inside & depth.is_between_points(grid)).reshape(
            shape
        )
    return maps, known


def warp_image(image: Image, maps: NDArray[np.float32]) -> Image:
    """An image seen from the virtual pinhole; black where nothing was photographed.

    Things land within 0.03 px of where they should (cubic interpolation as OpenCV
    has it: 0.06 px).
    """
    # COLMAP -> OpenCV pixel origin; far outside is outside.
    sources = np.nan_to_num(maps - np.float32(0.5), nan=-10.0)
    return cv2.remap(
        image,
        sources[..., 0],
        sources[..., 1],
        interpolation=cv2.INTER_LANCZOS4,
        borderMode=cv2.BORDER_CONSTANT,
    )


def read_image(path: Path, camera: RefractiveCamera) -> Image:
    """An image as it was reconstructed: raw, not turned by its EXIF.

    Raises:
        InputError: there is none, or it is not one of this camera's.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such image")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"{path}: not an image that can be read")
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{path}: is {width} x {height}, but its camera takes "
            f"{camera.width} x {camera.height}"
        )
    if max(width, height) > _MAX_SIDE:
        raise InputError(f"{path}: images beyond {_MAX_SIDE} pixels cannot be warped")
    return image


def write_image(folder: Path, name: str, image: Image) -> None:
    """Write an image in the format of its suffix.

    Args:
        folder: where the images go.
        name: of the model, with its folder: nothing outside of ``folder`` is written.
        image: as OpenCV has it.

    Raises:
        InputError: the name leads out of the folder, the format is unknown, or the
            file cannot be written.
    """
    path = inside(folder, name)
    options = []
    if path.suffix.lower() in (".jpg", ".jpeg"):
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    with replaced_file(path) as partial:
        try:
            written = cv2.imwrite(str(partial), image, options)
        except cv2.error:
            written = False
        if not written:
            raise InputError(
                f"cannot write {path.name}: its format or the disk refuses"
            )
