"""Levenberg-Marquardt on the reduced system, with the policy the measurements chose."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property
from typing import Any, Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.error_models import REPROJECTION, ErrorModel, error_model
from uwsfm.solver.inner_iterations import settled
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.linear import schur
from uwsfm.solver.linear.reduced_steps import StepSolver
from uwsfm.solver.linear.reduction import DENSE, Reduction, analyse
from uwsfm.solver.linear.schur import ReducedSystem
from uwsfm.solver.losses import LOSS_CODES
from uwsfm.solver.normal_equations import (
    MIN_DIAGONAL,
    NormalEquations,
    empty_normal_equations,
    linearize,
    squared_errors,
    total_cost,
)
from uwsfm.solver.state import State
from uwsfm.solver.threads import num_threads
from uwsfm.solver.workspace import Workspace

# Two BLAS threads cost 200x on a small Cholesky when the cores are busy.
SINGLE_BLAS_BELOW = 1500

FASTEST_FALL = 0.01
"""Of the damping, where a step keeps what it promised: the bends of long transects want
a ten-thousandth of what a start needs."""

FALLS_SHORT = 0.75
"""Of the predicted decrease; a step below it is tried with settled points, too."""


class Stop(Enum):
    """Why the iterations ended."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "iteration limit"
    STALLED = "no step lowers the cost"


@dataclass(frozen=True, kw_only=True)
class LevenbergMarquardtOptions:
    error: str = "reprojection"
    """See `error_models.ERROR_CODES`."""
    loss: str = "l2"
    loss_scale_px: float = 3.0
    max_iterations: int = 50
    initial_damping: float = 1e-4
    """1e-2 when the normals may be more than 30 degrees off."""
    min_relative_decrease: float = 1e-9


class Term(Protocol):
    """What is known of poses, points and lengths, weighed against a noise in px."""

    def cost(self, state: State) -> float:
        """px^2"""

    def add_to(self, eqs: NormalEquations, state: State, layout: Layout) -> None:
        """Add J^T W J and J^T W r; a length writes its column."""


@dataclass(frozen=True, kw_only=True)
class Priors:
    """What is known beforehand: values of the border, and how well; and terms."""

    reference: State
    weights: Array
    """(C, BORDER_SIZE) (noise of an observation in px / standard deviation) squared;
    zero where nothing is known. A parameter that cameras share has one weight."""
    terms: tuple[Term, ...] = ()

    def cost(self, state: State) -> float:
        miss = state.border_difference(self.reference)
        own = 0.5 * float(np.sum(self.weights * miss**2))
        return own + sum(term.cost(state) for term in self.terms)

    def add_to(self, eqs: NormalEquations, state: State, layout: Layout) -> None:
        for term in self.terms:
            term.add_to(eqs, state, layout)
        miss = state.border_difference(self.reference)
        known = (self.weights > 0.0) & (layout.border_col != HELD)
        cols, weights = layout.border_col[known], self.weights[known]
        eqs.border[cols, cols] += weights
        eqs.border_grad[cols] += weights * miss[known]


@dataclass(frozen=True, kw_only=True)
class LevenbergMarquardtResult:
    state: State
    cost: float
    """0.5 sum rho, priors included, px^2."""
    squares: Array
    """(N,) squared reprojection errors in the layout's order, px^2, whatever error was
    minimised; NaN where a point cannot be projected."""
    num_iterations: int
    """Accepted and rejected steps."""
    stop: Stop

    @property
    def num_invalid(self) -> int:
        return int(np.count_nonzero(np.isnan(self.squares)))


class Problem:
    """A layout with its loss and priors: cost, linearisation and damped steps."""

    def __init__(
        self,
        layout: Layout,
        error: ErrorModel,
        options: LevenbergMarquardtOptions,
        priors: Priors | None,
    ) -> None:
        self.layout = layout
        self.error = error
        self.priors = priors
        self._loss = LOSS_CODES[options.loss]
        self._scale = options.loss_scale_px
        self._work = Workspace(layout)
        self._eqs = empty_normal_equations(layout)
        self._system: ReducedSystem | None = None

    @cached_property
    def reduction(self) -> Reduction:
        """How the reduced systems are solved."""
        return analyse(self.layout)

    @cached_property
    def _solver(self) -> StepSolver:
        return StepSolver(self.reduction, self.layout.num_lengths)

    def cost(self, state: State) -> tuple[float, int]:
        """Robust cost, priors included, and the number of valid errors."""
        cost, valid = total_cost(
            self._work, state.kernel_state(), self.error, self._loss, self._scale
        )
        if self.priors is not None:
            cost += self.priors.cost(state)
        return cost, valid

    def squares(self, state: State) -> Array:
        """Squared reprojection errors (N,) in the layout's order, px^2; NaN where
        invalid. The array is used again by the next call and by `cost`."""
        return squared_errors(self._work, state.kernel_state())

    def linearize(self, state: State) -> NormalEquations:
        """Normal equations at a state; the arrays are used again by the next call."""
        linearize(
            self._work,
            state.kernel_state(),
            self.error,
            self._loss,
            self._scale,
            self._eqs,
        )
        if self.priors is not None:
            self.priors.add_to(self._eqs, state, self.layout)
        return self._eqs

    def step(self, eqs: NormalEquations, damping: float) -> tuple[Array, Array] | None:
        """Steps of the reduced system (n,) and the points (P, 3); None if singular."""
        self._system = system = schur.reduced_system(
            self.layout, self.reduction.graph, eqs, damping, self._system
        )
        step = self._solver.step(system)
        if step is None:
            return None
        points_step = schur.substitute_back(
            self.layout, self.reduction.graph, eqs, system.inverses, step
        )
        return step, points_step

    def settled(self, state: State, damping: float) -> State | None:
        """Every point moved once more, alone; None for errors that are not pixels."""
        if self.error.code != REPROJECTION:
            return None
        return settled(self._work, state, self._loss, self._scale, damping)

    def predicted_decrease(
        self, eqs: NormalEquations, damping: float, step: Array, points_step: Array
    ) -> float:
        """How much the quadratic model falls: 0.5 delta^T (lambda D delta - g).

        A length's column holds its miss r and minus its variance v, and its step is the
        force (r + J delta) / v: with the miss before, 0.5 r^2 / v, the sum is the same.
        """
        free = self.layout.frame_col != HELD
        offset = self.layout.num_frame_cols
        lengths = self.layout.num_unknowns - offset
        stiff = np.einsum("aa->a", eqs.border)
        before = np.sum(eqs.border_grad[lengths:] ** 2 / -stiff[lengths:])
        frames = np.einsum("faa->fa", eqs.frames)[free]
        points = np.einsum("paa->pa", eqs.points)
        total = float(before) - float(step[offset:] @ eqs.border_grad)
        total += _damped(damping, stiff[:lengths], step[offset:][:lengths])
        for diagonal, grad, delta in (
            (frames, eqs.frames_grad[free], step[:offset].reshape(-1, 6)),
            (points, eqs.points_grad, points_step),
        ):
            total += _damped(damping, diagonal, delta)
            total -= float(np.vdot(delta, grad))
        return 0.5 * total


