"""Single-line faults of a Python module, by its syntax tree: see mutants.py."""

from __future__ import annotations

import ast
import difflib
import hashlib
import os
import random
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

WIDE = 150
"""Characters of a line that is shown whole; of others, what is around the fault."""


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
_EITHER_WAY = {"min", "max", "hypot", "maximum", "minimum"}
"""Calls whose arguments may be exchanged."""
_IDENTITIES = ("sqrt", "abs", "degrees", "radians", "asin", "nan_to_num")
_FORM = {"strict", "encoding", "title_justify", "caption_justify", "no_wrap", "title"}
_FORM |= {"show_header", "style", "justify", "fontsize", "frameon", "indent"}
"""Arguments that change no number: checks, encodings, layout."""
_UNITS = {
    **{"mm": "m", "m": "mm", "px": "mm", "deg": "rad", "%": "", "cm2": "m2"},
    **{"m2": "cm2", "metre": "millimetre", "x": "y", "y": "x", "s": "ms"},
}


def faults(
    module: str,
    source: str,
    rng: random.Random | None = None,
    only: Sequence[str] = (),
) -> Iterator[tuple[Fault, str]]:
    """All faults of a module, each with the text of the module that has it.

    Args:
        module: its path in the package.
        source: its text.
        rng: brings them into a random order; None: the order of the lines.
        only: names of functions; empty: all of the module.
    """
    tree = ast.parse(source)
    plain = ast.unparse(tree).splitlines()
    edits = list(_edits(tree, only))
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


def _edits(tree: ast.Module, only: Sequence[str]) -> Iterator[_Edit]:
    """Line, kind, and what becomes of a field of a node, or of an entry of it."""
    for scope in [tree, *_functions(tree)]:
        if only and getattr(scope, "name", "") not in only:
            continue
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
    if isinstance(holder, ast.ExceptHandler) and child is holder.type:
        return True
    if isinstance(holder, ast.Call) and getattr(holder.func, "id", "") == "isinstance":
        return True
    if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
        return True
    is_type_check = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(
        child.test
    )
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
                    yield (
                        "unit",
                        ast.Constant(" ".join([*words[:k], new, *words[k + 1 :]])),
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
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name == "isinstance":
            return
        for k in range(len(node.args) - 1 if name not in _EITHER_WAY else 0):
            swapped = _swapped(node.args, k)
            yield "exchanged", ast.Call(node.func, swapped, node.keywords)
        for k, keyword in enumerate(node.keywords):
            if keyword.arg in _FORM:
                continue
            kept = [*node.keywords[:k], *node.keywords[k + 1 :]]
            yield "left out", ast.Call(node.func, node.args, kept)
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


def chosen(
    module: str, source: str, count: int, seed: int, only: Sequence[str] = ()
) -> list[tuple[Fault, str]]:
    """Some faults of a module, no two of a kind on a line; the same for a seed."""
    rng = random.Random(f"{seed} {module}")
    places: set[tuple[int, str]] = set()
    kept = []
    for fault, text in faults(module, source, rng, only):
        place = (fault.line, fault.kind)
        if place not in places and len(kept) < count:
            places.add(place)
            kept.append((fault, text))
        if len(kept) == count:
            break
    return kept
