"""The whole solve of a survey, stage by stage, on one thread and on two."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import surveys
from child import peak_memory_mb
from numba.core import event
from threadpoolctl import threadpool_limits

from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.scene import Scene
from uwsfm.solver import levenberg_marquardt
from uwsfm.solver.layout import build_layout
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    LevenbergMarquardtResult,
    Problem,
    Report,
    minimize,
)
from uwsfm.solver.linear import schur
from uwsfm.solver.state import State
from uwsfm.solver.threads import limited

STAGES = (
    "linearise",
    "eliminate points",
    "factor and solve",
    "substitute back",
    "cost",
    "settle points",
    "rest",
)
_PLACES: tuple[tuple[str, Any, str], ...] = (
    ("structure", levenberg_marquardt, "analyse"),
    ("linearise", Problem, "linearize"),
    ("cost", Problem, "cost"),
    ("settle points", Problem, "settled"),
    ("step", Problem, "step"),
    ("eliminate points", schur, "reduced_system"),
    ("substitute back", schur, "substitute_back"),
)
WHERE_NEEDED = "settle points"
"""The only stage that a solve may do without."""
MAX_ITERATIONS = 50
SMALL_SOLVES = 5
"""At a time, a fifth of a second or more, while a larger survey waits."""
TURNS = 3
"""Of one thread and two, and of a survey with the smallest."""


class Solve:
    """The adjustment of a survey from its start."""

    def __init__(self, start: Scene) -> None:
        columns = CalibrateOptions(loss="l2").border_columns(
            start.cameras, np.zeros(len(start.cameras), dtype=bool)
        )
        clock = time.process_time()
        self.layout = build_layout(start, columns)
        self.state = State.from_scene(start)
        self.sorting_s = time.process_time() - clock

    def __call__(
        self, max_iterations: int = MAX_ITERATIONS, report: Report | None = None
    ) -> LevenbergMarquardtResult:
        options = LevenbergMarquardtOptions(max_iterations=max_iterations)
        return minimize(self.layout, self.state, options, report=report)


def measure(num_frames: int, smallest: int, folder: str) -> dict[str, Any]:
    """Times, memory and convergence of one survey.

    Both solves run to their end: where they start, one cost and one linearisation come
    before the first iteration, which are to weigh the same in both.

    Args:
        num_frames: A size in `surveys.SPECS`.
        smallest: That with which it takes turns.
        folder: Of the surveys.
    """
    truth = surveys.load(num_frames, folder)
    start = surveys.start_of(truth)
    before = peak_memory_mb()
    messages, compiled = _listen(), _count_compilations()
    solve = Solve(start)
    first, result = _timed(solve, num_threads=1)
    peak = peak_memory_mb()
    growth = _over_smallest(
        solve, Solve(surveys.start_of(surveys.load(smallest, folder)))
    )
    singles, doubles = [first], [_timed(solve, num_threads=2)[0]]
    for _ in range(TURNS - 1):
        singles.append(_timed(solve, num_threads=1)[0])
        doubles.append(_timed(solve, num_threads=2)[0])
    one, two = _mean(singles), _mean(doubles)
    if two["iterations"] != one["iterations"]:
        raise RuntimeError("two threads took another way than one")
    distances = result.state.ports[:, 3]
    return {
        "frames": start.num_frames,
        "points": start.num_points,
        "observations": start.num_observations,
        "setup_s": solve.sorting_s + one["structure_s"],
        "one_thread": one,
        "smallest": smallest,
        "over_smallest": growth,
        "two_threads": two,
        "peak_mb": peak,
        "peak_before_mb": before,
        "stop": result.stop.value,
        "rms_px": float(np.sqrt(np.nanmean(result.squares))),
        "noise_rms_px": surveys.NOISE_PX * float(np.sqrt(2.0)),
        "distance_error_mm": [
            1e3 * float(found - port.distance)
            for found, port in zip(distances, truth.ports, strict=True)
        ],
        "log": sorted(set(messages)),
        "compiled": len(compiled),
    }


def _mean(runs: list[Any]) -> Any:
    """Of the times of solves that took the same way."""
    if isinstance(runs[0], dict):
        return {key: _mean([run[key] for run in runs]) for key in runs[0]}
    if isinstance(runs[0], int):
        if len(set(runs)) > 1:
            raise RuntimeError("the same solve took two ways")
        return runs[0]
    return float(np.mean(runs))


def _over_smallest(large: Solve, small: Solve) -> float:
    """CPU per observation and iteration, over that of the smallest survey.

    They take turns after every iteration: the speed of a machine that is shared changes
    by the second.
    """
    times: list[float] = []

    def wait() -> None:
        times.extend(cpu_per_observation(small) for _ in range(SMALL_SOLVES))

    with limited(1), threadpool_limits(1):
        small(1)  # loads the kernels
        own = [cpu_per_observation(large, wait) for _ in range(TURNS)]
        return float(np.mean(own) / np.mean(times))


def cpu_per_observation(solve: Solve, wait: Callable[[], None] | None = None) -> float:
    """CPU seconds per observation and iteration, less what it waits meanwhile."""
    spent, begun = 0.0, None

    def report(iteration: int, cost: float) -> None:
        nonlocal spent, begun
        if begun is not None:  # else the structure was found
            spent += time.process_time() - begun
        if wait is not None:
            wait()
        begun = time.process_time()

    result = solve(report=report)
    assert begun is not None
    spent += time.process_time() - begun
    return spent / result.num_iterations / len(solve.layout.xy)


def _timed(
    solve: Solve, num_threads: int
) -> tuple[dict[str, Any], LevenbergMarquardtResult]:
    with limited(num_threads), threadpool_limits(num_threads):
        solve(1)  # loads the kernels and touches the memory
        with stopwatch() as clocks:
            wall, cpu = time.perf_counter(), time.process_time()
            result = solve()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    count = result.num_iterations
    # Found once, however many iterations there are.
    wall -= clocks["wall_s"]["structure"]
    cpu -= clocks["cpu_s"]["structure"]
    times = {
        "iterations": count,
        "structure_s": clocks["cpu_s"]["structure"],
        "wall_s": wall / count,
        "cpu_s": cpu / count,
        "cpu_us_per_observation": 1e6 * cpu / count / len(solve.layout.xy),
    }
    for kind, total in (("wall_s", wall), ("cpu_s", cpu)):
        stages = _exclusive(clocks[kind], total)
        times[f"stages_{kind}"] = {stage: stages[stage] / count for stage in STAGES}
    return times, result


def _exclusive(clock: Counter[str], total: float) -> dict[str, float]:
    """Stages that sum up to the total."""
    always = [stage for stage, _, _ in _PLACES if stage != WHERE_NEEDED]
    missing = [stage for stage in always if not clock[stage] > 0.0]
    if missing:
        raise RuntimeError(f"stage {missing[0]!r} was not called: has it moved?")
    stages = {stage: clock[stage] for stage in STAGES}
    inside = clock["eliminate points"] + clock["substitute back"]
    stages["factor and solve"] = clock["step"] - inside
    apart = ("linearise", "cost", "step", WHERE_NEEDED)
    stages["rest"] = total - sum(clock[stage] for stage in apart)
    return stages


@contextmanager
def stopwatch() -> Iterator[dict[str, Counter[str]]]:
    """Seconds of each stage, while this lasts: of the wall, and of all threads."""
    clocks: dict[str, Counter[str]] = {"wall_s": Counter(), "cpu_s": Counter()}
    with ExitStack() as stack:
        for stage, owner, name in _PLACES:
            stack.enter_context(_replaced(owner, name, _watched(stage, clocks)))
        yield clocks


def _watched(stage: str, clocks: dict[str, Counter[str]]) -> Callable:
    def decorate(function: Callable) -> Callable:
        def watched(*args: Any, **kwargs: Any) -> Any:
            wall, cpu = time.perf_counter(), time.process_time()
            result = function(*args, **kwargs)
            clocks["wall_s"][stage] += time.perf_counter() - wall
            clocks["cpu_s"][stage] += time.process_time() - cpu
            return result

        return watched

    return decorate


@contextmanager
def _replaced(owner: Any, name: str, decorate: Callable) -> Iterator[None]:
    original = getattr(owner, name)
    setattr(owner, name, decorate(original))
    try:
        yield
    finally:
        setattr(owner, name, original)


def _count_compilations() -> list[str]:
    """Kernels that the cache did not have: the compiler takes memory, too."""
    names: list[str] = []

    class Ears(event.Listener):
        def on_start(self, found: event.Event) -> None:
            names.append(str(found.data["dispatcher"]))

        def on_end(self, found: event.Event) -> None:
            pass

    event.register("numba:compile", Ears())
    return names


def _listen() -> list[str]:
    """What the solver says of its choices."""
    messages: list[str] = []

    class Ears(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(record.getMessage())

    logger = logging.getLogger("uwsfm.solver")
    logger.setLevel(logging.DEBUG)
    logger.addHandler(Ears())
    return messages
