"""Absolute and relative poses on the protocol of Refractive COLMAP's paper.

    python pipelines/rsfm/poses.py -o OUT [--absolute 1000] [--relative 300]

OUT receives poses.md and two CSV files. Every method sees the same trials; times are of
one thread, without the making of the trials. 0 runs keep a table as it is.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).parent.parent / "paper"))

from pose_methods import (  # noqa: E402
    ABSOLUTE,
    RELATIVE,
    absolute_bound,
    absolute_errors,
    relative_bound,
    relative_errors,
)
from pose_trials import PORTS, absolute_trial, relative_trial  # noqa: E402
from tables import Row, markdown, read_csv, write_csv  # noqa: E402

from uwsfm._base.files import replaced_file  # noqa: E402
from uwsfm._base.signals import BEGINS_AGAIN  # noqa: E402
from uwsfm._base.tasks import LOCAL, Workers  # noqa: E402
from uwsfm.cli.console import ProgressBars  # noqa: E402

ABSOLUTE_CSV, RELATIVE_CSV = "absolute_pose.csv", "relative_pose.csv"
NOISES_PX = (0.0, 0.5, 1.2, 2.0)
PEER = "Refractive COLMAP"
# Its medians and times per pose, measured with its own programs: see README.md.
PEER_ABSOLUTE = {
    ("flat", 0.5): (0.0038, 0.141),
    ("flat", 1.2): (0.0102, 0.349),
    ("flat", 2.0): (0.0177, 0.609),
    ("dome", 0.5): (0.0047, 0.165),
    ("dome", 1.2): (0.0126, 0.448),
    ("dome", 2.0): (0.0229, 0.779),
}
PEER_RELATIVE = {("flat", 0.0): (0.21, 0.27), ("flat", 0.5): (0.153, 0.156)}
PEER_ABSOLUTE_MS, PEER_RELATIVE_MS = "6.8-12", "145"


def main() -> None:
    options = parse()
    options.out.mkdir(parents=True, exist_ok=True)
    cases = list(product(PORTS, NOISES_PX))
    with (
        Workers(options.scheduler, options.out, options.processes) as workers,
        ProgressBars(BEGINS_AGAIN) as progress,
    ):
        for name, function, runs, path in (
            ("absolute poses", absolute_rows, options.absolute, ABSOLUTE_CSV),
            ("relative poses", relative_rows, options.relative, RELATIVE_CSV),
        ):
            if runs:
                tasks = [(*case, runs) for case in cases]
                rows = sum(workers.run(function, tasks, name, progress), [])
                write_csv(rows, options.out / path)
    with replaced_file(options.out / "poses.md") as partial:
        partial.write_text(page(options.out), encoding="utf-8")
    print(options.out / "poses.md")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--absolute", type=int, default=1000, metavar="RUNS")
    parser.add_argument("--relative", type=int, default=300, metavar="RUNS")
    parser.add_argument("--processes", type=int, default=1, help="of this machine")
    parser.add_argument("--scheduler", default=LOCAL, help="of Dask: tcp://HOST:PORT")
    options = parser.parse_args()
    if min(options.absolute, options.relative) < 0:
        parser.error("RUNS must not be negative")
    return options


def absolute_rows(port: str, noise: float, runs: int) -> list[Row]:
    """One port and level of noise: a row per method."""
    trials = [absolute_trial(port, noise, seed) for seed in range(runs)]
    errors = errors_of(trials, ABSOLUTE, absolute_errors)
    rng = np.random.default_rng(0)
    draws = [d for trial in trials for d in absolute_bound(trial, noise, rng)]
    peer = PEER_ABSOLUTE.get((port, noise))
    measured = ("position_mm", PEER_ABSOLUTE_MS)
    rows = rows_of(port, noise, errors, measured, peer)
    return [*rows, row_of(port, noise, "bound", draws, "position_mm")]


def relative_rows(port: str, noise: float, runs: int) -> list[Row]:
    """One port and level of noise: a row per method."""
    trials = [relative_trial(port, noise, seed) for seed in range(runs)]
    errors = errors_of(trials, RELATIVE, relative_errors)
    rng = np.random.default_rng(0)
    draws = [d for trial in trials for d in relative_bound(trial, noise, rng)]
    peer = PEER_RELATIVE.get((port, noise))
    measured = ("direction_deg", PEER_RELATIVE_MS)
    rows = rows_of(port, noise, errors, measured, peer)
    return [*rows, row_of(port, noise, "bound", draws, "direction_deg")]


Errors = dict[str, list[tuple[float, float, float]]]
"""By method: rotation, position or direction, milliseconds of each trial."""


def errors_of(
    trials: Sequence[Any],
    methods: dict[str, Callable[[Any], Any]],
    compare: Callable[[Any, Any], tuple[float, float]],
) -> Errors:
    found: Errors = {name: [] for name in methods}
    with threadpool_limits(1):
        for name, method in methods.items():
            method(trials[0])  # loads kernels: not timed
            for trial in trials:
                began = time.process_time()
                pose = method(trial)
                spent = 1e3 * (time.process_time() - began)
                pair = (np.inf, np.inf) if pose is None else compare(pose, trial)
                found[name].append((*pair, spent))
    return found


def rows_of(
    port: str,
    noise: float,
    errors: Errors,
    measured: tuple[str, str],
    peer: tuple[float, float] | None,
) -> list[Row]:
    second, peer_ms = measured
    rows = [row_of(port, noise, name, runs, second) for name, runs in errors.items()]
    if peer is not None:
        row = row_of(port, noise, PEER, [peer], second)
        rows.append(
            {
                **row,
                f"p95_{second}": None,
                "milliseconds": peer_ms,
                "lost": None,
                "runs": None,
            }
        )
    return rows


def row_of(
    port: str, noise: float, method: str, runs: Sequence[Sequence[float]], second: str
) -> Row:
    """Medians over runs of (rotation, position or direction[, milliseconds])."""
    table = np.array(runs, dtype=float)
    return {
        "port": port,
        "noise_px": noise,
        "method": method,
        "runs": len(table),
        "rotation_deg": float(np.median(table[:, 0])),
        second: float(np.median(table[:, 1])),
        f"p95_{second}": float(np.percentile(table[:, 1], 95.0)),
        "milliseconds": float(np.median(table[:, 2])) if table.shape[1] > 2 else None,
        "lost": int(np.count_nonzero(~np.isfinite(table[:, 0]))),
    }


def page(out: Path) -> str:
    """The tables that are there, in Markdown."""
    common = {
        "port": ("port", ""),
        "noise_px": ("noise, px", ".1f"),
        "method": ("method", ""),
        "rotation_deg": ("rotation, deg", ".2g"),
    }
    end = {"milliseconds": ("CPU, ms", ".3g"), "lost": ("no pose", ".0f")}
    position = {
        "position_mm": ("position, mm", ".3g"),
        "p95_position_mm": ("95 %", ".3g"),
    }
    direction = {
        "direction_deg": ("direction, deg", ".2g"),
        "p95_direction_deg": ("95 %", ".2g"),
    }
    sections = [HEADER]
    for title, name, columns in (
        ("Absolute pose", ABSOLUTE_CSV, position),
        ("Relative pose", RELATIVE_CSV, direction),
    ):
        if (out / name).exists():
            rows = read_csv(out / name)
            runs = f"{rows[0]['runs']:.0f} runs"
            sections.append(f"## {title}: medians of {runs}")
            sections.append(markdown(rows, {**common, **columns, **end}))
    return "\n\n".join(sections) + "\n"


HEADER = """# Poses from matches

Made by `pipelines/rsfm/poses.py`; see [README.md](../README.md) for what is what."""


if __name__ == "__main__":
    main()
