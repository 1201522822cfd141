"""In which order frames are eliminated, and in which fronts: found once per layout.

A *front* eliminates some frames at once, its pivots, and changes the block of the
frames after them that it touches, its rows (Duff & Reid, ACM TOMS 1983). Fronts that
hand on almost all they are given are merged: one large product of matrices costs less
than two small ones.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.linear.block_graph import BlockGraph

FRONT_FLOPS = 1e6
"""What a front costs beside its sums: 50 us of Python."""
BRANCH_SHARE = 1.0 / 8.0
"""Of all sums, the most that one branch has: where many frames are left, eight threads
have one each, and two or four end at about the same time."""
MOVE_FLOPS = 20.0
"""What moving a number of a front costs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Front:
    """One step of the elimination; places count frames in their new order."""

    first: int
    """Place of its first pivot."""
    num_pivots: int
    rows: IndexArray
    """(m,) places after the pivots that it touches, rising."""
    children: tuple[int, ...]
    maps: tuple[IndexArray, ...]
    """For each child, where its rows are among the pivots and rows here."""
    slots: IndexArray
    """Blocks of the graph that start here."""
    where: IndexArray
    """(s, 3): row among the pivots, column among pivots and rows, whether turned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EliminationTree:
    """Fronts, children before parents."""

    order: IndexArray
    """(n,) frame at each place."""
    fronts: tuple[Front, ...]
    cost: float
    """Of a factor, in flops of a large product."""
    num_blocks: int
    """6x6 blocks of the factor."""
    branches: tuple[tuple[int, ...], ...]
    """Fronts of subtrees that threads may eliminate side by side, the costliest first;
    the same for any number of threads."""
    trunk: tuple[int, ...]
    """The other fronts."""


def adjacency(graph: BlockGraph, keep: IndexArray) -> sp.csr_array:
    """Pattern (n, n) of the frames kept, with its diagonal."""
    rows = np.repeat(np.arange(graph.num_frames), np.diff(graph.row_start))
    shape = (graph.num_frames, graph.num_frames)
    lower = sp.coo_array((np.ones(len(rows)), (rows, graph.row_other)), shape).tocsr()
    pattern = (lower + lower.T).tocsr()[keep][:, keep].tocsr()
    pattern.sort_indices()
    return pattern


def bandwidth(pattern: sp.csr_array, order: IndexArray) -> int:
    """Largest distance of two frames that share a point."""
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    pairs = pattern.tocoo()
    return int(np.max(np.abs(place[pairs.row] - place[pairs.col]), initial=0))


def narrow_order(pattern: sp.csr_array) -> tuple[IndexArray, int]:
    """The order of time, or that of reverse Cuthill-McKee if its band is narrower."""
    time = np.arange(pattern.shape[0])
    other = reverse_cuthill_mckee(pattern.tocsr(), symmetric_mode=True).astype(np.int64)
    widths = [bandwidth(pattern, order) for order in (time, other)]
    return (other, widths[1]) if widths[1] < widths[0] else (time, widths[0])


def minimum_degree_order(pattern: sp.csr_array) -> IndexArray:
    """Multiple minimum degree, as SuperLU finds it, on the graph of frames."""
    shifted = pattern.tocsc().astype(np.float64)
    shifted.data[:] = -1.0
    size = shifted.shape[0]
    shifted = (shifted + sp.diags_array(np.full(size, 2.0 * size))).tocsc()
    factor = splu(
        shifted,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.argsort(factor.perm_c).astype(np.int64)


def elimination_tree(
    graph: BlockGraph, keep: IndexArray, pattern: sp.csr_array, order: IndexArray
) -> EliminationTree:
    """Fronts of an elimination.

    Args:
        graph: of all free frames.
        keep: (n,) frames to eliminate, rising.
        pattern: (n, n) of these.
        order: (n,) in which they are eliminated, counted among them.
    """
    touched = _touched(pattern, order)
    groups = _merged(touched)
    sequence = _postorder(groups)
    new_order = np.concatenate([[*groups[g].pivots] for g in sequence] or [[]])
    new_order = new_order.astype(np.int64)
    place = np.empty(len(order), dtype=np.int64)  # of what was eliminated k-th
    place[new_order] = np.arange(len(order))
    place_of_frame = np.full(graph.num_frames, -1, dtype=np.int64)
    place_of_frame[keep[order]] = place
    number = {g: at for at, g in enumerate(sequence)}
    fronts: list[Front] = []
    starts = _Starts(graph, place_of_frame)
    first = 0
    for g in sequence:
        group = groups[g]
        rows = np.sort(place[touched[group.pivots[-1]]])
        children = tuple(number[c] for c in group.children)
        span = np.concatenate([first + np.arange(len(group.pivots)), rows])
        slots, where = starts.of(first, len(group.pivots), span)
        fronts.append(
            Front(
                first=first,
                num_pivots=len(group.pivots),
                rows=rows,
                children=children,
                maps=tuple(np.searchsorted(span, fronts[c].rows) for c in children),
                slots=slots,
                where=where,
            )
        )
        first += len(group.pivots)
    sizes = np.array([[f.num_pivots, len(f.rows)] for f in fronts], float).reshape(
        -1, 2
    )
    pivots, rows = sizes.T
    costs = _cost(pivots, rows)
    branches, trunk = _branches(fronts, costs)
    return EliminationTree(
        order=keep[order][new_order],
        fronts=tuple(fronts),
        cost=float(np.sum(costs)),
        num_blocks=int(np.sum(pivots * (pivots + 1) / 2 + pivots * rows)),
        branches=branches,
        trunk=trunk,
    )


def _branches(
    fronts: list[Front], costs: Array
) -> tuple[tuple[tuple[int, ...], ...], tuple[int, ...]]:
    """The largest subtrees that cost no more than their share, and the rest."""
    below, members = costs.copy(), [[number] for number in range(len(fronts))]
    for number, front in enumerate(fronts):
        for child in front.children:
            below[number] += below[child]
    limit = BRANCH_SHARE * np.sum(costs)
    small = below <= limit
    trunk = [number for number in range(len(fronts)) if not small[number]]
    for number, front in enumerate(fronts):
        if small[number]:
            for child in front.children:
                members[number] = members[child] + members[number]
    inner = {c for f, one in zip(fronts, small, strict=True) if one for c in f.children}
    roots = [n for n in np.argsort(-below) if small[n] and n not in inner]
    return tuple(tuple(sorted(members[n])) for n in roots), tuple(trunk)


def _touched(pattern: sp.csr_array, order: IndexArray) -> list[IndexArray]:
    """What each elimination touches, by the order; rising."""
    ordered = pattern[order][:, order].tocsr()
    ordered.sort_indices()
    touched: list[IndexArray] = []
    children: list[list[int]] = [[] for _ in order]
    for k in range(len(order)):
        own = ordered.indices[ordered.indptr[k] : ordered.indptr[k + 1]]
        # What a child touches comes after it: the first is this one.
        parts = [own[own > k].astype(np.int64)]
        parts += [touched[child][1:] for child in children[k]]
        touched.append(np.unique(np.concatenate(parts)))
        if len(touched[k]):
            children[touched[k][0]].append(k)
    return touched


@dataclass
class _Group:
    """Eliminations that become one front; what the last one touches is its rows."""

    pivots: list[int]
    num_rows: int
    children: list[int]


def _cost(num_pivots, num_rows):
    """Of a front with so many pivots and rows of 6x6 blocks, in flops."""
    k, m = 6.0 * num_pivots, 6.0 * num_rows
    sums = k**3 / 3.0 + m * k**2 + k * m**2
    return sums + MOVE_FLOPS * (k + m) ** 2 + FRONT_FLOPS


def _merged(touched: list[IndexArray]) -> dict[int, _Group]:
    """Groups by their last pivot; a child joins its parent where that costs less."""
    groups: dict[int, _Group] = {}
    children: list[list[int]] = [[] for _ in touched]
    for k, rows in enumerate(touched):
        group = _Group([k], len(rows), [])
        # The child that touches most first: it adds the fewest zeros.
        for c in sorted(children[k], key=lambda c: -groups[c].num_rows):
            child = groups[c]
            apart = _cost(len(group.pivots), group.num_rows)
            apart += _cost(len(child.pivots), child.num_rows)
            together = len(group.pivots) + len(child.pivots)
            if _cost(together, group.num_rows) <= apart:
                group.pivots = child.pivots + group.pivots
                group.children += child.children
                del groups[c]
            else:
                group.children.append(c)
        groups[k] = group
        if len(rows):
            children[rows[0]].append(k)
    for group in groups.values():
        group.pivots.sort()
    return groups


def _postorder(groups: dict[int, _Group]) -> list[int]:
    """Children before parents, subtree after subtree."""
    inner = {c for group in groups.values() for c in group.children}
    stack = [g for g in groups if g not in inner]
    sequence: list[int] = []
    while stack:
        g = stack.pop()
        sequence.append(g)
        stack.extend(groups[g].children)
    return sequence[::-1]


class _Starts:
    """The blocks of a graph, by the front that eliminates the first of their frames."""

    def __init__(self, graph: BlockGraph, place_of_frame: IndexArray) -> None:
        rows = np.repeat(np.arange(graph.num_frames), np.diff(graph.row_start))
        at_row, at_other = place_of_frame[rows], place_of_frame[graph.row_other]
        low, high = np.minimum(at_row, at_other), np.maximum(at_row, at_other)
        self._by_low = np.argsort(low, kind="stable")
        self._low, self._high = low[self._by_low], high[self._by_low]
        # The block has the rows of the other frame: as it is where that comes first.
        self._turned = (at_row < at_other)[self._by_low]

    def of(
        self, first: int, num_pivots: int, span: IndexArray
    ) -> tuple[IndexArray, IndexArray]:
        begin, end = np.searchsorted(self._low, [first, first + num_pivots])
        inside = slice(begin, end)
        column = np.searchsorted(span, self._high[inside])
        where = [self._low[inside] - first, column, self._turned[inside]]
        return self._by_low[inside], np.stack(where, axis=1).astype(np.int64)


def permuted(order: IndexArray, values: Array) -> Array:
    """Blocks of rows (n, 6, r) in an order, as (6 n, r)."""
    rows = np.ascontiguousarray(values[order])
    return rows.reshape(6 * len(order), values.shape[2])
