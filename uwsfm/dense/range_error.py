"""Standard deviations of the ranges of an image, between the nodes of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from uwsfm.geometry.rigid3 import Array


@dataclass(frozen=True, eq=False)
class RangeGrid:
    """Pixels and inverse ranges at which deviations are computed, each ascending."""

    x: Array
    y: Array
    inverse: Array

    def nodes(self) -> tuple[Array, Array]:
        """Pixels (G, 2) and inverse ranges (G,) of all nodes."""
        y, x, inverse = (
            axis.ravel()
            for axis in np.meshgrid(self.y, self.x, self.inverse, indexing="ij")
        )
        return np.stack([x, y], axis=1), inverse


class RangeError:
    """Standard deviation of the ranges of one image, metres.

    Args:
        grid: of N nodes.
        stddev: (N,) at its nodes.
    """

    def __init__(self, grid: RangeGrid, stddev: Array) -> None:
        self.largest = float(np.max(stddev))
        axes = grid.y, grid.x, grid.inverse
        self._low, self._high = (np.array([a[end] for a in axes]) for end in (0, -1))
        self._interpolator = RegularGridInterpolator(
            axes, stddev.reshape([len(axis) for axis in axes]), bounds_error=False
        )

    def stddev(self, xy: ArrayLike, ranges: ArrayLike) -> Array:
        """Standard deviations (N,) at pixels (N, 2) and ranges (N,), metres."""
        pixels = np.asarray(xy, dtype=np.float64)
        inverse = 1.0 / np.asarray(ranges, dtype=np.float64)
        at = np.column_stack([pixels[:, 1], pixels[:, 0], inverse])
        return np.asarray(self._interpolator(np.clip(at, self._low, self._high)))
