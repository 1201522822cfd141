"""Single-line faults planted into a copy of the package: does a test fail?

Operators, constants times 10 or 0.1, exchanged names and indices, units, factors and
arguments left out. A fault meets the tests of its module alone (`GROUPS`), in a process
of its own with a time limit. What no test sees survives, and is listed with its
line before and after. The same seed plants the same faults; a run that was stopped goes
on, and faults that change nothing are in equivalent.json with the reason.

    python pipelines/faults/mutants.py --count 20 --seed 0 --work /tmp/mutants
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from edits import Fault, chosen

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent.json")
COPIED = ("uwsfm", "tests", "datasets", "pyproject.toml")
LOG = "log.txt"
"""What the last tests printed."""
LEAST_SECONDS, PATIENCE = 20.0, 5.0
"""A fault may take so many times the processor time of the tests without one, and so
much more; on the wall, as others may be using the machine, `WAIT` times that."""
WAIT = 20.0
FIRST_SECONDS = 900.0
"""Of tests without a fault, which may have to compile kernels."""

_TABLES = ("test_printed_tables.py",)
_SUMMARY = ("test_summary_numbers.py", "test_summary_words.py")
_REPORT = ("test_report_words.py", "test_report_numbers.py", "test_report_plots.py")
_MEASURED = tuple(f"test_measure_{k}.py" for k in ("table", "numbers", "spots"))
_LENGTHS = (
    *("test_known_lengths.py", "test_length_verdicts.py", "test_lengths_placed.py"),
    "test_lengths_file.py::test_wrong_positions_end_inone_sentence",
    "test_lengths_file.py::test_wrong_lengths_end_inone_sentence",
)
_STEPS = ("test_sfm_steps.py", "test_stale_work.py")
_PIPE = (
    "test_verdict_shown.py::test_a_pipe_is_wide_enough_and_a_terminal_as_wide_as_it_is"
)

GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "console": {
        "cli/console.py": (
            *_TABLES,
            "test_progress_display.py",
            "test_signals.py",
            _PIPE,
        ),
        "cli/tables.py": _TABLES,
        "jobs/evaluate.py": ("test_comparison.py",),
    },
    "summary": {
        "results/summary.py": (*_SUMMARY, "test_images_counted.py"),
        "results/verdict_summary.py": _SUMMARY,
        "results/halves_summary.py": _SUMMARY,
        "calibration/tilt.py": ("test_tilt.py",),
        "results/housing.py": ("test_housing_comments.py",),
        "results/files.py": ("test_written_units.py",),
        "surface/units.py": ("test_written_units.py",),
        "surface/geotiff.py": ("test_written_units.py",),
    },
    "report": {
        f"report/{name}.py": _REPORT
        for name in (
            "words",
            "tables",
            "page",
            "halves",
            "gather",
            "left_files",
            "view",
        )
    },
    "measuring": {
        "measuring/measure.py": _MEASURED,
        "measuring/table.py": _MEASURED,
        "measuring/quantities.py": ("test_measure_quantities.py",),
        "measuring/spots.py": _MEASURED,
        "measuring/surface.py": _MEASURED,
        "measuring/picks.py": ("test_measure_picks.py",),
        "measuring/measurements_file.py": ("test_measure_picks.py",),
    },
    "known lengths": {
        "inputs/known_lengths.py": _LENGTHS,
        "inputs/lengths_file.py": _LENGTHS,
        "calibration/lengths.py": _LENGTHS,
        "calibration/length_verdicts.py": _LENGTHS,
    },
    "step keys": {
        "sfm/steps.py": _STEPS,
        "sfm/start.py": _STEPS,
        "sfm/refractive_steps.py": _STEPS,
        "dense/maps.py": ("test_stale_depth_maps.py",),
        "dense/stereo_maps.py": ("test_stale_depth_maps.py",),
        "dense/reduced.py": ("test_stale_depth_maps.py",),
    },
}
"""Modules of a kind, and the fast tests that concern each."""

ONLY = {
    "sfm/start.py": (
        "match_images",
        "start_from_matches",
        "_mask_content",
        "_rig_content",
    ),
    "sfm/refractive_steps.py": ("map_refractively",),
    "dense/maps.py": ("_path", "read", "require_images"),
    "dense/stereo_maps.py": ("key", "name"),
    "dense/reduced.py": ("content",),
}
"""Functions of a module that make keys; what steps do has tests that take longer."""


def _copy(work: Path) -> Path:
    """The package and its tests in a folder, times and all: kernels stay compiled."""
    tree = work / "tree"
    tree.mkdir(parents=True, exist_ok=True)
    for name in COPIED:
        source, target = ROOT / name, tree / name
        if source.is_dir():
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(source, target, ignore=ignore)
        else:
            shutil.copy2(source, target)
    shared = work / "shared"
    if (ROOT.parent / "shared").is_dir() and not shared.exists():
        shared.symlink_to((ROOT.parent / "shared").resolve())
    return tree


def _load_package(tree: Path) -> dict[str, set[str]]:
    """Import the whole copy once; names of its modules with those that import them.

    A test process begins as a copy of this one, and imports again what depends on the
    module with the fault (`_forget`): the kernels below it are there already.
    """
    sys.dont_write_bytecode = (
        True  # a fault may have the size and the second of another
    )
    os.chdir(tree)
    sys.path[:0] = [str(tree), str(tree / "tests")]
    os.environ["PYTHONPATH"] = str(tree)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for name in ("matplotlib.figure", "plotly.offline", "pytest", "typer.testing"):
        importlib.import_module(name)
    users: dict[str, set[str]] = {}
    for path in sorted((tree / "uwsfm").rglob("*.py")):
        name = ".".join(path.relative_to(tree).with_suffix("").parts)
        name = name.removesuffix(".__init__")
        if path.name == "__main__.py":
            continue
        importlib.import_module(name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                for item in node.names:
                    users.setdefault(item.name, set()).add(name)
            elif isinstance(node, ast.ImportFrom) and node.module:
                used = {node.module, *(f"{node.module}.{n.name}" for n in node.names)}
                for item in used:
                    users.setdefault(item, set()).add(name)
    return users


def _forget(module: str, users: Mapping[str, set[str]]) -> None:
    """Let a module be imported again, and all that imports it."""
    todo, stale = [module], set()
    while todo:
        name = todo.pop()
        if name not in stale:
            stale.add(name)
            todo += users.get(name, ())
    for name in stale & set(sys.modules):
        old = sys.modules.pop(name)
        package, _, last = name.rpartition(".")
        # ``from package import module`` would find the old one there.
        if package and vars(sys.modules.get(package, old)).get(last) is old:
            delattr(sys.modules[package], last)


def _tested(
    tests: Sequence[str],
    log: Path,
    limit: float,
    prepare: Callable[[], None] = lambda: None,
) -> tuple[bool, float]:
    """Run tests in a process of its own: whether they pass, and its processor time.

    Args:
        tests: files, or tests in them.
        log: gets what they print.
        limit: of the processor time, seconds.
        prepare: called first.
    """
    start, child = time.monotonic(), os.fork()
    if child == 0:
        code = 70
        with suppress(BaseException):
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 1))
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(out, stream)
            prepare()
            import pytest

            flags = ["-o", "addopts=--strict-markers", "-m", "not slow", "-x", "-q"]
            code = int(pytest.main([*flags, "-p", "no:cacheprovider", *tests]))
        os._exit(code)
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            passed = os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0
            return passed, used.ru_utime + used.ru_stime
        if time.monotonic() - start > WAIT * limit:
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
        time.sleep(0.02)


@dataclass(frozen=True)
class _Copy:
    """The copy of the package, imported."""

    tree: Path
    users: Mapping[str, set[str]]
    """Modules that import a module."""


class _Results:
    """What became of faults, a line each, kept between runs.

    A killed fault stays killed; one that survived is tried again when tests changed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[str, dict[str, Any]] = {}
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                row = json.loads(line)
                self.known[row["key"]] = row

    def add(self, fault: Fault, outcome: str, tests: str) -> None:
        row = {"key": fault.key, "outcome": outcome, "tests": tests, **asdict(fault)}
        self.known[fault.key] = row
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def outcome(self, fault: Fault, tests: str) -> str | None:
        row = self.known.get(fault.key)
        if row is None or (row["outcome"] == "survived" and row["tests"] != tests):
            return None
        return str(row["outcome"])


