"""Values of images at places between their pixels."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array

FOLD = 4096
"""cv2.remap wants its positions as an image of limited width: they are folded."""
_OUTSIDE = -10.0


def looked_up(
    image: NDArray[Any],
    xy: Array,
    border: int = cv2.BORDER_CONSTANT,
    *,
    nearest: bool = False,
) -> NDArray[Any]:
    """Values (N, ...) of an image at pixels (N, 2).

    Bilinear, or of the nearest pixel.

    Args:
        image: (H, W) or (H, W, C).
        xy: pixels; NaN is outside.
        border: what there is outside; with OpenCV's constant border, NaN, beside NaN
            likewise.
        nearest: take the nearest pixel.
    """
    count = len(xy)
    if not count:
        return np.empty((0, *image.shape[2:]), dtype=image.dtype)
    at = np.full((-(-count // FOLD) * FOLD, 2), _OUTSIDE, dtype=np.float32)
    at[:count] = np.nan_to_num(xy - 0.5, nan=_OUTSIDE, posinf=_OUTSIDE, neginf=_OUTSIDE)
    x, y = np.moveaxis(np.clip(at, _OUTSIDE, 1e6).reshape(-1, FOLD, 2), 2, 0)
    way = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    values = cv2.remap(
        image, x, y, way, borderMode=border, borderValue=[float("nan")] * 4
    )
    return np.asarray(values).reshape(-1, *image.shape[2:])[:count]
