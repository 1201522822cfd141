"""Single-line faults planted into a copy of the package: does a test fail?

Operators, constants times 10 or 0.1, exchanged names and indices, units, factors and
arguments left out. A fault is run against the tests of its module alone (`GROUPS`), in a
process of its own with a time limit. What no test sees survives, and is listed with its
line before and after. The same seed plants the same faults; a run that was stopped goes
on, and faults that change nothing are in equivalent.json with the reason.

    python pipelines/faults/mutants.py --count 20 --seed 0 --work /tmp/mutants
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import importlib
import json
import os
import random
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

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent.json")
COPIED = ("uwsfm", "tests", "datasets", "pyproject.toml")
LEAST_SECONDS = 30.0
"""Of the time limit; else `PATIENCE` times what the tests take without a fault."""
PATIENCE = 5.0
WIDE = 150
"""Characters of a line that is shown whole; of longer ones, what is around the fault."""

_TABLES = ("test_printed_tables.py",)
_SUMMARY = ("test_summary_numbers.py",)
_REPORT = ("test_report_words.py", "test_report_numbers.py")
_MEASURED = ("test_measure_table.py",)
_LENGTHS = (
    *("test_known_lengths.py", "test_length_verdicts.py"),
    "test_lengths_file.py::test_wrong_positions_end_inone_sentence",
    "test_lengths_file.py::test_wrong_lengths_end_inone_sentence",
)
_STEPS = ("test_sfm_steps.py", "test_stale_work.py")
_PIPE = "test_verdict_shown.py::test_a_pipe_is_wide_enough_and_a_terminal_as_wide_as_it_is"

GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "console": {
        "console.py": (*_TABLES, "test_progress_display.py", "test_signals.py", _PIPE),
        "result_tables.py": _TABLES,
        "evaluate.py": ("test_comparison.py",),
    },
    "summary": {
        "export/summary.py": _SUMMARY,
        "export/verdict_summary.py": _SUMMARY,
        "export/halves_summary.py": _SUMMARY,
        "calibration/tilt.py": _SUMMARY,
        "export/housing.py": ("test_housing_comments.py",),
        "export/files.py": ("test_written_units.py",),
        "surface/units.py": ("test_written_units.py",),
        "surface/geotiff.py": ("test_written_units.py",),
    },
    "report": {
        f"report/{name}.py": _REPORT
        for name in ("words", "tables", "page", "halves", "gather", "left_files", "view")
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
        "known_lengths.py": _LENGTHS,
        "lengths_file.py": _LENGTHS,
        "calibration/lengths.py": _LENGTHS,
        "calibration/length_verdicts.py": _LENGTHS,
    },
    "step keys": {
        "sfm/steps.py": _STEPS,
        "sfm/start.py": _STEPS,
        "sfm/refractive_steps.py": _STEPS,
        "dense/maps.py": _STEPS,
    },
}
"""Modules of a kind, and the fast tests that concern each."""


# ---- Faults -------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """One edit of a module."""

    module: str
    line: int
    kind: str
    before: str
    after: str

    @property
    def key(self) -> str:
        return hashlib.sha1(repr(asdict(self)).encode()).hexdigest()[:16]


_OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.MatMult: ast.Mult,
}
_COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_EXCHANGED = {
    **{"min": "max", "max": "min", "any": "all", "all": "any"},
    **{"degrees": "radians", "radians": "degrees", "mean": "sum", "sum": "mean"},
    **{"asin": "sin", "nanmean": "nansum", "median": "mean", "argmin": "argmax"},
    **{"hypot": "dist", "nanmedian": "nanmean", "floor": "ceil", "minimum": "maximum"},
}
_IDENTITIES = ("sqrt", "abs", "degrees", "radians", "asin", "nan_to_num")
_FORM = {"strict", "encoding", "title_justify", "caption_justify", "no_wrap", "title"}
_FORM |= {"show_header", "style", "justify", "fontsize", "frameon"}
"""Arguments that change no number: checks, encodings, layout."""
_UNITS = {
    **{"mm": "m", "m": "mm", "px": "mm", "deg": "rad", "%": "", "cm2": "m2"},
    **{"m2": "cm2", "metre": "millimetre", "x": "y", "y": "x", "s": "ms"},
}


def faults(
    module: str, source: str, rng: random.Random | None = None
) -> Iterator[tuple[Fault, str]]:
    """All faults of a module, each with the text of the module that has it.

    Args:
        module: its path in the package.
        source: its text.
        rng: brings them into a random order; None: the order of the lines.
    """
    tree = ast.parse(source)
    plain = ast.unparse(tree).splitlines()
    edits = list(_edits(tree))
    if rng is not None:
        rng.shuffle(edits)
    for line, kind, holder, name, index, new in edits:
        old = getattr(holder, name)
        if index is not None:
            new = [*old[:index], *([] if new is None else [new]), *old[index + 1 :]]
        setattr(holder, name, new)
        try:
            text = ast.unparse(tree)
            compile(text, module, "exec")
        except (ValueError, SyntaxError):
            text = ""
        setattr(holder, name, old)
        lost, got = _difference(plain, text.splitlines())
        if text and (lost or got):
            yield Fault(module, line, kind, lost, got), text


def _difference(plain: list[str], text: list[str]) -> tuple[str, str]:
    """The lines in which two texts differ, each as one."""
    first = 0
    while first < min(len(plain), len(text)) and plain[first] == text[first]:
        first += 1
    last = 0
    while last < min(len(plain), len(text)) - first and plain[~last] == text[~last]:
        last += 1
    parts = (lines[first : len(lines) - last] for lines in (plain, text))
    lost, got = (" ".join(line.strip() for line in part) for part in parts)
    if max(len(lost), len(got)) <= WIDE:
        return lost, got
    same = len(os.path.commonprefix([lost, got]))
    rest = len(os.path.commonprefix([lost[same:][::-1], got[same:][::-1]]))
    start = max(0, same - WIDE // 3)
    cut = (text[start : len(text) - rest + WIDE // 3] for text in (lost, got))
    first_cut, second_cut = cut
    return first_cut, second_cut


_Edit = tuple[int, str, ast.AST, str, int | None, Any]


def _edits(tree: ast.Module) -> Iterator[_Edit]:
    """Line, kind, and what becomes of a field of a node, or of an entry of it."""
    for scope in [tree, *_functions(tree)]:
        names = _Names(scope)
        for holder, name, index, child, line in _expressions(scope):
            for kind, new in names.variants(child):
                yield line, kind, holder, name, index, new


def _functions(tree: ast.Module) -> Iterator[ast.AST]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node


_Place = tuple[ast.AST, str, int | None, ast.AST, int]


def _expressions(scope: ast.AST) -> Iterator[_Place]:
    """Every node of a scope that may be changed, by what holds it."""

    def inside(node: ast.AST, line: int) -> Iterator[_Place]:
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "ctx", "bases"):
                continue
            many = isinstance(value, list)
            for index, child in enumerate(value if many else [value]):
                if not isinstance(child, ast.AST) or _is_left_alone(child, node):
                    continue
                if isinstance(child, ast.keyword) and child.arg in _FORM:
                    continue
                at = getattr(child, "lineno", line)
                if isinstance(node, (ast.JoinedStr, ast.FormattedValue)):
                    at = line  # places inside are not right before Python 3.12
                yield node, name, index if many else None, child, at
                yield from inside(child, at)

    yield from inside(scope, getattr(scope, "lineno", 1))


def _is_left_alone(child: ast.AST, holder: ast.AST) -> bool:
    """Other scopes, docstrings, imports, types, and what is only checked of types."""
    if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Import)):
        return True
    if isinstance(child, (ast.ImportFrom, ast.Assert, ast.Global, ast.arguments)):
        return True
    if isinstance(holder, ast.Call) and getattr(holder.func, "id", "") == "isinstance":
        return True
    if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
        return True
    is_type_check = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
    typed = isinstance(holder, ast.Module) and isinstance(child, ast.Assign)
    alias = typed and isinstance(child.value, (ast.Subscript, ast.BinOp))
    if typed and isinstance(child.value, ast.BinOp):
        alias = "BitOr" in ast.dump(child.value)
    return is_type_check or alias


class _Names:
    """The names of a scope, which may be taken for each other."""

    def __init__(self, scope: ast.AST) -> None:
        self.keys: list[str] = []
        self.attributes: dict[str, list[str]] = {}
        for _, _, _, node, _ in _expressions(scope):
            if isinstance(node, ast.Subscript) and _is_text(node.slice):
                self.keys.append(node.slice.value)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                self.attributes.setdefault(node.value.id, []).append(node.attr)

    def variants(self, node: ast.AST) -> Iterator[tuple[str, ast.AST | None]]:
        """What a node may be exchanged for; None: it is left out."""
        found = getattr(self, f"_{type(node).__name__.lower()}", None)
        if found is not None:
            yield from found(node)

    def _binop(self, node: ast.BinOp) -> Iterator[tuple[str, ast.AST]]:
        other = _OPERATORS.get(type(node.op))
        if other is not None:
            yield "operator", ast.BinOp(node.left, other(), node.right)
        if isinstance(node.op, (ast.Mult, ast.Div, ast.Add, ast.Sub)):
            yield "left out", node.left
        if isinstance(node.op, (ast.Mult, ast.Add)):
            yield "left out", node.right

    def _unaryop(self, node: ast.UnaryOp) -> Iterator[tuple[str, ast.AST]]:
        if isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
            yield "sign", node.operand

    def _compare(self, node: ast.Compare) -> Iterator[tuple[str, ast.AST]]:
        for k, op in enumerate(node.ops):
            for other in _COMPARISONS[type(op)]:
                ops = [*node.ops[:k], other(), *node.ops[k + 1 :]]
                yield "comparison", ast.Compare(node.left, ops, node.comparators)

    def _boolop(self, node: ast.BoolOp) -> Iterator[tuple[str, ast.AST]]:
        other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield "and, or", ast.BoolOp(other, node.values)
        for k in range(len(node.values)):
            rest = [*node.values[:k], *node.values[k + 1 :]]
            yield "left out", rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)

    def _if(self, node: ast.If) -> Iterator[tuple[str, ast.AST]]:
        turned = ast.UnaryOp(ast.Not(), node.test)
        yield "condition", ast.If(turned, node.body, node.orelse)

    def _ifexp(self, node: ast.IfExp) -> Iterator[tuple[str, ast.AST]]:
        yield "condition", ast.IfExp(node.test, node.orelse, node.body)

    def _augassign(self, node: ast.AugAssign) -> Iterator[tuple[str, ast.AST]]:
        other = _OPERATORS.get(type(node.op))
        if other is not None:
            yield "operator", ast.AugAssign(node.target, other(), node.value)
        yield "left out", ast.Pass()

    def _expr(self, node: ast.Expr) -> Iterator[tuple[str, ast.AST]]:
        if isinstance(node.value, ast.Call):
            yield "left out", ast.Pass()

    def _continue(self, _: ast.Continue) -> Iterator[tuple[str, ast.AST]]:
        yield "left out", ast.Pass()

    def _comprehension(self, node: ast.comprehension) -> Iterator[tuple[str, ast.AST]]:
        if node.ifs:
            clean = ast.comprehension(node.target, node.iter, [], node.is_async)
            yield "condition", clean

    def _constant(self, node: ast.Constant) -> Iterator[tuple[str, ast.AST]]:
        value = node.value
        if isinstance(value, bool):
            yield "constant", ast.Constant(not value)
        elif isinstance(value, int) and abs(value) < 10:
            yield "constant", ast.Constant(value + 1)
        elif isinstance(value, (int, float)):
            yield "constant", ast.Constant(10 * value)
            yield "constant", ast.Constant(0.1 * value)
        elif isinstance(value, str):
            words = value.split(" ")
            for k, word in enumerate(words):
                bare = word.strip("(),.;:")
                if bare in _UNITS:
                    new = word.replace(bare, _UNITS[bare])
                    yield "unit", ast.Constant(
                        " ".join([*words[:k], new, *words[k + 1 :]])
                    )

    def _subscript(self, node: ast.Subscript) -> Iterator[tuple[str, ast.AST]]:
        if _is_text(node.slice):
            for other in _others(self.keys, node.slice.value):
                new = ast.Subscript(node.value, ast.Constant(other), node.ctx)
                yield "exchanged", new

    def _attribute(self, node: ast.Attribute) -> Iterator[tuple[str, ast.AST]]:
        if isinstance(node.value, ast.Name) and isinstance(node.ctx, ast.Load):
            for other in _others(self.attributes[node.value.id], node.attr):
                yield "exchanged", ast.Attribute(node.value, other, node.ctx)

    def _tuple(self, node: ast.Tuple) -> Iterator[tuple[str, ast.AST]]:
        for k in range(len(node.elts) - 1):
            yield "exchanged", type(node)(_swapped(node.elts, k), node.ctx)

    _list = _tuple

    def _call(self, node: ast.Call) -> Iterator[tuple[str, ast.AST]]:
        if getattr(node.func, "id", "") == "isinstance":
            return
        for k in range(len(node.args) - 1):
            yield "exchanged", ast.Call(node.func, _swapped(node.args, k), node.keywords)
        for k, keyword in enumerate(node.keywords):
            if keyword.arg in _FORM:
                continue
            kept = [*node.keywords[:k], *node.keywords[k + 1 :]]
            yield "left out", ast.Call(node.func, node.args, kept)
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in _EXCHANGED:
            other: ast.expr = ast.Name(_EXCHANGED[name], ast.Load())
            if isinstance(node.func, ast.Attribute):
                other = ast.Attribute(node.func.value, _EXCHANGED[name], ast.Load())
            yield "exchanged", ast.Call(other, node.args, node.keywords)
        if name in _IDENTITIES and len(node.args) == 1:
            yield "left out", node.args[0]


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _others(names: Sequence[str], own: str) -> list[str]:
    """Up to two other names: those that look most like it."""
    rest = sorted({*names} - {own})
    return difflib.get_close_matches(own, rest, 2, 0.5)


def _swapped(items: Sequence[ast.expr], k: int) -> list[ast.expr]:
    return [*items[:k], items[k + 1], items[k], *items[k + 2 :]]


def chosen(module: str, source: str, count: int, seed: int) -> list[tuple[Fault, str]]:
    """Some faults of a module, no two of a kind on a line; the same for a seed."""
    places: set[tuple[int, str]] = set()
    kept = []
    for fault, text in faults(module, source, random.Random(f"{seed} {module}")):
        place = (fault.line, fault.kind)
        if place not in places and len(kept) < count:
            places.add(place)
            kept.append((fault, text))
        if len(kept) == count:
            break
    return kept


# ---- Running ------------------------------------------------------------------------


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
    sys.dont_write_bytecode = True  # a fault may have the size and the second of another
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
        del sys.modules[name]


def _tested(
    tests: Sequence[str],
    log: Path,
    limit: float | None,
    prepare: Callable[[], None] = lambda: None,
) -> tuple[str, float]:
    """Run tests in a process of its own: "passed", "failed" or "timeout"; seconds."""
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        code = 70
        with suppress(BaseException):
            os.setsid()
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(out, stream)
            prepare()
            import pytest

            flags = ["-o", "addopts=--strict-markers", "-m", "not slow", "-x", "-q", "--tb=line"]
            code = int(pytest.main([*flags, "-p", "no:cacheprovider", *tests]))
        os._exit(code)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        seconds = time.monotonic() - start
        if done:
            passed = os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0
            return "passed" if passed else "failed", seconds
        if limit is not None and seconds > limit:
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "timeout", seconds
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


def run_group(
    name: str, options: argparse.Namespace, copy: _Copy, results: _Results
) -> Iterator[tuple[Fault, str]]:
    """Faults of a group of modules and what became of each.

    Raises:
        SystemExit: the tests fail without a fault.
    """
    same = equivalent()
    limits: dict[tuple[str, ...], float] = {}
    for module, names in GROUPS[name].items():
        if options.module and module not in options.module:
            continue
        tests = [f"tests/{test}" for test in names]
        texts = [(copy.tree / test.partition("::")[0]).read_bytes() for test in tests]
        mark = hashlib.sha1(b"".join(texts)).hexdigest()[:12]
        path = copy.tree / "uwsfm" / module
        dotted = "uwsfm." + module.removesuffix(".py").replace("/", ".")
        prepare = partial(_forget, dotted, copy.users)
        source, status = path.read_text(encoding="utf-8"), path.stat()
        for fault, text in chosen(module, source, options.count, options.seed):
            if (module, fault.before, fault.after) in same:
                yield fault, "equivalent"
                continue
            outcome = results.outcome(fault, mark)
            if outcome is None:
                log = options.work / "log.txt"
                if names not in limits:
                    state, seconds = _tested(tests, log, None)
                    if state != "passed":
                        sys.exit(f"{module}: tests fail without a fault: see {log}")
                    limits[names] = max(LEAST_SECONDS, PATIENCE * seconds)
                try:
                    path.write_text(text, encoding="utf-8")
                    state, _ = _tested(tests, log, limits[names], prepare)
                finally:
                    path.write_text(source, encoding="utf-8")
                    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
                outcome = {"passed": "survived", "failed": "killed"}.get(state, state)
                results.add(fault, outcome, mark)
            yield fault, outcome


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
    tree = _copy(options.work)
    copy = _Copy(tree, _load_package(tree))
    results = _Results(options.work / "results.jsonl")
    survivors: list[Fault] = []
    totals: Counter[str] = Counter()
    print("| group | module | killed | survived | equivalent | killed |")
    print("|---|---|---|---|---|---|")
    for group in options.group or GROUPS:
        counts: dict[str, Counter[str]] = {}
        for fault, outcome in run_group(group, options, copy, results):
            outcome = "killed" if outcome == "timeout" else outcome
            counts.setdefault(fault.module, Counter())[outcome] += 1
            if outcome == "survived":
                survivors.append(fault)
        for module, count in counts.items():
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
