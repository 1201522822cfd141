"""Runs that are killed at random moments, and disks that are full: both go on.

Every job runs once undisturbed. Then it is started again and again in a fresh folder,
killed (SIGKILL) at a random moment, and given the same command a second time: it must
find the same, byte by byte, leave nothing half-written and no process.

    python pipelines/faults/kills.py -o OUT --kills 40 --seed 0
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from full_disk import MOMENTS, filled_at
from small_dives import (
    DIVES,
    IMAGES,
    RIG,
    left_over,
    results,
    write_dive,
    write_dives,
)

NUM_FRAMES = 6
SURVEY_FRAMES = 14
"""More than the ten of a part: two parts."""
PATIENCE_SECONDS = 30.0
"""For the processes that a killed run had started: they end by themselves."""
TIMEOUT_SECONDS = 1800.0
COLUMNS = ("kills", "too late", "same", "other", "failed", "left over", "processes")


@dataclass(frozen=True)
class Job:
    """A command, and the folder of its results below the folder that it runs in."""

    command: list[str]
    out: str = "out"
    prepare: Callable[[Path], None] = field(default=lambda folder: None)
    """Puts into the folder what the command continues from."""


def jobs(inputs: Path) -> dict[str, Job]:
    """The jobs, on inputs that `write_inputs` wrote."""
    dive, survey = inputs / "dive", inputs / "survey"
    finished = inputs / "finished"
    run, long = (
        ["reconstruct", str(one / RIG), str(one / IMAGES), "-o", "out", "--no-report"]
        for one in (dive, survey)
    )

    def copied(folder: Path) -> None:
        shutil.copytree(finished, folder / "out")

    return {
        "reconstruct": Job(run),
        "refine": Job(
            ["refine", str(finished / "sparse"), str(dive / RIG), "-o", "out"]
            + ["--images", str(dive / IMAGES), "--no-report"]
        ),
        "dense": Job(["dense", "out"], prepare=copied),
        "batch": Job(
            ["batch", DIVES],
            out="results",
            prepare=lambda folder: shutil.copytree(
                inputs / "dives", folder, dirs_exist_ok=True
            ),
        ),
        "--submap-frames": Job([*long, "--submap-frames", "10"]),
    }


def write_inputs(folder: Path) -> None:
    """The dives, and a finished reconstruction of the first."""
    if (folder / "finished").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    write_dive(folder / "dive", NUM_FRAMES)
    write_dive(folder / "survey", SURVEY_FRAMES)
    write_dives(folder / "dives", NUM_FRAMES)
    command = jobs(folder)["reconstruct"].command
    done = subprocess.run(
        [*UWSFM, *command], cwd=folder, check=True, capture_output=True
    )
    assert done.returncode == 0
    (folder / "out").rename(folder / "finished")


UWSFM = [sys.executable, "-c", "from uwsfm.cli.app import main; main()"]


def started(job: Job, folder: Path) -> subprocess.Popen[bytes]:
    """The command in its folder, with temporary files of its own beside it."""
    (folder / "tmp").mkdir(exist_ok=True)
    environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
    return subprocess.Popen(
        [*UWSFM, *job.command],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=(folder / "stderr.txt").open("wb"),
    )


def fresh(job: Job, folder: Path) -> Path:
    """An empty folder with what the job continues from."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job.prepare(folder)
    return folder


def undisturbed(job: Job, folder: Path) -> tuple[dict[str, str], float]:
    """Hashes of the results, and the seconds that it took."""
    fresh(job, folder)
    began = time.monotonic()
    code = started(job, folder).wait(timeout=TIMEOUT_SECONDS)
    seconds = time.monotonic() - began
    if code not in (0, 3):  # 3: written, but does not fit
        raise SystemExit((folder / "stderr.txt").read_text())
    return results(folder / job.out), seconds


