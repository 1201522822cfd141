"""Semi-global aggregation of any costs (Hirschmueller, PAMI 2008), along four paths."""

import numpy as np

from uwsfm._jit import inner, kernel


@inner
def _follow(cost, before, lowest, p1, p2, after, total):
    """One step of a path: costs (D,) and path costs before (D,) -> after, their least.

    ``total`` (D,) is added to.
    """
    count = len(cost)
    least = np.float32(np.inf)
    for d in range(count):
        best = min(before[d], lowest + p2)
        if d > 0:
            best = min(best, before[d - 1] + p1)
        if d < count - 1:
            best = min(best, before[d + 1] + p1)
        value = cost[d] + best - lowest
        after[d] = value
        total[d] += value
        least = min(least, value)
    return least


@kernel
def aggregate(cost, p1, p2, total):
    """Sums of the path costs, from all four sides.

    Args:
        cost: (H, W, D) uint8.
        p1, p2: of a change by one level, and by more; float32.
        total: (H, W, D) float32, written.
    """
    height, width, count = cost.shape
    total[:] = 0.0
    along = np.zeros((2, count), dtype=np.float32)
    down = np.zeros((2, width, count), dtype=np.float32)
    lowest = np.zeros(width, dtype=np.float32)
    for backwards in range(2):
        down[:] = 0.0
        lowest[:] = 0.0
        for i in range(height):
            y = height - 1 - i if backwards else i
            along[:] = 0.0
            least = np.float32(0.0)
            for j in range(width):
                x = width - 1 - j if backwards else j
                least = _follow(
                    cost[y, x], along[j % 2], least, p1, p2, along[1 - j % 2],
                    total[y, x],
                )  # fmt: skip
                lowest[x] = _follow(
                    cost[y, x], down[i % 2, x], lowest[x], p1, p2,
                    down[1 - i % 2, x], total[y, x],
                )  # fmt: skip
