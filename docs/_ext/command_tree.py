"""The commands of uwsfm with their options, read from the program itself."""

from __future__ import annotations

import enum
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from uwsfm.cli.app import app


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One argument or option of a command."""

    names: tuple[str, ...]
    is_argument: bool
    kind: str
    choices: tuple[str, ...]
    required: bool
    repeated: bool
    default: str
    help: str


@dataclass(frozen=True, kw_only=True)
class Command:
    """One command, as a person types it."""

    name: str
    help: str
    parameters: tuple[Parameter, ...]
    parse: Callable[[list[str]], tuple[dict[str, Any], list[str]]]
    """Splits arguments into options and the rest; raises for unknown options."""


def commands() -> dict[str, Command]:
    """All commands by name, the global options under the empty name."""
    root = typer.main.get_command(app)
    found = {"": _command(root, "")}
    for name, command in _walk(root, ""):
        found[name] = _command(command, name)
    return found


def _walk(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        full = f"{prefix} {name}".strip()
        if hasattr(command, "commands"):
            yield from _walk(command, full)
        else:
            yield full, command


def _command(command: Any, name: str) -> Command:
    hints = typing.get_type_hints(command.callback) if command.callback else {}

    def parse(args: list[str]) -> tuple[dict[str, Any], list[str]]:
        context = command.context_class(command, info_name=name)
        options, rest, _ = command.make_parser(context).parse_args(args)
        return options, rest

    return Command(
        name=name,
        help=" ".join((command.help or "").split()),
        parameters=tuple(
            _parameter(param, hints.get(param.name))
            for param in command.params
            if not param.name.endswith("_completion") and param.name != "help"
        ),
        parse=parse,
    )


def _parameter(param: Any, hint: Any) -> Parameter:
    hint = _without_none(hint)
    repeated = typing.get_origin(hint) is list
    if repeated:
        (hint,) = typing.get_args(hint)
    choices = _choices(hint)
    is_argument = param.param_type_name == "argument"
    return Parameter(
        names=(*param.opts, *param.secondary_opts),
        is_argument=is_argument,
        kind=_kind(param, hint, choices),
        choices=choices,
        required=bool(param.required),
        repeated=repeated,
        default=_default(param),
        help=" ".join((param.help or "").split()),
    )


def _without_none(hint: Any) -> Any:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        return kinds[0]
    return hint


def _choices(hint: Any) -> tuple[str, ...]:
    if typing.get_origin(hint) is typing.Literal:
        return tuple(str(value) for value in typing.get_args(hint))
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return tuple(str(item.value) for item in hint)
    return ()


def _kind(param: Any, hint: Any, choices: tuple[str, ...]) -> str:
    if choices:
        return ", ".join(f"`{choice}`" for choice in choices)
    if param.metavar and param.param_type_name != "argument":
        return param.metavar.strip("{}[]").replace("|", " or ")
    names = {bool: "switch", int: "whole number", float: "number", Path: "path"}
    return names.get(hint, "text")


def _default(param: Any) -> str:
    value = param.default
    if param.required or value is None or callable(value):
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, enum.Enum):
        value = value.value
    return f"`{value}`"
