"""Sets of indices: what `numpy.unique` finds, several times as fast."""

import numpy as np
from numpy.typing import NDArray

IndexArray = NDArray[np.int64]

_SPARSE = 16
"""Times as many possible indices as given ones: sorting these is faster."""


def renumbered(indices: IndexArray, size: int) -> tuple[IndexArray, IndexArray]:
    """The different ones of some indices, rising, and where each is among them.

    As `numpy.unique` with ``return_inverse``, which sorts.

    Args:
        indices: Of any shape, from 0 to below ``size``.
        size: How many there may be.

    Returns:
        The indices (n,) that occur, and the place of each one, of the given shape.
    """
    if size > _SPARSE * indices.size:
        used, place = np.unique(indices, return_inverse=True)
        return used.astype(np.int64), place.reshape(indices.shape).astype(np.int64)
    there = np.zeros(size, dtype=bool)
    there[indices] = True
    place = np.cumsum(there, dtype=np.int64)
    place -= 1
    return np.flatnonzero(there), place[indices]


def distinct(indices: IndexArray) -> IndexArray:
    """The different ones of some indices (n,), rising.

    Since version 2.3 numpy hashes them first: a third to a tenth of this speed.
    """
    ordered = np.sort(indices)
    new = np.ones(len(ordered), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return ordered[new]
