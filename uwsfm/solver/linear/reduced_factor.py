"""Factors of reduced systems, and what an inverse tells, whatever the structure.

The border (rig, ports, position of the navigation's frame, known lengths) is dense. Of
a banded or sparse system [[A, C], [C^T, D]] it is eliminated last:

    Y = L^-1 C,   T = D - Y^T Y,   A = L L^T

T is quasi-definite as the system is, see `uwsfm.solver.linear.quasidefinite`.
"""

from typing import Protocol

import numpy as np
from scipy.sparse.linalg import LinearOperator, onenormest

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.linear.banded_cholesky import BandedCholesky
from uwsfm.solver.linear.block_cholesky import BlockCholesky
from uwsfm.solver.linear.elimination_tree import permuted
from uwsfm.solver.linear.quasidefinite import (
    SINGULAR,
    inverse_of_lower,
    solve_lower,
    symmetric,
)
from uwsfm.solver.linear.reduction import DENSE, Reduction
from uwsfm.solver.linear.schur import ReducedSystem

Factor = BlockCholesky | BandedCholesky


class Inverse(Protocol):
    """What is asked of the inverse of a reduced system (n, n); B border columns."""

    blocks: Array
    """(number of blocks, 6, 6) of the frames, in the pattern of the graph."""
    coupling: Array
    """(F, 6, B) of frames and border."""
    border: Array
    """(B, B)"""

    def times(self, vectors: Array) -> Array:
        """The inverse times columns (n, r)."""


def dense_matrix(reduction: Reduction, system: ReducedSystem) -> Array:
    """The reduced matrix (n, n), lower triangle, lengths last."""
    offset = 6 * reduction.graph.num_frames
    size = offset + len(system.border)
    matrix = np.zeros((size, size))
    _spread(reduction.graph, system.blocks, matrix)
    matrix[offset:, :offset] = coupling_columns(system).T
    matrix[offset:, offset:] = system.border
    return matrix


def coupling_columns(system: ReducedSystem) -> Array:
    """(6 F, B) of frames and border."""
    columns = np.swapaxes(system.coupling, 1, 2)
    return columns.reshape(6 * len(columns), len(system.border))


def right_side(system: ReducedSystem) -> Array:
    """(n,)"""
    return np.concatenate([system.right_frames.ravel(), system.right_border])


@kernel
def _spread(graph, blocks, matrix):
    for i in range(len(graph.frame)):
        for slot in range(graph.row_start[i], graph.row_start[i + 1]):
            j = graph.row_other[slot]
            for a in range(6):
                for b in range(6):
                    matrix[6 * i + a, 6 * j + b] = blocks[slot, b, a]


@kernel
def _collect(graph, matrix, blocks):
    for i in range(len(graph.frame)):
        for slot in range(graph.row_start[i], graph.row_start[i + 1]):
            j = graph.row_other[slot]
            for a in range(6):
                for b in range(6):
                    blocks[slot, b, a] = matrix[6 * i + a, 6 * j + b]


def inverse(
    reduction: Reduction, system: ReducedSystem, num_lengths: int
) -> Inverse | None:
    """The inverse of a system without damping; None if it is singular."""
    if reduction.kind == DENSE:
        matrix = inverse_of_lower(dense_matrix(reduction, system), num_lengths)
        return None if matrix is None else DenseInverse(reduction, matrix)
    bordered = Bordered.of(reduction, system, num_lengths)
    if bordered is None or bordered.is_singular(system):
        return None
    return BorderedInverse.of(bordered)


class DenseInverse:
    """Kept as one matrix."""

    def __init__(self, reduction: Reduction, matrix: Array) -> None:
        num_frames = reduction.graph.num_frames
        offset = 6 * num_frames
        self._matrix = matrix
        self.blocks = np.empty((reduction.graph.num_blocks, 6, 6))
        _collect(reduction.graph, matrix, self.blocks)
        num_border = len(matrix) - offset
        self.coupling = matrix[:offset, offset:].reshape(num_frames, 6, num_border)
        self.border = matrix[offset:, offset:]

    def times(self, vectors: Array) -> Array:
        """The inverse times columns (n, r)."""
        return self._matrix @ vectors


