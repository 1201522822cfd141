"""Attenuation and veil of the water, from points that were seen at several ranges.

The image formation of Akkaynak & Treibitz (CVPR 2018, "Sea-thru" 2019), per channel,
in linear light, z the length of the ray in the water:

    I = J exp(-b_D z) + B (1 - exp(-b_B z))

J is what the point would look like without water. It is unknown, but the same in all
images of the point; so the change of I with z tells the water from the scene, where
Sea-thru has single images and the darkest pixels only. That J is not negative, which
its darkest pixels say, is kept.

Assumed: the light does not move (day light; no lamps at the camera), one exposure and
white balance for all images, surfaces that look alike from all sides, and coefficients
that do not depend on the range.
"""

from dataclasses import dataclass

import numpy as np

from uwsfm.color.encoding import Light
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import Mask
from uwsfm.scene import IndexArray

CHANNELS = ("red", "green", "blue")
_MAX_OPTICAL_DEPTH = 20.0
"""Of the median range: coefficients beyond it are black water."""
_MAX_STEPS = 60
# Backscatter times the median range, where the search begins: there are local minima,
# such as a veil that is the same at all ranges.
_START_DEPTHS = (0.2, 0.8, 2.5)
_NUM_FIRST_STEPS = 10
_HUBER = 2.0
_MAD_TO_STDDEV = 1.4826
# Of the noise's variance, in units of the median light: of black points, and of what
# does not fade with the range.
_FLOOR, _SENSOR = 0.05, 1e-3
_MIN_SAMPLES = 50
# Ranges whose logarithms differ by less are alike.
_ALIKE = 0.15


@dataclass(frozen=True, kw_only=True)
class ChannelFit:
    """The water in one channel; per unit of the scene's lengths, light 1 is white."""

    attenuation: float
    """b_D"""
    veil_slope: float
    """B b_B: the veil per length, near the camera."""
    backscatter: float
    """b_B"""
    covariance: Array
    """(3, 3) of these."""
    noise: float
    """Robust standard deviation of light at the median brightness."""
    lamp_exponent: float = 0.0
    """Light that falls with this power of the range, beside the attenuation: about 2 if
    lamps move with the camera. 0 unless it was estimated."""
    lamp_exponent_stddev: float = 0.0

    @property
    def stddevs(self) -> Array:
        """(3,)"""
        return np.sqrt(np.diag(self.covariance))

    @property
    def veil(self) -> tuple[float, float]:
        """B, the colour of open water, and its standard deviation; NaN if it never
        saturates."""
        if not self.backscatter > 0.0:
            return np.nan, np.nan
        value = self.veil_slope / self.backscatter
        gradient = np.array([0.0, 1.0, -value]) / self.backscatter
        variance = max(float(gradient @ self.covariance @ gradient), 0.0)
        return value, float(np.sqrt(variance))

    def veil_at(self, ranges: Array) -> Array:
        """Light scattered towards the camera over ranges (any shape)."""
        return self.veil_slope * _saturating(self.backscatter, ranges)[0]

    def without_water(self, light: Light, ranges: Array) -> Light:
        """J of I: what light seen over ranges would be without water."""
        return (light - self.veil_at(ranges)) * np.exp(self.attenuation * ranges)


def _saturating(backscatter: float, ranges: Array) -> tuple[Array, Array]:
    """(1 - exp(-b z)) / b, and its derivative by b; z and -z^2 / 2 at b = 0."""
    x = backscatter * ranges
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    share = np.where(small, 1.0 - x / 2.0, -np.expm1(-safe) / safe)
    slope = np.where(
        small, -0.5 + x / 3.0, (np.exp(-safe) * (1.0 + safe) - 1.0) / safe**2
    )
    return ranges * share, ranges**2 * slope


