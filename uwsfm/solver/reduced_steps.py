"""Steps of a run of reduced systems, of which each is near the one before.

A factor of a large survey costs as much as ten solutions with it, and the systems of
the last iterations hardly differ. Conjugate gradients, preconditioned by the factor of
an earlier system, then take two or three solutions (Nocedal & Wright, Numerical
Optimization, 2006, algorithm 5.3; 7.1 for why a step may be inexact). Where they would
take many more, the system gets a factor of its own.
"""

import numpy as np

from uwsfm._jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.quasidefinite import solve_lower, symmetric
from uwsfm.solver.reduced_factor import (
    Bordered,
    coupling_columns,
    dense_matrix,
    right_side,
)
from uwsfm.solver.reduction import DENSE, SPARSE, Reduction
from uwsfm.solver.schur import ReducedSystem

TOLERANCE = 1e-2
"""Error of a step, relative, in the norm of the quadratic model: the model falls by
1e-4 of its decrease less, and the next step makes up for it."""
NUMBER_FLOPS = 120.0
"""What a number of the factor costs in a solution, read twice from memory, in flops of
a large product."""


class StepSolver:
    """Solves the reduced systems of one minimisation, one after another."""

    def __init__(self, reduction: Reduction, num_lengths: int) -> None:
        """Args:
        reduction: their structure.
        num_lengths: how many of their last columns are lengths.
        """
        self._reduction, self._num_lengths = reduction, num_lengths
        self._bordered: Bordered | None = None
        self._most = _most_solutions(reduction, num_lengths)

    def step(self, system: ReducedSystem) -> Array | None:
        """Step (n,) of frames and border; None if the damped system is singular."""
        right = right_side(system)
        if self._reduction.kind == DENSE:
            matrix = dense_matrix(self._reduction, system)
            return solve_lower(matrix, right, self._num_lengths)
        if self._bordered is not None:
            found = solve_near(self._bordered, system, right, self._most)
            if found is not None:
                return found
        # A factor that fails has overwritten the one before.
        self._bordered = None
        bordered = Bordered.of(self._reduction, system, self._num_lengths)
        found = None if bordered is None else bordered.step(right[:, None])
        if self._most and found is not None:
            self._bordered = bordered
        return found


def _most_solutions(reduction: Reduction, num_lengths: int) -> int:
    """With an old factor, that together cost half of a new one."""
    # Lengths make the system indefinite, which conjugate gradients do not solve.
    if reduction.kind != SPARSE or reduction.tree is None or num_lengths:
        return 0
    solution = NUMBER_FLOPS * 36.0 * reduction.tree.num_blocks
    return int(0.5 * reduction.tree.cost / solution)


def solve_near(
    bordered: Bordered, system: ReducedSystem, right: Array, most: int
) -> Array | None:
    """Solution (n,) of a system by the factor of one that is near it.

    Args:
        bordered: factor of the other system.
        system: without lengths.
        right: (n,)
        most: solutions with the factor, after the first.

    Returns:
        None if so many will not do, or the system is not positive.
    """
    product = _Product(bordered.reduction, system)
    solution, residual = np.zeros_like(right), right.copy()
    ahead = bordered.step(residual[:, None])
    if ahead is None:
        return None
    direction, size = ahead, float(residual @ ahead)
    start = size
    for count in range(1, most + 1):
        image = product.times(direction)
        bend = float(direction @ image)
        if not bend > 0.0:
            return None
        solution += (size / bend) * direction
        residual -= (size / bend) * image
        ahead = bordered.step(residual[:, None])
        if ahead is None:
            return None
        before, size = size, float(residual @ ahead)
        left = np.sqrt(max(size, 0.0) / start)
        if left <= TOLERANCE:
            return solution
        # The errors fall at a steady rate, or faster.
        if left >= 1.0 or count * np.log(TOLERANCE) / np.log(left) > most:
            return None
        direction = ahead + (size / before) * direction
    return None


class _Product:
    """A reduced system times vectors (n,)."""

    def __init__(self, reduction: Reduction, system: ReducedSystem) -> None:
        self._graph, self._blocks = reduction.graph, system.blocks
        self._coupling = coupling_columns(system)
        self._border = symmetric(system.border)

    def times(self, vector: Array) -> Array:
        split = len(self._coupling)
        frames, border = vector[:split], vector[split:]
        out = np.empty_like(vector)
        out[:split] = self._coupling @ border
        out[split:] = frames @ self._coupling + self._border @ border
        _add_product(self._graph, self._blocks, frames, out)
        return out


@kernel
def _add_product(graph, blocks, vector, out):
    """out += A vector, for the frames."""
    for i in range(len(graph.frame)):
        end = graph.row_start[i + 1] - 1  # the row's own frame comes last
        for slot in range(graph.row_start[i], end + 1):
            j = graph.row_other[slot]
            for b in range(6):
                total = 0.0
                for a in range(6):
                    total += blocks[slot, b, a] * vector[6 * i + a]
                    if slot != end:
                        out[6 * i + a] += blocks[slot, b, a] * vector[6 * j + b]
                out[6 * j + b] += total