def equivalent() -> dict[tuple[str, str, str], str]:
    """Faults that change nothing that could be seen, and why: module, before, after."""
    rows = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    return {(r["module"], r["before"], r["after"]): r["reason"] for r in rows}


class _Runner:
    """Plants faults into the copy, one after another."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.count, self.seed, self.work = options.count, options.seed, options.work
        tree = _copy(self.work)
        self.copy = _Copy(tree, _load_package(tree))
        self.results = _Results(self.work / "results.jsonl")
        self.equivalent = equivalent()
        self._limits: dict[tuple[str, ...], float] = {}

    def outcomes(
        self, module: str, tests: tuple[str, ...]
    ) -> Iterator[tuple[Fault, str]]:
        """Some faults of a module and what became of each.

        Raises:
            SystemExit: the tests fail without a fault.
        """
        path = self.copy.tree / "uwsfm" / module
        source, mark = path.read_text(encoding="utf-8"), self._mark(tests)
        for fault, text in self._chosen(module, source):
            if (module, fault.before, fault.after) in self.equivalent:
                yield fault, "equivalent"
                continue
            outcome = self.results.outcome(fault, mark)
            if outcome is None:
                limit = self._limit(module, tests)
                outcome = self._planted(path, text, tests, limit)
                self.results.add(fault, outcome, mark)
            yield fault, outcome

    def _chosen(self, module: str, source: str) -> list[tuple[Fault, str]]:
        only = ONLY.get(module, ())
        return chosen(module, source, self.count, self.seed, only)

    def _mark(self, tests: tuple[str, ...]) -> str:
        """Of what the tests are made of."""
        folder = self.copy.tree / "tests"
        names = {test.partition("::")[0] for test in tests}
        paths = [path for path in folder.glob("*.py") if path.name[:5] != "test_"]
        paths += [folder / name for name in names]
        texts = b"".join(path.read_bytes() for path in sorted(paths))
        return hashlib.sha1(texts).hexdigest()[:12]

    def _limit(self, module: str, tests: tuple[str, ...]) -> float:
        if tests not in self._limits:
            passed, seconds = self._tested(tests, FIRST_SECONDS)
            if not passed:
                log = self.work / LOG
                sys.exit(f"{module}: its tests fail without a fault: see {log}")
            self._limits[tests] = LEAST_SECONDS + PATIENCE * seconds
        return self._limits[tests]

    def _planted(
        self, path: Path, text: str, tests: tuple[str, ...], limit: float
    ) -> str:
        source, status = path.read_text(encoding="utf-8"), path.stat()
        dotted = path.relative_to(self.copy.tree).with_suffix("").as_posix()
        forget = partial(_forget, dotted.replace("/", "."), self.copy.users)
        try:
            path.write_text(text, encoding="utf-8")
            passed, _ = self._tested(tests, limit, forget)
        finally:
            path.write_text(source, encoding="utf-8")
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        return "survived" if passed else "killed"

    def _tested(
        self,
        tests: tuple[str, ...],
        limit: float,
        prepare: Callable[[], None] = lambda: None,
    ) -> tuple[bool, float]:
        return _tested([f"tests/{t}" for t in tests], self.work / LOG, limit, prepare)


def main() -> int:
    """Print the table; non-zero if less than the share asked for was killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20, help="Faults per module.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--group", action="append", choices=GROUPS)
    parser.add_argument("--module", action="append", help="Only these, as in GROUPS.")
    parser.add_argument("--work", type=Path, required=True, help="Folder for the copy.")
    parser.add_argument("--share", type=float, default=0.9, help="Killed, at least.")
    options = parser.parse_args()
    options.work = options.work.resolve()
    runner = _Runner(options)
    survivors: list[Fault] = []
    totals: Counter[str] = Counter()
    print("| group | module | killed | survived | equivalent | share |")
    print("|---|---|---|---|---|---|", flush=True)
    for group in options.group or GROUPS:
        for module, tests in GROUPS[group].items():
            if options.module and module not in options.module:
                continue
            count: Counter[str] = Counter()
            for fault, outcome in runner.outcomes(module, tests):
                count[outcome] += 1
                if outcome == "survived":
                    survivors.append(fault)
            totals += count
            print(f"| {group} | {module} | {_cells(count)} |", flush=True)
    print(f"| all | | {_cells(totals)} |")
    for fault in survivors:
        print(f"{fault.module}:{fault.line}: {fault.kind}")
        print(f"  - {fault.before}\n  + {fault.after}")
    return int(_share(totals) < options.share)


def _share(count: Counter[str]) -> float:
    return count["killed"] / max(count["killed"] + count["survived"], 1)


def _cells(count: Counter[str]) -> str:
    kinds = [str(count[kind]) for kind in ("killed", "survived", "equivalent")]
    return " | ".join([*kinds, f"{_share(count):.0%}"])


if __name__ == "__main__":
    sys.exit(main())
