"""Values of images at places between their pixels."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array

FOLD = 4096
"""cv2.remap wants its positions as an image of limited width: they are folded."""
_OUTSIDE = -10.0


def sampled(
    image: NDArray[Any],
    at: NDArray[Any],
    border: int = cv2.BORDER_CONSTANT,
    *,
    nearest: bool = False,
) -> NDArray[Any]:
    """Values (h, w, ...) of an image at places (h, w, 2), pixel centres at integers.

    Bilinear, or of the nearest pixel.

    Args:
        image: (H, W) or (H, W, C).
        at: x and y in single precision.
        border: what there is outside; with OpenCV's constant border, NaN, beside NaN
            likewise.
        nearest: take the nearest pixel.
    """
    found = cv2.remap(
        image,
        at[..., 0],
        at[..., 1],
        cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR,
        borderMode=border,
        borderValue=[float("nan")] * 4,
    )
    return np.asarray(found)


def looked_up(
    image: NDArray[Any],
    xy: Array,
    border: int = cv2.BORDER_CONSTANT,
    *,
    nearest: bool = False,
) -> NDArray[Any]:
    """`sampled` at pixels (N, 2) in any order, NaN is outside: (N, ...)."""
    count = len(xy)
    if not count:
        return np.empty((0, *image.shape[2:]), dtype=image.dtype)
    at = np.full((-(-count // FOLD) * FOLD, 2), _OUTSIDE, dtype=np.float32)
    at[:count] = np.nan_to_num(xy - 0.5, nan=_OUTSIDE, posinf=_OUTSIDE, neginf=_OUTSIDE)
    folded = np.clip(at, _OUTSIDE, 1e6).reshape(-1, FOLD, 2)
    values = sampled(image, folded, border, nearest=nearest)
    return values.reshape(-1, *image.shape[2:])[:count]
