"""Numbers in images and the light that they stand for.

Attenuation and veil act on light; images store it encoded. Cameras' JPEG and PNG files
are taken as sRGB (IEC 61966-2-1); what a camera does beyond that (tone curves,
contrast) is not undone.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Light = NDArray[np.float64]
"""Linear, 1 is white."""


def _srgb_decoded(values: Light) -> Light:
    low = values / 12.92
    return np.where(values <= 0.04045, low, ((values + 0.055) / 1.055) ** 2.4)


def _srgb_encoded(light: Light) -> Light:
    high = 1.055 * np.maximum(light, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, high)


_CURVES: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "srgb": (_srgb_decoded, _srgb_encoded),
    "sqrt": (np.square, np.sqrt),  # what uwsfm simulate renders
    "linear": (np.array, np.array),
}
ENCODINGS = tuple(_CURVES)


def light_of(values: NDArray[Any], encoding: str) -> Light:
    """Linear light of 8 or 16 bit values (any shape)."""
    white = np.iinfo(values.dtype).max
    decode, _ = _CURVES[encoding]
    if values.size <= white + 1:
        return decode(values / white)
    return decode(np.arange(white + 1) / white)[values]


def values_of(light: ArrayLike, encoding: str, dtype: Any = np.uint8) -> NDArray[Any]:
    """Values of linear light, cut off at black and white; NaN becomes black."""
    white = np.iinfo(dtype).max
    _, encode = _CURVES[encoding]
    clipped = np.clip(np.nan_to_num(np.asarray(light, dtype=np.float64)), 0.0, 1.0)
    return np.rint(white * encode(clipped)).astype(dtype)
