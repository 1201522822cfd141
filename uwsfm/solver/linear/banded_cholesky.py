"""Cholesky factor of a band: sequences, where frames share points with the next few."""

import numpy as np
from scipy.linalg import lapack

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.linear.block_cholesky import BlockCholesky
from uwsfm.solver.linear.block_graph import BlockGraph
from uwsfm.solver.linear.elimination_tree import EliminationTree


@kernel
def _fill_band(graph, place, blocks, band):
    """Lower triangle by columns: band[j, i - j] = A[i, j], in the order of places."""
    for i in range(len(graph.frame)):
        for slot in range(graph.row_start[i], graph.row_start[i + 1]):
            row, col = place[i], place[graph.row_other[slot]]
            if row < 0 or col < 0:
                continue
            for a in range(6):
                for b in range(6):
                    r, c = 6 * row + a, 6 * col + b
                    if col > row:
                        r, c = c, r
                    if r >= c:
                        band[c, r - c] = blocks[slot, b, a]


class BandedCholesky:
    """A factor L of the frames' part, A = L L^T in an order with a narrow band."""

    def __init__(
        self,
        graph: BlockGraph,
        order: IndexArray,
        width: int,
        tree: EliminationTree,
    ) -> None:
        """Args:
        graph: of all free frames.
        order: frames to eliminate.
        width: of the band, in frames.
        tree: of the same order; for the inverse.
        """
        self.order = order
        self._graph = graph
        self._place = np.full(graph.num_frames, -1, dtype=np.int64)
        self._place[order] = np.arange(len(order))
        self._band = np.empty((6 * len(order), 6 * width + 6))
        self._tree = tree
        self._blocks = np.empty((0, 6, 6))

    def factorize(self, blocks: Array) -> bool:
        """Factor blocks (number of blocks, 6, 6); False if they are not positive."""
        self._band[...] = 0.0
        self._blocks = blocks
        _fill_band(self._graph, self._place, blocks, self._band)
        # Fortran reads rows as columns.
        _, info = lapack.dpbtrf(self._band.T, lower=1, overwrite_ab=1)
        return info == 0 and bool(np.isfinite(self._band[:, 0]).all())

    def solve_half(self, right: Array) -> Array:
        """L^-1 times columns (6 n, r) in the factor's order."""
        return np.ascontiguousarray(
            lapack.dtbtrs(self._band.T, np.asfortranarray(right), uplo="L")[0]
        )

    def solve_other_half(self, right: Array) -> Array:
        """L^-T times columns (6 n, r)."""
        return np.ascontiguousarray(
            lapack.dtbtrs(self._band.T, np.asfortranarray(right), uplo="L", trans="T")[
                0
            ]
        )

    def inverse_blocks(self, blocks: Array) -> None:
        """Write the blocks of A^-1 in the pattern of those of A."""
        fronts = BlockCholesky(self._tree)
        if not fronts.factorize(self._blocks):
            raise ValueError("the same blocks were positive for the banded factor")
        fronts.inverse_blocks(blocks)
