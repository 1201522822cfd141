"""The systematic part of residuals: its size, and a significance that holds."""

import numpy as np
import pytest

from uwsfm.trust.systematic import MIN_IN_BIN, systematic_part
from uwsfm.trust.verdict import LEVEL

NOISE_PX = 0.3


def drawn(rng, *, frames: int, shared: float, bins: int = 24, count: int = 2000):
    """Residuals without anything systematic, their bins and clusters.

    Args:
        shared: what the observations of a cluster have in common, in noises.
    """
    frame, bin_ = rng.integers(0, frames, count), rng.integers(0, bins, count)
    cluster = 4 * frame + bin_ % 4
    noise = rng.normal(size=(count, 2))
    common = shared * rng.normal(size=(4 * frames, 2))[cluster]
    return NOISE_PX * (noise + common), bin_, cluster


@pytest.mark.parametrize("frames", [4, 15])
@pytest.mark.parametrize("shared", [0.0, 0.7])
def test_chance_is_rarely_called_significant(rng, frames, shared):
    trials = 400
    found = [
        systematic_part(*drawn(rng, frames=frames, shared=shared))
        for _ in range(trials)
    ]
    p_values = np.array([part.p_value for part in found])
    # Binomial: 400 draws of 1 in 100 exceed 12 in one case of a thousand.
    assert np.count_nonzero(p_values < 0.01) <= 12
    assert not any(part.significant(LEVEL) for part in found)
    # It is no constant: chance is spread over it, if more narrowly than evenly.
    assert 0.2 < np.median(p_values) < 0.8
    assert np.ptp(p_values) > 0.5


def test_the_size_is_free_of_bias_though_neighbours_err_together(rng):
    shift = np.array([0.1, -0.05])
    squares = []
    for _ in range(60):
        residuals, bins, clusters = drawn(rng, frames=12, shared=0.7)
        pattern = np.where(bins % 2, 1.0, -1.0)[:, None] * shift
        part = systematic_part(residuals + pattern, bins, clusters)
        squares.append(part.px**2)
    # Each square scatters by about a half, their mean by a fifteenth of it.
    assert np.isclose(np.mean(squares), np.sum(shift**2), rtol=0.2)


def test_the_size_is_the_mean_product_of_different_clusters(rng):
    """By the definition: a double sum over observations of one bin, slowly."""
    residuals, bins, clusters = drawn(rng, frames=3, shared=0.5, bins=4, count=160)
    residuals += 0.4
    total = weight = 0.0
    for b in range(4):
        rows = np.flatnonzero(bins == b)
        apart = clusters[rows][:, None] != clusters[rows]
        products = residuals[rows] @ residuals[rows].T
        total += len(rows) * products[apart].mean()
        weight += len(rows)
    part = systematic_part(residuals, bins, clusters)
    # Both are exact but for rounding.
    assert np.isclose(part.px, np.sqrt(total / weight), rtol=1e-10)


def test_too_little_gives_no_number():
    nothing = np.zeros(0, dtype=np.int64)
    assert np.isnan(systematic_part(np.zeros((0, 2)), nothing, nothing).px)
    few = np.zeros(MIN_IN_BIN - 1, dtype=np.int64)
    part = systematic_part(np.ones((len(few), 2)), few, np.arange(len(few)))
    assert np.isnan(part.px) and not part.significant(1.0)


def test_many_clusters_are_merged_and_agree(rng):
    residuals, bins, clusters = drawn(rng, frames=400, shared=0.0, count=20_000)
    pattern = np.where(bins % 2, 0.1, -0.1)[:, None]
    part = systematic_part(residuals + pattern, bins, clusters)
    # Two coordinates of 0.1 px; 20,000 observations know the size to some per cent.
    assert np.isclose(part.px, 0.1 * np.sqrt(2.0), rtol=0.05)
    assert part.significant(LEVEL)