def killed(job: Job, folder: Path, delay: float) -> bool:
    """Start the job and kill it; whether that was before its end, and nothing of it
    was left running."""
    fresh(job, folder)
    process = started(job, folder)
    try:
        process.wait(timeout=delay)
        return False
    except subprocess.TimeoutExpired:
        pass
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    _, alive = psutil.wait_procs(children, timeout=PATIENCE_SECONDS)
    for child in alive:
        child.kill()
    if alive:
        raise ProcessLookupError(f"{len(alive)} processes outlived a killed run")
    return True


def trial(
    job: Job, folder: Path, delay: float, expected: dict[str, str]
) -> tuple[Counter[str], str]:
    """What became of one kill, in the words of `COLUMNS`, and details of what went
    wrong."""
    counts: Counter[str] = Counter(kills=1)
    try:
        if not killed(job, folder, delay):
            return Counter({"too late": 1}), ""
    except ProcessLookupError:
        counts["processes"] += 1
    code = started(job, folder).wait(timeout=TIMEOUT_SECONDS)
    found = results(folder / job.out)
    words = ""
    if code not in (0, 3):
        counts["failed"] += 1
        words = (folder / "stderr.txt").read_text()[-300:]
    elif found == expected:
        counts["same"] += 1
    else:
        counts["other"] += 1
        names = {n for n in found | expected if found.get(n) != expected.get(n)}
        words = f"differ: {', '.join(sorted(names))}"
    rest = left_over(folder) + list((folder / "tmp").iterdir())
    if rest:
        counts["left over"] += len(rest)
        words += f" left over: {rest[0]}"
    return counts, words


def kill_all(out: Path, kills: int, seed: int, names: list[str] | None) -> bool:
    """Print the table of the kills; whether all went well."""
    inputs = out / "inputs"
    write_inputs(inputs)
    chosen = {n: j for n, j in jobs(inputs).items() if not names or n in names}
    rng = np.random.default_rng(seed)
    print(f"| job | seconds | {' | '.join(COLUMNS)} |")
    print(f"|---|---|{'---|' * len(COLUMNS)}")
    well = True
    for index, (name, job) in enumerate(chosen.items()):
        folder = out / "trial"
        expected, seconds = undisturbed(job, folder)
        counts: Counter[str] = Counter()
        wanted = kills // len(chosen) + (index < kills % len(chosen))
        while counts["kills"] < wanted:
            # A run is a little faster or slower each time.
            more, words = trial(job, folder, rng.uniform(0.0, seconds), expected)
            counts += more
            if words:
                print(f"{name}: {words}", file=sys.stderr)
        cells = " | ".join(str(counts[column]) for column in COLUMNS)
        print(f"| `{name}` | {seconds:.0f} | {cells} |", flush=True)
        well &= counts["same"] == counts["kills"] and not (
            counts["left over"] or counts["processes"]
        )
    return well


def fill_all(out: Path) -> bool:
    """Print the table of the full disks; whether all went well."""
    inputs = out / "inputs"
    write_inputs(inputs)
    job = jobs(inputs)["reconstruct"]
    expected, _ = undisturbed(job, out / "trial")
    print(
        "\n| disk full after | how | message | after making room |\n|---|---|---|---|"
    )
    well = True
    for moment in MOMENTS:
        found = filled_at(moment, inputs / "dive", out / "disk", results)
        after = "same" if found.results == expected else "other"
        print(f"| {moment} | {found.how} | {found.message} | {after} |", flush=True)
        well &= found.one_sentence and after == "same" and not found.left_over
    return well


def main() -> int:
    """Print the tables; non-zero if a run did not go on to the same result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", action="append", help="Only these jobs.")
    parser.add_argument("--no-disk", action="store_true", help="No full disks.")
    options = parser.parse_args()
    out = options.out.absolute()
    well = True
    if options.kills:
        well = kill_all(out, options.kills, options.seed, options.job)
    if not options.no_disk:
        well &= fill_all(out)
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
