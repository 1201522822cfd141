"""The paper's nested loops repeated as printed: how slowly the distances come in."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from many_pairs import CASES, Case, Task, simulate, start
from monte_carlo import warm_up
from settings import Settings
from tables import Row, Tables, column, markdown, select

import uwsfm
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.strategies import NestedLoops
from uwsfm.solver.layout import build_layout
from uwsfm.solver.levenberg_marquardt import LevenbergMarquardtOptions
from uwsfm.solver.state import State

TABLES = ("loops",)
NOISE_PX = 0.25
SHOWN = (1, 3, 10, 30, 100, 300)


def compute(settings: Settings) -> Iterator[tuple[str, list[Row]]]:
    yield "loops", table()


def table(case: Case = CASES[0], shown: tuple[int, ...] = SHOWN) -> list[Row]:
    """What is missing of the distances after so many passes, for one dive."""
    dive = simulate(Task(case=case, noise_px=NOISE_PX, seed=0))
    begin, _ = start(dive.scene, case)
    options = CalibrateOptions(loss="l2", strategy="nested")
    warm_up(loss="l2", strategy="nested")
    clock = time.perf_counter()
    end = uwsfm.calibrate(begin, loss="l2", strategy="nested")
    ends = np.array([port.distance for port in end.scene.ports])
    rows = [_row("root", end.summary.num_iterations, 0.0, time.perf_counter() - clock)]
    columns = options.border_columns(begin.cameras, np.zeros(2, bool))
    layout = build_layout(begin, columns)
    solver = LevenbergMarquardtOptions(error=options.error_name)
    loops, state = NestedLoops(layout, solver), State.from_scene(begin)
    clock, steps = time.perf_counter(), 0
    for number in range(1, max(shown) + 1):
        state, settled = loops.one_pass(replace(state))
        steps += settled.num_iterations
        if number in shown:
            missing = 1e3 * float(np.abs(state.ports[:, 3] - ends).max())
            seconds = time.perf_counter() - clock
            rows.append(
                _row(
                    f"{number} pass{'es' if number > 1 else ''}",
                    steps,
                    missing,
                    seconds,
                )
            )
    return rows


def _row(name: str, steps: int, missing_mm: float, seconds: float) -> Row:
    return {
        "how": name,
        "steps": steps,
        "missing_mm": missing_mm,
        "seconds": seconds,
    }


def plot(found: Tables, out: Path) -> None:
    """Nothing: the table says it all."""


def section(found: Tables) -> str:
    """What the README says."""
    rows = found["loops"]
    last, before = rows[-1], rows[-2]
    passes = [float(row["how"].split()[0]) for row in (before, last)]
    fall = np.log(last["missing_mm"] / before["missing_mm"])
    rate = float(np.exp(fall / (passes[1] - passes[0])))
    needed = np.log(0.01 / last["missing_mm"]) / np.log(rate) + passes[1]
    (root,) = select(rows, how="root")
    return TEXT.format(
        table=markdown(
            rows,
            {
                "how": ("nested strategy", ""),
                "missing_mm": ("missing of a distance, mm", ".3f"),
                "steps": ("steps of the outer loop", ".0f"),
                "seconds": ("time, s", ".2f"),
            },
        ),
        percent=100.0 * (1.0 - rate),
        needed=needed,
        minutes=needed * last["seconds"] / passes[1] / 60.0,
        root=root["seconds"],
        first=column(rows, "missing_mm")[1],
    )


TEXT = """## The nested loops, repeated as printed

One of the dives of figure 7 at 0.25 px. The loops of the paper's figure 5 (everything
but the distances by the virtual-camera error, then the distances by the reprojection
error) end where the distances stand still. `strategy="nested"` finds that end as a root
of their change; repeated as printed they come closer by {percent:.1f} % per pass, and
would need about {needed:.0f} passes, {minutes:.1f} minutes, for 0.01 mm:

{table}
"""
