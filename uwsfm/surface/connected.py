"""The surface that a cloud is about, and the strays beside it."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from uwsfm.geometry.rigid3 import Array
from uwsfm.surface.height_map import point_spacing

LINK_SPACINGS = 8.0
"""Points nearer than so many spacings are of one part. Clouds are up to four times
thinner at their rims and on slopes than at their median."""
SHARE_OF_LARGEST = 0.1
"""A part with so many of the points of the largest is a second object, and no stray."""
MIN_POINTS = 10
"""Of fewer, no spacing can be told."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """The connected parts of a cloud."""

    main: NDArray[np.bool_]
    """(N,) whether a point is of the largest part, or of one of its size."""
    num_kept: int
    """Parts that ``main`` holds."""
    num_left_out: int
    link: float
    """Largest distance between points that surely joins them."""


def main_parts(points: Array, link: float | None = None) -> Parts:
    """Divide a cloud into what is connected and what strays.

    Points are counted into cubes with sides of ``link``, and cubes that touch, by a
    corner at least, are joined: points nearer than ``link`` always are, points farther
    apart than 3.5 times that never directly.

    Args:
        points: (N, 3), finite.
        link: default: `LINK_SPACINGS` spacings of the points.
    """
    if len(points) < MIN_POINTS:
        everything = np.ones(len(points), dtype=bool)
        return Parts(main=everything, num_kept=1, num_left_out=0, link=0.0)
    if link is None:
        link = LINK_SPACINGS * point_spacing(points)
    cells = np.floor((points - points.min(axis=0)) / link)
    # Each axis by ranks, in which steps of more than one stay such: keys stay small,
    # however far a stray is.
    ranks = np.stack([_ranks(column) for column in cells.T], axis=1)
    width = ranks.max(axis=0) + 3  # a step over the end of a row meets nothing
    keys, cube = np.unique(ranks @ _strides(width), return_inverse=True)
    part = _components(keys, width)[cube]
    counts = np.bincount(part)
    large = counts >= SHARE_OF_LARGEST * counts.max()
    return Parts(
        main=large[part],
        num_kept=int(np.count_nonzero(large)),
        num_left_out=int(np.count_nonzero(~large)),
        link=float(link),
    )


def _ranks(column: Array) -> NDArray[np.int64]:
    """Whole numbers (N,) whose neighbours stay neighbours, and others stay apart."""
    values, inverse = np.unique(column, return_inverse=True)
    steps = np.minimum(np.diff(values), 2.0).astype(np.int64)
    return np.concatenate([[0], np.cumsum(steps)])[inverse]


def _strides(width: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.array([width[1] * width[2], width[2], 1], dtype=np.int64)


def _components(keys: NDArray[np.int64], width: NDArray[np.int64]) -> NDArray[np.int64]:
    """Component of each occupied cube (K,), by its sorted key."""
    rows, columns = [], []
    steps = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
    for step in np.array(steps) @ _strides(width):
        place = np.minimum(np.searchsorted(keys, keys + step), len(keys) - 1)
        found = np.flatnonzero(keys[place] == keys + step)
        rows.append(found)
        columns.append(place[found])
    row, column = np.concatenate(rows), np.concatenate(columns)
    ones = np.ones(len(row), dtype=np.int8)
    graph = coo_array((ones, (row, column)), shape=(len(keys), len(keys)))
    return connected_components(graph, directed=False)[1].astype(np.int64)