class Bordered:
    """A factor of the inner frames, and the Schur complement of the rest.

    The rest, *outer*: outer frames, then the border, lengths last.
    """

    def __init__(
        self,
        reduction: Reduction,
        factor: Factor,
        system: ReducedSystem,
        num_lengths: int,
    ) -> None:
        self.reduction, self.num_lengths = reduction, num_lengths
        self.factor = factor
        num_frames = reduction.graph.num_frames
        columns = np.arange(6 * num_frames).reshape(num_frames, 6)
        border = 6 * num_frames + np.arange(len(system.border))
        self.inner_cols = columns[self.factor.order].ravel()
        self.outer_cols = np.concatenate([columns[reduction.outer].ravel(), border])
        coupling = self._coupling(system)
        # LAPACK does not take matrices without columns.
        self.reach = self.factor.solve_half(coupling) if coupling.size else coupling
        self.complement = self._outer_block(system) - self.reach.T @ self.reach

    @classmethod
    def of(
        cls,
        reduction: Reduction,
        system: ReducedSystem,
        num_lengths: int,
        *,
        rough: bool = False,
    ) -> "Bordered | None":
        """None if the frames alone are not positive definite, as far as digits tell."""
        factor = reduction.rough_factor if rough else reduction.factor
        if not factor.factorize(system.blocks):
            return None
        return cls(reduction, factor, system, num_lengths)

    def _coupling(self, system: ReducedSystem) -> Array:
        """C (6 n, 6 outer frames + B) in the factor's order."""
        columns = [self._column(frame, system) for frame in self.reduction.outer]
        own = np.swapaxes(system.coupling, 1, 2)
        whole = np.concatenate([*columns, own], axis=2)
        return permuted(self.factor.order, whole)

    def _column(self, frame: int, system: ReducedSystem) -> Array:
        """Column block (F, 6, 6) of one frame."""
        graph = self.reduction.graph
        column = np.zeros((graph.num_frames, 6, 6))
        own = slice(graph.row_start[frame], graph.row_start[frame + 1])
        column[graph.row_other[own]] = system.blocks[own]
        later = np.flatnonzero(graph.row_other == frame)
        rows = np.searchsorted(graph.row_start, later, side="right") - 1
        column[rows] = np.swapaxes(system.blocks[later], 1, 2)
        return column

    def _outer_block(self, system: ReducedSystem) -> Array:
        """(o, o)"""
        border = symmetric(system.border)
        if not len(self.reduction.outer):
            return border
        (frame,) = self.reduction.outer
        own = system.blocks[self.reduction.graph.row_start[frame + 1] - 1]
        coupling = system.coupling[frame].T
        return np.block([[own, coupling], [coupling.T, border]])

    def step(self, right: Array) -> Array | None:
        """Solution (n,) or (n, r) of columns (n, r); None if the rest is singular."""
        half = self.factor.solve_half(right[self.inner_cols])
        rest = right[self.outer_cols] - self.reach.T @ half
        outer: Array | None = rest
        if len(rest):
            outer = solve_lower(self.complement.copy(), rest, self.num_lengths)
        if outer is None:
            return None
        inner = self.factor.solve_other_half(half - self.reach @ outer)
        out = np.empty_like(right)
        out[self.inner_cols], out[self.outer_cols] = inner, outer
        return out[:, 0] if right.shape[1] == 1 else out

    def is_singular(self, system: ReducedSystem) -> bool:
        """As for dense systems: by the norm of the inverse of the matrix without the
        lengths' forces, scaled to a unit diagonal."""
        size = len(self.inner_cols) + len(self.outer_cols)
        split = size - self.num_lengths
        root = np.sqrt(np.maximum(self._diagonal(system)[:split], 1e-300))[:, None]
        zeros = np.zeros((self.num_lengths, 1))

        def scaled_inverse(vectors: Array) -> Array:
            columns = vectors.reshape(split, -1)
            below = np.repeat(zeros, columns.shape[1], axis=1)
            found = self.step(np.concatenate([root * columns, below]))
            if found is None:
                raise np.linalg.LinAlgError
            return (root * found.reshape(size, -1)[:split]).reshape(vectors.shape)

        operator = LinearOperator(
            (split, split),
            matvec=scaled_inverse,
            rmatvec=scaled_inverse,
            matmat=scaled_inverse,
            rmatmat=scaled_inverse,
            dtype=np.float64,
        )
        try:
            norm = float(onenormest(operator))
        except np.linalg.LinAlgError:
            return True
        return not 1.0 / norm > SINGULAR

    def _diagonal(self, system: ReducedSystem) -> Array:
        """(n,) of the matrix, forces of the lengths taken out."""
        graph = self.reduction.graph
        own = system.blocks[graph.row_start[1:] - 1]
        frames = np.einsum("faa->fa", own).ravel()
        diagonal = np.concatenate([frames, np.diagonal(system.border)])
        if self.num_lengths:
            split = len(diagonal) - self.num_lengths
            stiff = -symmetric(system.border)[-self.num_lengths :, -self.num_lengths :]
            pull = np.concatenate(
                [
                    coupling_columns(system)[:, -self.num_lengths :],
                    system.border[-self.num_lengths :, : -self.num_lengths].T,
                ]
            )
            forces = np.linalg.solve(stiff, pull.T).T
            diagonal[:split] += np.sum(forces * pull, axis=1)
        return diagonal


