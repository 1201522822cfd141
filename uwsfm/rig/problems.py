"""What is wrong with a file that has a schema, in one sentence with the key."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from uwsfm.rig.schema import ENTRIES, Entry


def first_problem(
    error: ValidationError, entries: Mapping[str, type[Entry]] = ENTRIES
) -> str:
    """The key path and sentence of the first problem, and the key paths of the others.

    Args:
        error: what pydantic found.
        entries: the blocks of the file by the keys they are under, for what was meant.
    """
    problems = error.errors(include_url=False)
    unknown = [p for p in problems if p["type"] in _UNKNOWN_KEY]
    # A misspelt key is one mistake, not an unknown key and a missing one.
    meant = {(*p["loc"][:-1], _meant_key(p["loc"], entries)) for p in unknown}
    doubled = [p for p in problems if p["type"] == "missing" and p["loc"] in meant]
    rest = [p for p in problems if not any(p is q for q in [*unknown, *doubled])]
    first, *others = [*unknown, *rest]
    sentence = f"{_key_path(first)}: {_sentence(first, entries)}"
    if others:
        plural = "s" if len(others) > 1 else ""
        paths = list(dict.fromkeys(map(_key_path, others)))
        if len(paths) > MAX_OTHERS:
            paths[MAX_OTHERS:] = ["..."]
        where = ", ".join(paths)
        sentence += f" (and {len(others)} more problem{plural} in this file: {where})"
    return sentence


MAX_OTHERS = 6


def _key_path(problem: Any) -> str:
    path = ""
    for part in problem["loc"]:
        if isinstance(part, int):
            path += f"[{part}]"
        elif not part.startswith("("):
            path += f".{part}"
    return path.lstrip(".")


_UNKNOWN_KEY = ("extra_forbidden", "invalid_key")
_WANTED = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "text (between quotes if it looks like a number)",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "model_type": "a block of keys",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge:g}",
    "less_than_equal": "at most {le:g}",
}


def _sentence(problem: Any, entries: Mapping[str, type[Entry]]) -> str:
    kind, value, context = problem["type"], problem["input"], problem.get("ctx", {})
    if kind == "missing":
        return "this key is missing"
    if kind in _UNKNOWN_KEY:
        return _unknown_key(problem["loc"], entries)
    if kind == "value_error":
        return str(context["error"])
    if kind in ("too_short", "too_long"):
        number = context.get("min_length", context.get("max_length"))
        return f"needs {number} values, got {len(value)}"
    if kind == "model_type" and value == "none":
        return "write {type: none}"
    if kind not in _WANTED:
        return problem["msg"]
    shown = "empty" if value is None else reprlib.repr(value)
    if isinstance(value, bool):
        shown = "yes (or true)" if value else "no (or false)"
    return f"must be {_WANTED[kind].format(**context)}, not {shown}"


_UNIT = re.compile(
    r"_(m|[mcµu]m|met(er|re)s?|in(ch(es)?)?|ft|px|pixels?|deg|rad|xyzw)$"
)


def _meant_key(
    loc: tuple[int | str, ...], entries: Mapping[str, type[Entry]]
) -> str | None:
    """The known key nearest to an unknown one: another unit, or a slip of the pen."""
    known, key = _known_keys(loc, entries), str(loc[-1]).lower()
    stem = _UNIT.sub("", key)
    close = [k for k in known if _UNIT.sub("", k) == stem]
    close += difflib.get_close_matches(key, known, n=1)
    return close[0] if close else None


def _known_keys(
    loc: tuple[int | str, ...], entries: Mapping[str, type[Entry]]
) -> list[str]:
    parents = [part for part in loc[:-1] if isinstance(part, str)]
    return list(entries[parents[-1] if parents else ""].model_fields)


def _unknown_key(loc: tuple[int | str, ...], entries: Mapping[str, type[Entry]]) -> str:
    meant = _meant_key(loc, entries)
    if meant is None:
        return f"unknown key; the keys here are {', '.join(_known_keys(loc, entries))}"
    unit = {"_m": " (in metres)", "_px": " (in pixels)", "_xyzw": " (w last)"}
    suffix = next((text for end, text in unit.items() if meant.endswith(end)), "")
    return f"unknown key, did you mean {meant}{suffix}?"
