"""Steps of a run of reduced systems, by factors that are rough, or of earlier ones.

A step need not be exact (Nocedal & Wright, Numerical Optimization, 2006, section 7.1),
and a factor of a large survey costs as much as ten solutions with it. Conjugate
gradients (ibid., algorithm 5.3) in full precision take one or two solutions with a
factor of seven digits, which costs half; and two or three with that of an earlier
system, if little has changed, as in the last iterations. Where they would take many
more, the system gets a factor of its own; one of all digits, if seven do not do.
"""

import numpy as np

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.linear.quasidefinite import solve_lower, symmetric
from uwsfm.solver.linear.reduced_factor import (
    Bordered,
    coupling_columns,
    dense_matrix,
    right_side,
)
from uwsfm.solver.linear.reduction import DENSE, SPARSE, Reduction
from uwsfm.solver.linear.schur import ReducedSystem

TOLERANCE = 1e-2
"""Error of a step, relative, in the norm of the quadratic model: the model falls by
1e-4 of its decrease less, and the next step makes up for it."""
FAR = 20.0
"""So many times stiffer than the factor's, a system is another one: they were 60 to 500
times after the first steps, at most 10 where conjugate gradients ended in time."""
NUMBER_FLOPS = 120.0
"""What a number of the factor costs in a solution, read twice from memory, in flops of
a large product."""
WORTH_IT = 3
"""Solutions, from 1500 frames or so; the factors of smaller surveys cost little."""


class StepSolver:
    """Solves the reduced systems of one minimisation, one after another."""

    def __init__(self, reduction: Reduction, num_lengths: int) -> None:
        """Args:
        reduction: their structure.
        num_lengths: how many of their last columns are lengths.
        """
        self._reduction, self._num_lengths = reduction, num_lengths
        self._most = _most_solutions(reduction, num_lengths)
        self._rough = self._most > 0
        self._bordered: Bordered | None = None

    def step(self, system: ReducedSystem) -> Array | None:
        """Step (n,) of frames and border; None if the damped system is singular."""
        right = right_side(system)
        if self._reduction.kind == DENSE:
            matrix = dense_matrix(self._reduction, system)
            return solve_lower(matrix, right, self._num_lengths)
        found = self._by_conjugate_gradients(system, right)
        if found is None and self._rough:
            self._bordered = self._factor(system)
            found = self._by_conjugate_gradients(system, right)
            self._rough = found is not None  # the damping falls: it would fail again
        if found is None:
            bordered = self._factor(system)
            found = None if bordered is None else bordered.step(right[:, None])
            self._bordered = bordered if self._most and found is not None else None
        return found

    def _factor(self, system: ReducedSystem) -> Bordered | None:
        self._bordered = None  # its numbers are overwritten
        return Bordered.of(
            self._reduction, system, self._num_lengths, rough=self._rough
        )

    def _by_conjugate_gradients(
        self, system: ReducedSystem, right: Array
    ) -> Array | None:
        if self._bordered is None:
            return None
        return solve_near(self._bordered, system, right, self._most)


def _most_solutions(reduction: Reduction, num_lengths: int) -> int:
    """With a factor that is not exact, that together cost half of one that is."""
    # Lengths make the system indefinite, which conjugate gradients do not solve.
    if reduction.kind != SPARSE or reduction.tree is None or num_lengths:
        return 0
    solution = NUMBER_FLOPS * 36.0 * reduction.tree.num_blocks
    most = int(0.5 * reduction.tree.cost / solution)
    return most if most >= WORTH_IT else 0


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
        if not 0.0 < bend < FAR * size:
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
