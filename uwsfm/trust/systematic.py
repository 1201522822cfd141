"""Systematic residuals: their size, and whether chance alone makes them so large.

Noise averages out in a bin, what a model gets wrong stays. Neighbouring features do not
err alone, however: what a detector makes of a slanted surface is shared by them, and a
mean over neighbours of one image averages less than it seems. Residuals are therefore
summed over *clusters* (parts of single images) first, and only what different clusters
of a bin have in common counts as systematic. With s_cb the sum of the residuals of
cluster c in bin b (2-vectors) and n_cb their number,

    m_b^2 = sum_{c != c'} s_cb . s_c'b / (n_b^2 - sum_c n_cb^2)

is free of bias: zero on average if clusters err independently, however their members
do. The variance of the weighted sum over bins follows from the same products (those of
a wild bootstrap with Gaussian multipliers, Wu 1986, in closed form), and its
distribution is that of a sum of squares: a gamma distribution with the same mean and
variance (Satterthwaite 1946).
"""

from dataclasses import dataclass

import numpy as np

from uwsfm._base.indices import renumbered
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray

MAX_CLUSTERS = 600
"""More are merged, which costs power, not correctness: products are a matrix."""
MIN_CLUSTERS = 3
"""Of a bin: fewer cannot show what they have in common."""
MIN_IN_BIN = 8
"""Observations of a bin that counts."""


@dataclass(frozen=True, kw_only=True)
class Systematic:
    """The part of residuals that repeats within bins."""

    px: float
    """Root mean square over the observations of the bins' means, free of what chance
    adds; 0: no more than chance; NaN: too few observations or clusters."""
    p_value: float
    """Chance of so much or more if clusters err independently; NaN as above."""
    num_bins: int
    """Bins with enough observations."""

    def significant(self, level: float) -> bool:
        """Whether chance explains it less often than ``level``."""
        return bool(self.p_value < level)


NOTHING = Systematic(px=float("nan"), p_value=float("nan"), num_bins=0)


def systematic_part(
    residuals: Array, bins: IndexArray, clusters: IndexArray
) -> Systematic:
    """The systematic part of residuals by bin.

    Args:
        residuals: (N, 2) finite, px.
        bins: (N,) bin of each, from 0.
        clusters: (N,) what may err together, from 0.
    """
    if not len(residuals):
        return NOTHING
    _, bins = renumbered(bins, int(bins.max()) + 1)
    _, clusters = renumbered(clusters, int(clusters.max()) + 1)
    clusters = _merged(clusters)
    num_bins, num_clusters = int(bins.max()) + 1, int(clusters.max()) + 1
    shape = (num_clusters, num_bins)
    slot = clusters * num_bins + bins
    counts = np.bincount(slot, minlength=num_clusters * num_bins).reshape(shape)
    of_bin = counts.sum(axis=0)
    there = np.count_nonzero(counts, axis=0) >= MIN_CLUSTERS
    there &= of_bin >= MIN_IN_BIN
    if not np.any(there):
        return NOTHING
    counts, of_bin = counts[:, there].astype(np.float64), of_bin[there]
    # The weight of a bin turns products into n_b m_b^2.
    weights = of_bin / (of_bin.astype(np.float64) ** 2 - np.sum(counts**2, axis=0))
    products = np.zeros((num_clusters, num_clusters))
    for values in residuals.T:
        sums = np.bincount(slot, values, minlength=num_clusters * num_bins)
        sums = sums.reshape(shape)[:, there] * np.sqrt(weights)
        products += sums @ sums.T
    mean = float(np.trace(products))  # of `products.sum()`, where all is chance
    excess = float(products.sum()) - mean
    return Systematic(
        px=float(np.sqrt(max(excess, 0.0) / of_bin.sum())),
        p_value=_p_value(excess + mean, mean, 2.0 * float(np.sum(products**2))),
        num_bins=int(np.count_nonzero(there)),
    )


def _p_value(value: float, mean: float, variance: float) -> float:
    """Chance that a sum of squares of this mean and variance exceeds a value."""
    from scipy.stats import gamma  # heavy

    if not variance > 0.0:
        return 1.0
    scale = variance / mean
    return float(gamma.sf(value, mean / scale, scale=scale))


def _merged(clusters: IndexArray) -> IndexArray:
    """Neighbouring clusters as one, where there are too many."""
    count = int(clusters.max()) + 1
    return clusters * MAX_CLUSTERS // count if count > MAX_CLUSTERS else clusters