def fit_channel(
    light: Light,
    ranges: Array,
    point_idx: IndexArray,
    image_idx: IndexArray,
    *,
    lamps: bool = False,
) -> ChannelFit:
    """Maximum likelihood, robust, of one channel.

    The J of the points are eliminated in closed form (variable projection). Huber's
    weights hold against shadows and wrong points. Standard deviations are the larger of
    those that the residuals' scatter gives, and those that allow for errors which all
    samples of an image share.

    Args:
        light: (N,)
        ranges: (N,)
        point_idx: (N,) points that were seen once count for nothing.
        image_idx: (N,)
        lamps: estimate `ChannelFit.lamp_exponent` too.

    Raises:
        UwsfmError: there are too few points that were seen twice.
    """
    problem = _Problem(light, ranges, point_idx, image_idx)
    typical = problem.typical_range
    slope = 0.1 * float(np.median(light)) / typical
    starts = [
        np.array([0.3 * b / typical, slope, b / typical, exponent])
        for b in _START_DEPTHS
        for exponent in ((0.0, 2.0) if lamps else (0.0,))
    ]
    low = np.zeros(4)
    high = np.array([_MAX_OPTICAL_DEPTH, np.inf, _MAX_OPTICAL_DEPTH, 0.0]) / typical
    if lamps:
        low[3], high[3] = -2.0, 4.0
    tried = [_minimum(problem, start, low, high, reweight=False) for start in starts]
    best = min(tried, key=problem.cost)
    found = _minimum(problem, best, low, high, reweight=True)
    covariance = problem.covariance(found, high > low)
    return ChannelFit(
        attenuation=float(found[0]),
        veil_slope=float(found[1]),
        backscatter=float(found[2]),
        covariance=covariance[:3, :3],
        noise=problem.noise,
        lamp_exponent=float(found[3]),
        lamp_exponent_stddev=float(np.sqrt(covariance[3, 3])),
    )


def _minimum(
    problem: "_Problem", start: Array, low: Array, high: Array, *, reweight: bool
) -> Array:
    """Damped Gauss-Newton steps of four numbers in a box, with new weights each, or a
    few steps with the weights that are."""
    found, damping = start, 1e-3
    if reweight:
        problem.reweight(found)
    for _ in range(_MAX_STEPS if reweight else _NUM_FIRST_STEPS):
        cost = problem.cost(found)
        jacobian, residuals = problem.jacobian(found), problem.residuals(found)
        gradient, normal = jacobian.T @ residuals, jacobian.T @ jacobian
        while True:
            # At a bound, only steps to its inside.
            stuck = ((found <= low) & (gradient > 0)) | (
                (found >= high) & (gradient < 0)
            )
            free = np.flatnonzero(~stuck & (high > low))
            step = np.zeros(4)
            matrix = normal[np.ix_(free, free)]
            matrix = matrix + damping * np.diag(np.diag(matrix) + 1e-300)
            step[free] = -np.linalg.lstsq(matrix, gradient[free], rcond=None)[0]
            tried = np.clip(found + step, low, high)
            if problem.cost(tried) <= cost or damping > 1e8:
                break
            damping *= 10.0
        moved = np.abs(tried - found) <= 1e-5 * (np.abs(found) + 1e-3 * np.abs(start))
        found, damping = tried, max(0.1 * damping, 1e-9)
        if reweight:
            problem.reweight(found)
        if moved.all():
            break
    return found


def _num_alike(point: IndexArray, log_range: Array) -> Array:
    """How many samples of the same point are from about the same range (n,)."""
    span = float(np.ptp(log_range)) + 4.0 * _ALIKE
    key = point * span + (log_range - log_range.min())
    ordered = np.sort(key)
    first, last = (np.searchsorted(ordered, key + d) for d in (-_ALIKE, _ALIKE))
    return (last - first).astype(np.float64)


