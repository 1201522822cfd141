"""The water of a dive: all channels, and whether the images determine it."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uwsfm.color.encoding import Light
from uwsfm.color.samples import Samples
from uwsfm.color.water import CHANNELS, ChannelFit, fit_channel
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import Mask

ASSUMED = (
    "light that does not move with the camera (no lamps), one exposure and white "
    "balance for all images, the encoding that is named, surfaces that look alike from "
    "all sides"
)
_DETERMINED = 0.25
"""A coefficient is determined if its standard deviation is at most this share of it."""
_MAX_COLOR_ERROR = 0.1
"""Colours are corrected if nearest and farthest points are off against each other by at
most this share (one standard deviation)."""
_LAMPS, _TELLS_LAMPS = 1.0, 0.4
"""Light falls with the second power of the range from lamps, with none from the sky:
half of it, and the largest standard deviation that tells them apart."""
_MAX_SAMPLES = 60_000
"""More would only take longer: errors that samples share are what is left."""
_BRIGHTNESS = 0.05
"""Differences between images that are told."""


@dataclass(frozen=True, kw_only=True)
class Water:
    """What the water does to light."""

    channels: tuple[ChannelFit, ...]
    """Red, green, blue."""
    lamp_exponent: tuple[float, float]
    """Power of the range that the light falls with, beside the attenuation, and its
    standard deviation: 0 from the sky, 2 from lamps at the camera."""
    ranges: tuple[float, float, float]
    """5th, 50th and 95th percentile of the ranges."""
    num_samples: int
    num_points: int
    brightness: Array
    """(images,) share by which each image is brighter than the water explains; NaN of
    images with few points."""

    @property
    def near_to_far_error(self) -> Array:
        """(3,) standard deviation of the colour of far points against near ones, as a
        share."""
        near, _, far = self.ranges
        return np.array([(far - near) * c.stddevs[0] for c in self.channels])

    @property
    def moves_with_lamps(self) -> bool | None:
        """Whether the light comes from lamps at the camera; None: cannot be told."""
        exponent, stddev = self.lamp_exponent
        return exponent > _LAMPS if stddev <= _TELLS_LAMPS else None

    def problem(self) -> str | None:
        """Why colours cannot be corrected, in one sentence, or None."""
        if self.moves_with_lamps:
            exponent, stddev = self.lamp_exponent
            return (
                f"the water's colour is not determined: the light falls with the power "
                f"{exponent:.1f} ± {stddev:.1f} of the range, as that of lamps at the "
                "camera does (2), and day light does not (0)"
            )
        worst = int(np.argmax(self.near_to_far_error))
        error = float(self.near_to_far_error[worst])
        if error <= _MAX_COLOR_ERROR:
            return None
        near, _, far = self.ranges
        return (
            f"the water's colour is not determined: from {near:.2g} to {far:.2g}, "
            f"{CHANNELS[worst]} would be off by {error:.0%} (one standard deviation); "
            "points must be seen from near and from far"
        )

    def warnings(self) -> list[str]:
        """What the user should know, one sentence each."""
        found = []
        if self.moves_with_lamps is None:
            found.append(
                "whether the light moves with the camera cannot be told from these "
                "ranges: if there were lamps, the correction is wrong"
            )
        spread = np.nanmax(np.abs(self.brightness), initial=0.0)
        if spread > _BRIGHTNESS:
            found.append(
                f"images differ in brightness by up to {spread:.0%}, which the water "
                "does not explain: exposure, white balance or light were not the same"
            )
        return found

    def without_water(self, light: Light, ranges: Array) -> Light:
        """Light (N, 3) as it would be without the water of ranges (N,)."""
        columns = [
            channel.without_water(light[..., k], ranges)
            for k, channel in enumerate(self.channels)
        ]
        return np.stack(columns, axis=-1)

    def summary(self) -> dict[str, Any]:
        """For JSON."""
        near, middle, far = self.ranges
        exponent, stddev = self.lamp_exponent
        return {
            "assumed": ASSUMED,
            "num_samples": self.num_samples,
            "num_points": self.num_points,
            "ranges": {"percentile_5": near, "median": middle, "percentile_95": far},
            "channels": {
                name: _channel_summary(channel)
                for name, channel in zip(CHANNELS, self.channels, strict=True)
            },
            "near_to_far_error": dict(
                zip(CHANNELS, self.near_to_far_error.tolist(), strict=True)
            ),
            "lamp_exponent": {"value": exponent, "stddev": stddev},
            "determined": self.problem() is None,
        }


def _channel_summary(channel: ChannelFit) -> dict[str, Any]:
    values = (channel.attenuation, channel.veil_slope, channel.backscatter)
    names = ("attenuation_per_m", "veil_slope_per_m", "backscatter_per_m")
    entries = [*zip(names, values, channel.stddevs, strict=True)]
    entries.append(("veil", *channel.veil))
    found: dict[str, dict[str, Any]] = {
        name: {
            "value": float(value) if math.isfinite(value) else None,
            "stddev": float(stddev) if math.isfinite(stddev) else None,
            "determined": bool(stddev <= _DETERMINED * value),
        }
        for name, value, stddev in entries
    }
    # Veil of open water is slope over backscatter. Errors as large as these two
    # themselves may cancel to first order, but a backscatter near zero has no bound.
    found["veil"]["determined"] &= found["backscatter_per_m"]["determined"]
    return found


def fit_water(samples: Samples) -> Water:
    """Estimate the water from points that were seen at several ranges.

    The standard deviations hold, beside what `uwsfm.color.water.fit_channel` says, what
    patches of twice the size would change: points are not seen with quite the same
    surroundings from everywhere, and that shows there.

    Raises:
        UwsfmError: too few points were seen twice.
    """
    good = np.isfinite(samples.light).all(axis=1) & np.isfinite(samples.range)
    wide = good & np.isfinite(samples.wide_light).all(axis=1)
    channels, exponents = [], []
    for k in range(3):
        channel = _fit(samples, samples.light, good, k)
        other = _fit(samples, samples.light, good, k, lamps=True)
        exponents.append((other.lamp_exponent, other.lamp_exponent_stddev))
        channels.append(_with_method_error(channel, samples, wide, k))
    value, stddev = np.array(exponents).T
    weights = 1.0 / stddev**2
    # The channels share their errors: together they are not better than the best.
    exponent = float(weights @ value / weights.sum()), float(stddev.min())
    water = Water(
        channels=tuple(channels),
        lamp_exponent=exponent,
        ranges=tuple(np.percentile(samples.range[good], [5, 50, 95]).tolist()),
        num_samples=int(np.count_nonzero(good)),
        num_points=len(np.unique(samples.point_idx[good])),
        brightness=np.empty(0),
    )
    return replace(water, brightness=_brightness(samples, good, water))


def _fit(
    samples: Samples, light: Light, rows: Mask, k: int, *, lamps: bool = False
) -> ChannelFit:
    """`fit_channel` of some samples; of many, those of points at random."""
    share = _MAX_SAMPLES / max(int(np.count_nonzero(rows)), 1)
    if share < 1.0:
        count = int(samples.point_idx.max()) + 1
        chosen = np.random.default_rng(0).random(count) < share
        rows = rows & chosen[samples.point_idx]
    return fit_channel(
        light[rows, k],
        samples.range[rows],
        samples.point_idx[rows],
        samples.image_idx[rows],
        lamps=lamps,
    )


def _with_method_error(
    channel: ChannelFit, samples: Samples, wide: Mask, k: int
) -> ChannelFit:
    """A channel with what larger patches change in its covariance."""
    lights = samples.light, samples.wide_light
    try:
        pair = [_fit(samples, light, wide, k) for light in lights]
    except UwsfmError:
        return channel  # few points, whose plain standard deviations are large
    change = np.subtract(
        *(np.array([c.attenuation, c.veil_slope, c.backscatter]) for c in pair)
    )
    return replace(channel, covariance=channel.covariance + np.outer(change, change))


def _brightness(samples: Samples, good: Mask, water: Water) -> Array:
    """Median share by which an image's points are brighter than in other images."""
    clear = water.without_water(samples.light[good], samples.range[good]).sum(axis=1)
    point = samples.point_idx[good]
    mean = np.bincount(point, clear) / np.maximum(np.bincount(point), 1)
    share = clear / np.maximum(mean[point], 1e-9) - 1.0
    image = samples.image_idx[good]
    found = np.full(int(image.max(initial=-1)) + 1, np.nan)
    for index in np.unique(image):
        rows = image == index
        if np.count_nonzero(rows) >= 20:
            found[index] = np.median(share[rows])
    return found
