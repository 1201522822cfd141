"""Colours of points and images without the water."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.color.encoding import Light, light_of, values_of
from uwsfm.color.samples import Samples
from uwsfm.color.water_fit import Water
from uwsfm.export.image_depth import ImageDepth
from uwsfm.geometry.rigid3 import Array

_BRIGHT_PERCENTILE, _BRIGHT = 99.0, 0.9
_GRID_PX = 4  # ranges change slowly over an image; they are looked up this far apart


@dataclass(frozen=True, kw_only=True)
class Correction:
    """The water, and what light is multiplied by to be shown."""

    water: Water
    gains: Array
    """(3,) of red, green and blue; equal unless the white balance changes them."""
    encoding: str

    def values(self, light: Light, ranges: Array, dtype=np.uint8) -> NDArray:
        """Encoded values (..., 3) of light seen over ranges (...)."""
        return values_of(
            self.gains * self.water.without_water(light, ranges), self.encoding, dtype
        )


def make_correction(
    water: Water, samples: Samples, encoding: str, *, gray: bool
) -> Correction:
    """Choose gains so that the brightest points are nearly white.

    Args:
        water: of the dive.
        samples: its points' brightness.
        encoding: of the images, and of what is written.
        gray: make the median point grey: guesses the colour of the light that comes
            down through the water, which no range tells.
    """
    clear = water.without_water(samples.light, samples.range)
    balance = np.ones(3)
    if gray:
        median = np.nanmedian(clear, axis=0)
        balance = median.mean() / np.maximum(median, 1e-6)
    bright = np.nanpercentile((balance * clear).max(axis=1), _BRIGHT_PERCENTILE)
    return Correction(
        water=water, gains=balance * _BRIGHT / max(bright, 1e-6), encoding=encoding
    )


def point_colors(
    correction: Correction, samples: Samples, num_points: int
) -> NDArray[np.uint8]:
    """Colours (P, 3) of the points of the adjustment, from all their images.

    The nearer the image, the more it counts: its noise is enlarged least.
    """
    water = correction.water
    fades = [np.exp(-c.attenuation * samples.range) for c in water.channels]
    weights = np.stack(fades, axis=1) ** 2
    clear = water.without_water(samples.pixel_light, samples.range)
    mean = np.zeros((num_points, 3))
    for k in range(3):
        top = np.bincount(samples.point_idx, weights[:, k] * clear[:, k], num_points)
        bottom = np.bincount(samples.point_idx, weights[:, k], num_points)
        mean[:, k] = top / np.maximum(bottom, 1e-300)
    return values_of(correction.gains * mean, correction.encoding)


def corrected_colors(
    correction: Correction, colors: NDArray[np.uint8], ranges: Array
) -> NDArray[np.uint8]:
    """Colours (N, 3) that were seen over ranges (N,); as they were where it is NaN."""
    found = correction.values(light_of(colors, correction.encoding), ranges)
    return np.where(np.isfinite(ranges)[:, None], found, colors)


def corrected_image(
    correction: Correction, image: NDArray, xy: Array, ranges: Array, fallback: float
) -> tuple[NDArray, float]:
    """An image without the water, by the range interpolated between its points.

    Args:
        correction: what to undo.
        image: (height, width, 3) RGB, 8 or 16 bit.
        xy: (n, 2) pixels of its points.
        ranges: (n,) through the water.
        fallback: range of an image without points.

    Returns:
        The image, and the share of it that points surround: elsewhere, the range is
        that of the nearest points.
    """
    height, width = image.shape[:2]
    depth = ImageDepth(xy, 1.0 / ranges, (width, height), 1.0 / fallback)
    rows, columns = -(-height // _GRID_PX), -(-width // _GRID_PX)
    x = (np.arange(columns) + 0.5) * (width / columns)
    y = (np.arange(rows) + 0.5) * (height / rows)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    coarse = (1.0 / depth.inverse(grid)).reshape(rows, columns)
    fine = np.asarray(cv2.resize(coarse, (width, height)), dtype=np.float64)
    share = float(np.mean(depth.is_between_points(grid)))
    light = light_of(image, correction.encoding)
    return correction.values(light, fine, image.dtype), share