class _Problem:
    """Residuals of one channel with the points' own light eliminated.

    Parameters: attenuation, slope of the veil, backscatter, exponent of lamps.
    """

    def __init__(
        self, light: Light, ranges: Array, point_idx: IndexArray, image_idx: IndexArray
    ) -> None:
        count = np.bincount(point_idx)
        self._rows = np.flatnonzero(count[point_idx] >= 2)
        if len(self._rows) < _MIN_SAMPLES:
            raise UwsfmError(
                f"only {len(self._rows)} samples of points that were seen twice: the "
                f"water's colour needs {_MIN_SAMPLES}"
            )
        _, self._point = np.unique(point_idx[self._rows], return_inverse=True)
        self._light, self._range = light[self._rows], ranges[self._rows]
        self._num_points = int(self._point.max()) + 1
        _, self._image = np.unique(image_idx[self._rows], return_inverse=True)
        self._rows_of_image = [
            np.flatnonzero(self._image == image)
            for image in range(int(self._image.max()) + 1)
        ]
        self.typical_range = float(np.median(self._range))
        median = float(np.median(self._light))
        self._floor, self._sensor = _FLOOR * median, _SENSOR * median
        self._weights = 1.0 / (np.maximum(self._light, 0.0) + self._floor)
        self.noise = np.nan
        # Images from the same range see the same surroundings of a point: they share
        # their errors, and many of them must not outweigh the few from elsewhere.
        self._rarity = 1.0 / _num_alike(self._point, np.log(self._range))

    def _parts(self, theta: Array) -> tuple[Array, Array, Array]:
        """How the points' light fades, that light, and the residuals, (n,) each."""
        attenuation, slope, backscatter, exponent = theta
        fade = np.exp(-attenuation * self._range)
        fade *= (self._range / self.typical_range) ** -exponent
        rest = self._light - slope * _saturating(backscatter, self._range)[0]
        weighted = self._weights * fade
        top = np.bincount(self._point, weighted * rest, self._num_points)
        bottom = np.bincount(self._point, weighted * fade, self._num_points)
        own = np.maximum(top / bottom, 0.0)[self._point]
        return fade, own, rest - own * fade

    def residuals(self, theta: Array) -> Array:
        return np.sqrt(self._weights) * self._parts(theta)[2]

    def cost(self, theta: Array) -> float:
        return float(np.sum(self.residuals(theta) ** 2))

    def jacobian(self, theta: Array) -> Array:
        """Kaufman's (n, 4): what of each column the points' light cannot follow."""
        fade, own, _ = self._parts(theta)
        share, by_backscatter = _saturating(theta[2], self._range)
        columns = [
            self._range * own * fade,
            -share,
            -theta[1] * by_backscatter,
            np.log(self._range / self.typical_range) * own * fade,
        ]
        weighted = self._weights * fade
        bottom = np.bincount(self._point, weighted * fade, self._num_points)
        for column in columns:
            top = np.bincount(self._point, weighted * column, self._num_points)
            # A point that is black stays so.
            column -= np.where(own > 0.0, (top / bottom)[self._point], 0.0) * fade
        return np.sqrt(self._weights)[:, None] * np.stack(columns, axis=1)

    def reweight(self, theta: Array) -> None:
        """Weights by the noise of each image, and Huber's of the residuals.

        Most of the noise is not the sensor's: patches of a point never cover quite the
        same of the scene. That fades with the range as the point's own light does, and
        is larger in images that were taken from other sides than most. With any other
        weights, the range of the noisy images passes for a change of contrast.
        """
        fade, own, residuals = self._parts(theta)
        unit = np.sqrt(fade**2 * (own + self._floor) + self._sensor)
        # A point's own light follows its samples, the more the heavier they are.
        load = self._weights * fade**2
        share = load / np.bincount(self._point, load, self._num_points)[self._point]
        scaled = np.abs(residuals) / unit / np.sqrt(np.maximum(1.0 - share, 0.02))
        overall = _MAD_TO_STDDEV * float(np.median(scaled))
        by_image = np.array(
            [
                _MAD_TO_STDDEV * np.median(scaled[rows]) if len(rows) >= 20 else overall
                for rows in self._rows_of_image
            ]
        )
        by_image = np.maximum(by_image, max(0.3 * overall, 1e-12))
        noise = by_image[self._image]
        huber = np.minimum(_HUBER * noise / np.maximum(scaled, 1e-300), 1.0)
        self._weights = self._rarity * huber / (noise * unit) ** 2
        self.noise = float(np.median(noise * unit))

    def covariance(self, theta: Array, free: Mask) -> Array:
        """(4, 4), with zeros where a parameter is held."""
        jacobian, residuals = self.jacobian(theta), self.residuals(theta)
        jacobian[:, ~free] = 0.0
        plain = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
        scores = np.zeros((len(self._rows_of_image), 4))
        np.add.at(scores, self._image, jacobian * residuals[:, None])
        shared = plain @ (scores.T @ scores) @ plain
        # Whichever is larger, parameter by parameter, with the plain correlations.
        known = np.where(np.diag(plain) > 0.0, np.diag(plain), 1.0)
        grown = np.sqrt(np.maximum(np.diag(shared) / known, 1.0))
        return plain * np.outer(grown, grown)
