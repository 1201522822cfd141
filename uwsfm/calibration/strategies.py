"""How the parameters are moved to the minimum: all at once, or as in the paper."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.row import DISTANCE
from uwsfm.residuals import border
from uwsfm.scene import IndexArray
from uwsfm.solver.error_models import error_model
from uwsfm.solver.layout import HELD, Layout, with_columns
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    LevenbergMarquardtResult,
    Priors,
    Problem,
    Report,
    Stop,
    minimize,
)
from uwsfm.solver.normal_equations import MIN_DIAGONAL
from uwsfm.solver.state import State

Strategy = Callable[
    [Layout, State, LevenbergMarquardtOptions, Priors | None, Report | None],
    LevenbergMarquardtResult,
]

TOLERANCE = 1e-5
"""Of the nested strategy's distances, relative."""

MIN_START = 1e-3
"""Of its distances, metres: all its steps are relative."""


def minimize_nested(
    layout: Layout,
    state: State,
    options: LevenbergMarquardtOptions,
    priors: Priors | None = None,
    report: Report | None = None,
) -> LevenbergMarquardtResult:
    """The nested loops of Sedlazeck & Koch (BMVC 2011), fig. 5, run to their end.

    The outer loop minimises ``options.error`` over everything but the port distances,
    the inner one the reprojection error over the distances alone. Neither lowers the
    other's cost: they end where the distances stand still. Repeated as printed, they
    gain half a per cent of what is missing at a time; the same end is found here as the
    root of the distances' change, by Powell's hybrid method, in some ten passes.
    """
    from scipy.optimize import root  # heavy, and only this strategy needs it

    loops = NestedLoops(layout, options, priors)
    passes = _Passes(loops, state, report)
    if not np.any(loops.free):
        return loops.settle(state)
    found = root(
        passes.change,
        np.maximum(state.ports[loops.free, DISTANCE], MIN_START),
        method="hybr",
        options={
            "xtol": TOLERANCE,
            "eps": 1e-4,  # differences of 1 %, far above what a solve leaves open
            "factor": 0.3,  # a longer first step overshoots, to false roots below zero
            "maxfev": options.max_iterations,
        },
    )
    final = loops.settle(passes.state_at(found.x))  # the last pass was a trial
    stop = Stop.CONVERGED if found.success else Stop.MAX_ITERATIONS
    if final.stop is not Stop.CONVERGED:
        stop = final.stop
    iterations = passes.num_iterations + final.num_iterations
    return replace(final, num_iterations=iterations, stop=stop)


class NestedLoops:
    """One pass of the paper's two loops, and the problem they share."""

    def __init__(
        self,
        layout: Layout,
        options: LevenbergMarquardtOptions,
        priors: Priors | None = None,
    ) -> None:
        held = layout.border_col.copy()
        held[:, border.DISTANCE] = HELD
        self.outer = _compacted(layout, held)
        self.inner = _distances_only(layout)
        self._options, self._priors = options, priors
        wanted = self.inner.border_col[:, border.DISTANCE] != HELD
        seen = np.bincount(layout.camera, minlength=len(wanted)) > 0
        self.free: NDArray[np.bool_] = wanted & seen
        """(C,) distances that move."""

    def settle(self, state: State) -> LevenbergMarquardtResult:
        """The outer loop: everything but the distances."""
        return minimize(self.outer, state, self._options, self._priors)

    def one_pass(self, state: State) -> tuple[State, LevenbergMarquardtResult]:
        """The outer loop, then the inner one.

        Raises:
            UwsfmError: the outer loop ended where no observation can be projected.
        """
        settled = self.settle(state)
        if settled.num_invalid == len(settled.squares):
            distances = ", ".join(f"{value:.3f}" for value in state.ports[:, DISTANCE])
            raise UwsfmError(
                f"no observation can be projected any more at port distances of "
                f"{distances} m: start closer to the truth, or use strategy='joint'"
            )
        moved = _best_distances(self.inner, settled.state, self._options, self._priors)
        return moved, settled


class _Passes:
    """How a pass changes the distances, as a function of the distances."""

    def __init__(self, loops: NestedLoops, state: State, report: Report | None) -> None:
        self._loops, self._report = loops, report
        self.state = state
        self.num_iterations = 0

    def change(self, distances: Array) -> Array:
        self.state = self.state_at(distances)
        moved, settled = self._loops.one_pass(self.state)
        self.state = settled.state
        self.num_iterations += settled.num_iterations
        if self._report is not None:
            self._report(self.num_iterations, settled.cost)
        return moved.ports[self._loops.free, DISTANCE] - distances

    def state_at(self, distances: Array) -> State:
        """The latest state, with other distances."""
        ports = self.state.ports.copy()
        ports[self._loops.free, DISTANCE] = distances
        return replace(self.state, ports=ports)


def _compacted(layout: Layout, columns: IndexArray) -> Layout:
    """A layout whose columns have no gaps."""
    free = columns != HELD
    compact = columns.copy()
    compact[free] = np.unique(columns[free], return_inverse=True)[1]
    return with_columns(layout, compact)


def _distances_only(layout: Layout) -> Layout:
    columns = np.full_like(layout.border_col, HELD)
    free = layout.border_col[:, border.DISTANCE] != HELD
    columns[free, border.DISTANCE] = np.arange(np.count_nonzero(free))
    return with_columns(layout, columns)


def _best_distances(
    layout: Layout,
    state: State,
    options: LevenbergMarquardtOptions,
    priors: Priors | None,
) -> State:
    """Gauss-Newton on the reprojection error, over the distances alone."""
    options = replace(options, error="reprojection")
    error = error_model(options.error, layout, state)
    problem = Problem(layout, error, options, priors)
    for _ in range(10):
        eqs = problem.linearize(state)
        # Diagonal, as an observation has one camera; zero for a camera without any.
        curvature = np.maximum(np.diag(eqs.border), MIN_DIAGONAL)
        step = -eqs.border_grad / curvature
        still = np.zeros(layout.num_frame_cols)
        state = state.moved(
            layout, np.concatenate([still, step]), np.zeros_like(state.points)
        )
        if np.abs(step).max(initial=0.0) < 1e-9:  # a nanometre
            break
    return state


STRATEGIES: dict[str, Strategy] = {"joint": minimize, "nested": minimize_nested}