def _damped(damping: float, diagonal: Array, delta: Array) -> float:
    """lambda delta^T D delta."""
    weighed = np.maximum(diagonal, MIN_DIAGONAL)
    weighed *= delta
    return damping * float(np.vdot(weighed, delta))


Report = Callable[[int, float], None]


@cache
def _libraries() -> ThreadpoolController:
    """Found once: looking for them takes a millisecond."""
    return ThreadpoolController()


def suitable_blas(reduction: Reduction) -> AbstractContextManager[Any]:
    """A context with as many BLAS threads as a reduced system is worth.

    One for bands and fronts, of which most are small.
    """
    layout = reduction.layout
    size = layout.num_frame_cols + layout.num_border_cols
    large = reduction.kind == DENSE and size >= SINGLE_BLAS_BELOW
    limit = num_threads() if large else 1
    return _libraries().limit(limits=limit, user_api="blas")


def minimize(
    layout: Layout,
    start: State,
    options: LevenbergMarquardtOptions,
    priors: Priors | None = None,
    report: Report | None = None,
) -> LevenbergMarquardtResult:
    """Minimise a robust error from a start.

    Marquardt scaling by max(diagonal, 1e-6); the damping falls by
    max(1/100, 1 - (2 rho - 1)^3) on success and grows twice as fast at each failure. A
    step that falls short is tried with settled points, too:
    `uwsfm.solver.inner_iterations`.

    Raises:
        UwsfmError: the start is so wrong that nothing can be projected.
    """
    error = error_model(options.error, layout, start)
    problem = Problem(layout, error, options, priors)
    with suitable_blas(problem.reduction):
        return _iterate(problem, start, options, report)


def _iterate(
    problem: Problem,
    state: State,
    options: LevenbergMarquardtOptions,
    report: Report | None,
) -> LevenbergMarquardtResult:
    cost, valid = problem.cost(state)
    if valid == 0:
        raise UwsfmError(
            "no observation can be projected from the start values: check the signs of "
            "cam_from_rig and of the poses"
        )
    damping, growth = options.initial_damping, 2.0
    if report is not None:
        report(0, cost)
    # Below this all residuals are rounding errors (about 1e-11 px each).
    floor = 1e-22 * len(problem.layout.xy)
    eqs = problem.linearize(state)
    stop, iterations = Stop.MAX_ITERATIONS, 0
    for iterations in range(1, options.max_iterations + 1):
        if cost <= floor:
            stop = Stop.CONVERGED
            break
        steps = problem.step(eqs, damping)
        decrease, predicted = -1.0, 1.0
        if steps is not None:
            predicted = problem.predicted_decrease(eqs, damping, *steps)
            trial = state.moved(problem.layout, *steps)
            trial, trial_cost = _tried(problem, trial, damping, cost, predicted)
            decrease = cost - trial_cost
        if report is not None:
            report(iterations, min(cost, cost - decrease))
        if decrease > 0.0:
            relative, gain = decrease / cost, decrease / max(predicted, 1e-300)
            state, cost = trial, trial_cost
            damping *= max(FASTEST_FALL, 1.0 - (2.0 * gain - 1.0) ** 3)
            growth = 2.0
            if relative < options.min_relative_decrease:
                stop = Stop.CONVERGED
                break
            eqs = problem.linearize(state)
            continue
        if steps is not None and abs(predicted) < options.min_relative_decrease * cost:
            stop = Stop.CONVERGED
            break
        damping, growth = damping * growth, growth * 2.0
        if damping > 1e12:
            stop = Stop.STALLED
            break
    return LevenbergMarquardtResult(
        state=state,
        cost=cost,
        squares=problem.squares(state),
        num_iterations=iterations,
        stop=stop,
    )


def _tried(
    problem: Problem, trial: State, damping: float, cost: float, predicted: float
) -> tuple[State, float]:
    """A trial state and its cost; its points settled if that is better."""
    trial_cost, _ = problem.cost(trial)
    if cost - trial_cost >= FALLS_SHORT * predicted:
        return trial, trial_cost
    other = problem.settled(trial, damping)
    if other is None:
        return trial, trial_cost
    other_cost, _ = problem.cost(other)
    return (other, other_cost) if other_cost < trial_cost else (trial, trial_cost)
