"""The solver of a reduced system, chosen once per layout from its structure.

Three ways lead to the same numbers:

- dense: one Cholesky factor of frames and border;
- banded: a sequence. Frames in an order with a narrow band, the border by Schur
  complement;
- sparse: a sequence with loops. Fronts in an order of minimum degree, or of nested
  dissection; the border by Schur complement.

What costs least, by an estimate of the sums, is taken and told in the log.
"""

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order

from uwsfm.scene import IndexArray
from uwsfm.solver.layout import Layout
from uwsfm.solver.linear import elimination_tree as trees
from uwsfm.solver.linear.banded_cholesky import BandedCholesky
from uwsfm.solver.linear.block_cholesky import BlockCholesky
from uwsfm.solver.linear.block_graph import BlockGraph, build_graph
from uwsfm.solver.linear.elimination_tree import EliminationTree
from uwsfm.solver.linear.nested_dissection import dissection_order

logger = logging.getLogger("uwsfm")

DENSE, BANDED, SPARSE = "dense", "banded", "sparse"

ALWAYS_DENSE = 400
"""Columns up to which looking for structure costs more than it saves: 2 ms."""
LONG = 1500
"""Frames from which nested dissection, which takes longer to find, saves that time in
three steps: 25 % of the sums of minimum degree at 5000."""
BAND_FLOPS = 2.0
"""Cost of a product in a band, relative to a large product of matrices."""


@dataclass(frozen=True, eq=False)
class Reduction:
    """A layout's reduced system: its pattern, and how it is solved."""

    layout: Layout
    graph: BlockGraph
    kind: str
    """`DENSE`, `BANDED` or `SPARSE`."""
    outer: IndexArray
    """Frames that are treated as border: without the known lengths, the scale of the
    others may be open. None if the system is dense."""
    inner: IndexArray
    """The other free frames, rising."""
    order: IndexArray
    """Of the inner frames in the band."""
    width: int
    """Of the band, frames."""
    tree: EliminationTree | None

    @cached_property
    def factor(self) -> BlockCholesky | BandedCholesky:
        """Storage for the factor of the inner frames, used again by every step."""
        if self.kind == BANDED:
            return BandedCholesky(self.graph, self.order, self.width, self._fronts)
        return BlockCholesky(self._fronts)

    @cached_property
    def rough_factor(self) -> BlockCholesky:
        """The same for seven digits, in half the memory and 0.6 of the time."""
        return BlockCholesky(self._fronts, np.float32)

    @property
    def _fronts(self) -> EliminationTree:
        if self.tree is None:
            raise ValueError("a dense system has no factor of its frames alone")
        return self.tree


def analyse(layout: Layout, kind: str | None = None) -> Reduction:
    """Choose how to solve the reduced systems of a layout.

    Args:
        layout: of the problem.
        kind: the way to take; by default the cheapest.
    """
    graph = build_graph(layout)
    size = layout.num_frame_cols + layout.num_border_cols
    everything = np.arange(graph.num_frames)
    none = everything[:0]
    dense = Reduction(layout, graph, DENSE, none, everything, everything, 0, None)
    if kind == DENSE or (kind is None and size <= ALWAYS_DENSE):
        return _told(dense, f"{size} columns")
    outer = _outer_frames(layout, graph)
    inner = np.setdiff1d(everything, outer)
    pattern = trees.adjacency(graph, inner)
    order, width = trees.narrow_order(pattern)
    tree = _good_tree(graph, inner, pattern)
    costs = {
        DENSE: size**3 / 3.0,
        BANDED: BAND_FLOPS * 6.0 * len(inner) * (6.0 * width + 6.0) ** 2,
        SPARSE: tree.cost,
    }
    numbers = (
        f"{graph.num_frames} frames, {graph.num_blocks} blocks; band of {width} "
        f"frames; {tree.num_blocks} blocks in {len(tree.fronts)} fronts; Gflop dense "
        f"{costs[DENSE] / 1e9:.2g}, banded {costs[BANDED] / 1e9:.2g}, "
        f"sparse {costs[SPARSE] / 1e9:.2g}"
    )
    chosen = kind or min(costs, key=costs.__getitem__)
    if chosen == DENSE:
        return _told(dense, numbers)
    reduction = Reduction(
        layout, graph, chosen, outer, inner, inner[order], width, tree
    )
    return _told(reduction, numbers)


def _good_tree(
    graph: BlockGraph, inner: IndexArray, pattern: sp.csr_array
) -> EliminationTree:
    find_order = dissection_order if len(inner) > LONG else trees.minimum_degree_order
    return trees.elimination_tree(graph, inner, pattern, find_order(pattern))


def _told(reduction: Reduction, numbers: str) -> Reduction:
    # Small systems are solved by the thousand, as frames are registered.
    level = logging.DEBUG if reduction.tree is None else logging.INFO
    logger.log(level, "reduced system: %s (%s)", reduction.kind, numbers)
    return reduction


def _outer_frames(layout: Layout, graph: BlockGraph) -> IndexArray:
    """The frame farthest from the first one, if lengths are known.

    With the frames that are held it fixes the scale, so that the others are determined
    before the lengths join them.
    """
    if not layout.num_lengths:
        return np.empty(0, dtype=np.int64)
    pattern = trees.adjacency(graph, np.arange(graph.num_frames))
    reached = breadth_first_order(pattern, 0, directed=False, return_predecessors=False)
    return reached[-1:].astype(np.int64)
