"""`uwsfm demo` as a user runs it: warm, a second time, and what the first run costs."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

COMPILE = (
    "from uwsfm.jobs.compile_kernels import compile_kernels; print(compile_kernels(2))"
)
SOURCE = str(Path(__file__).resolve().parents[2])
IMPORT = "import uwsfm.cli.app, uwsfm.jobs.reconstruct"
ENTRY = "from uwsfm.cli.app import main; main()"
LAST_STAGES = ("refractive adjustment", "colours and export", "report")
"""Which every run does again; the ones before are kept between runs."""


def first_run() -> dict[str, Any]:
    """What a first run costs, with all cores.

    As README's first command: installed as a copy, without a cache, in the source
    folder. Then once more with the kernels that the first run left.

    Raises:
        RuntimeError: the source folder had kernels of its own compiled.
    """
    with tempfile.TemporaryDirectory() as name:
        site, cache, out = (Path(name) / part for part in ("site", "cache", "demo"))
        _run(["-m", "pip", "install", "-q", "--no-deps", f"--target={site}", SOURCE])
        command = [str(site / "bin" / "uwsfm"), "demo", "-o", str(out)]
        places = {"cwd": SOURCE, "PYTHONPATH": str(site), "UWSFM_CACHE_DIR": str(cache)}
        cold, _ = _run(command, **places)
        compiled = json.loads((out / "summary.json").read_text())["timings_s"]
        shutil.rmtree(out)
        warm, _ = _run(command, **places)
        kept = list((cache / "uwsfm" / "kernels").iterdir())
        if len(kept) != 1:
            raise RuntimeError(f"kernels were compiled for {len(kept)} installations")
    return {
        "cold_compilation_s": compiled["compiling kernels"],
        "cold_demo_s": cold,
        "warm_demo_s": warm,
        "cold_over_warm": cold / warm,
    }


def measure(small: bool) -> dict[str, Any]:
    """Seconds on the wall, with all cores; small: imports alone."""
    _run(["-c", IMPORT])  # reads the files once
    found: dict[str, Any] = {"imports_s": _run(["-c", IMPORT])[0]}
    if small:
        return found
    _run(["-c", COMPILE])  # the demo is warm even if nothing else was compiled yet
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "demo"
        arguments = ["-c", ENTRY, "demo", "-o", str(out)]
        clock = _children_s()
        first, _ = _run(arguments)
        found["cpu_s"] = _children_s() - clock
        stages = json.loads((out / "summary.json").read_text())["timings_s"]
        second, _ = _run(arguments)
        again = json.loads((out / "summary.json").read_text())["timings_s"]
    found["wall_s"], found["stages_s"] = first, stages
    found["second_run_s"] = second
    found["second_start_s"] = second - sum(again[stage] for stage in LAST_STAGES)
    return found


def _children_s() -> float:
    """CPU seconds of the processes that this one has started, and that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def _run(
    arguments: list[str], cwd: str | None = None, **environment: str
) -> tuple[float, str]:
    paths = os.pathsep.join(path for path in sys.path if path)
    clock = time.perf_counter()
    run = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        capture_output=True,
        text=True,
    )
    seconds = time.perf_counter() - clock
    if run.returncode != 0:
        raise RuntimeError(f"{arguments} failed: {run.stderr[-1000:]}")
    return seconds, run.stdout