class BorderedInverse:
    """Blocks of an inverse, from a factor of the inner frames."""

    def __init__(self, bordered: Bordered, outer: Array) -> None:
        """Args:
        bordered: the factor.
        outer: (o, o) inverse of its complement.
        """
        self._bordered = bordered
        reduction, graph = bordered.reduction, bordered.reduction.graph
        spread = bordered.reach  # A^-1 C
        if spread.size:
            spread = bordered.factor.solve_other_half(spread)
        num_outer, inner = 6 * len(reduction.outer), bordered.factor.order
        shape = (len(inner), 6, len(outer))
        coupling = np.empty((graph.num_frames, 6, len(outer)))
        coupling[inner] = -(spread @ outer).reshape(shape)
        on_outer = (len(reduction.outer), 6, len(outer))
        coupling[reduction.outer] = outer[:num_outer].reshape(on_outer)
        self.blocks = np.zeros((graph.num_blocks, 6, 6))
        bordered.factor.inverse_blocks(self.blocks)
        by_frame = np.zeros_like(coupling)
        by_frame[inner] = spread.reshape(shape)
        _add_through_border(graph, by_frame, coupling, self.blocks)
        for at, frame in enumerate(reduction.outer):
            _set_frame(graph, frame, coupling[:, :, 6 * at : 6 * at + 6], self.blocks)
        self.coupling = np.ascontiguousarray(coupling[:, :, num_outer:])
        self.border = outer[num_outer:, num_outer:]

    @classmethod
    def of(cls, bordered: Bordered) -> "BorderedInverse | None":
        """None if the complement is singular."""
        outer = inverse_of_lower(bordered.complement.copy(), bordered.num_lengths)
        return None if outer is None else cls(bordered, outer)

    def times(self, vectors: Array) -> Array:
        """The inverse times columns (n, r)."""
        found = self._bordered.step(vectors)
        if found is None:
            raise ValueError("the complement was positive when it was inverted")
        return found.reshape(vectors.shape)


@kernel
def _add_through_border(graph, spread, coupling, blocks):
    """Blocks of A^-1 += (A^-1 C) T^-1 (A^-1 C)^T; coupling = -(A^-1 C) T^-1."""
    num_outer = spread.shape[2]
    for i in range(len(graph.frame)):
        for slot in range(graph.row_start[i], graph.row_start[i + 1]):
            j = graph.row_other[slot]
            for b in range(6):
                for a in range(6):
                    total = 0.0
                    for k in range(num_outer):
                        total += coupling[j, b, k] * spread[i, a, k]
                    blocks[slot, b, a] -= total


@kernel
def _set_frame(graph, frame, column, blocks):
    """Blocks of one frame from its column (F, 6, 6)."""
    for i in range(len(graph.frame)):
        for slot in range(graph.row_start[i], graph.row_start[i + 1]):
            j = graph.row_other[slot]
            for a in range(6):
                for b in range(6):
                    if i == frame:
                        blocks[slot, b, a] = column[j, b, a]
                    elif j == frame:
                        blocks[slot, b, a] = column[i, a, b]
