"""An order for large surveys: cut the graph of frames in two, again and again.

Nested dissection (George, SIAM J. Numer. Anal. 1973). What separates the halves is
eliminated after both of them. The two ends of the graph are seeds; the fewest frames
that have to be taken out to part them are a minimal cut (Menger), found by maximum
flow. What is left uncut is ordered by minimum degree.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    maximum_flow,
)

from uwsfm.scene import IndexArray
from uwsfm.solver.linear.elimination_tree import minimum_degree_order

SMALL = 150
"""Frames that are not cut any more."""
SEED_SHARES = (0.2, 0.14, 0.1, 0.07)
"""Of the frames in each seed; smaller where the seeds touch."""


def dissection_order(pattern: sp.csr_array) -> IndexArray:
    """Order (n,) in which to eliminate the frames of a pattern (n, n)."""
    return np.concatenate(_ordered(pattern, np.arange(pattern.shape[0])))


def _ordered(pattern: sp.csr_array, nodes: IndexArray) -> list[IndexArray]:
    """Frames of a part of the graph, in order."""
    part = pattern[nodes][:, nodes].tocsr()
    if len(nodes) <= SMALL:
        return [nodes[minimum_degree_order(part)]]
    count, label = connected_components(part, directed=False)
    if count > 1:
        pieces = [_ordered(pattern, nodes[label == piece]) for piece in range(count)]
        return [order for piece in pieces for order in piece]
    along = _along(part)
    for share in SEED_SHARES:
        cut = _minimal_cut(part, along, int(share * len(nodes)))
        if cut is not None:
            left, separator = cut
            right = ~left & ~separator
            halves = _ordered(pattern, nodes[left]) + _ordered(pattern, nodes[right])
            return [*halves, nodes[separator]]
    return [nodes[minimum_degree_order(part)]]


def _along(part: sp.csr_array) -> IndexArray:
    """Frames from one end of a connected graph to the other: by how much nearer they
    are to the one than to the other."""
    steps, order = _steps_from(part, 0)
    start = order[-1]
    steps, order = _steps_from(part, start)
    back, _ = _steps_from(part, order[-1])
    return np.argsort(steps - back, kind="stable")


def _steps_from(part: sp.csr_array, root: int) -> tuple[IndexArray, IndexArray]:
    """Steps (n,) to each frame, and the frames in the order they are reached."""
    order, before = breadth_first_order(part, root, directed=False)
    steps = np.zeros(part.shape[0], dtype=np.int64)
    for node in order[1:]:
        steps[node] = steps[before[node]] + 1
    return steps, order


def _minimal_cut(
    part: sp.csr_array, along: IndexArray, seed: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Masks (n,) of one side and of what separates it; None if the seeds touch."""
    size = part.shape[0]
    first, last = along[:seed], along[size - seed :]
    if part[first][:, last].nnz:
        return None
    # Every frame is an edge of capacity 1, from its entrance 2 i to its exit 2 i + 1.
    source, sink, open_ = 2 * size, 2 * size + 1, size + 1
    pairs = part.tocoo()
    apart = pairs.row != pairs.col
    inner = np.arange(size)
    own = np.ones(size)
    own[first] = own[last] = open_
    rows = [2 * pairs.row[apart] + 1, 2 * inner, np.full(seed, source), 2 * last + 1]
    cols = [2 * pairs.col[apart], 2 * inner + 1, 2 * first, np.full(seed, sink)]
    ends = np.full(seed, open_)
    capacity = np.concatenate([np.full(len(rows[0]), open_), own, ends, ends])
    places = (np.concatenate(rows), np.concatenate(cols))
    network = sp.csr_array(
        (capacity.astype(np.int32), places), shape=(2 * size + 2, 2 * size + 2)
    )
    left_over = (network - maximum_flow(network, source, sink).flow).tocsr()
    left_over.data = np.maximum(left_over.data, 0)
    left_over.eliminate_zeros()
    reached = np.zeros(2 * size + 2, dtype=bool)
    reached[breadth_first_order(left_over, source, return_predecessors=False)] = True
    entered, left = reached[0 : 2 * size : 2], reached[1 : 2 * size : 2]
    return left, entered & ~left
