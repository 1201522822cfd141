"""Sea floors as smooth height fields with exact slopes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

NUM_WAVES = 64  # enough for the sum to look Gaussian, cheap enough per point


@dataclass(frozen=True, kw_only=True)
class Relief:
    """A random sea floor ``z(x, y)`` in the world frame, metres, z pointing down.

    The sum of plane waves with normally distributed wave vectors is a Gaussian random
    field with covariance ``stddev^2 exp(-r^2 / (2 correlation_length^2))``: smooth,
    unbounded in extent, and its slope is known in closed form.

    Raises:
        InputError: a negative or infinite stddev, a correlation length that is not
            positive, or a negative seed.
    """

    stddev: float = 0.0
    """Of the depth around zero; 0 is a flat floor. About 1/5 of peak to peak."""
    correlation_length: float = 0.5
    """How far apart two points keep 60 % of their correlation."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.stddev < np.inf:
            raise InputError(
                f"relief stddev must be finite and not negative, got {self.stddev}"
            )
        if not self.seed >= 0:
            raise InputError(f"relief seed must not be negative, got {self.seed}")
        if not self.correlation_length > 0.0:
            raise InputError(
                "relief correlation_length must be positive, "
                f"got {self.correlation_length}"
            )

    @cached_property
    def _waves(self) -> tuple[Array, Array]:
        rng = np.random.default_rng(self.seed)
        wave_vectors = rng.normal(size=(NUM_WAVES, 2)) / self.correlation_length
        return wave_vectors, rng.uniform(0.0, 2.0 * np.pi, NUM_WAVES)

    def depth(self, xy: ArrayLike) -> Array:
        """Depths z (N,) at world positions xy (N, 2)."""
        xy = np.asarray(xy, dtype=np.float64)
        if self.stddev == 0.0:
            return np.zeros(len(xy))
        wave_vectors, phases = self._waves
        amplitude = self.stddev * np.sqrt(2.0 / NUM_WAVES)
        return amplitude * np.cos(xy @ wave_vectors.T + phases).sum(axis=1)

    def points(self, xy: ArrayLike) -> Array:
        """Points (N, 3) on the floor at world positions xy (N, 2)."""
        return np.column_stack([np.asarray(xy, dtype=np.float64), self.depth(xy)])

    def normals(self, xy: ArrayLike) -> Array:
        """Unit normals (N, 3), pointing up into the water (negative z)."""
        xy = np.asarray(xy, dtype=np.float64)
        slope = np.zeros((len(xy), 2))
        if self.stddev > 0.0:
            wave_vectors, phases = self._waves
            amplitude = self.stddev * np.sqrt(2.0 / NUM_WAVES)
            slope = -amplitude * np.sin(xy @ wave_vectors.T + phases) @ wave_vectors
        normals = np.column_stack([slope, -np.ones(len(xy))])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)
