"""Options that are declared once: each in the field of a dataclass.

A field made by `option` has its type, default, bounds, unit and help; `group` nests
another such dataclass. From these declarations come the options of a command, the keys
of --config and of dives.yaml, the command in a report, and options.yaml. The types that
a declaration may have, each with None or without:

    bool, int, float, str, Path, Literal["a", "b"]
    tuple[Literal["a", "b"], ...]     may be repeated on the command line
    tuple[float, float, float]        X,Y,Z
    Mapping[str, float]               KEY=VALUE, may be repeated; `keys` names the keys
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from uwsfm.errors import InputError

_OPTION, _GROUP = "option", "group"

Options = TypeVar("Options")
Kind = TypeVar("Kind")


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """What the field of an option says beside its name, type and default."""

    help: str
    """A full sentence or noun phrase. The command line adds the default, unless it is
    None: then the help says what happens."""
    name: str | None = None
    """In Python and in files; None: that of the field."""
    flag: str | None = None
    """On the command line; None: the name with hyphens."""
    unit: str | None = None
    """In the plural; the command line shows it in the place of the value."""
    metavar: str | None = None
    """How the value is written, where a unit does not say it."""
    minimum: float | None = None
    maximum: float | None = None
    because: str | None = None
    """Why there is a minimum, for the error."""
    positive: bool = False
    """Greater than 0, and finite."""
    keys: tuple[str, ...] = ()
    """Of a mapping."""
    per_dive: bool = True
    """False: of the machine, and decided once for all dives of a batch."""


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option where it stands among the options of a job."""

    name: str
    path: tuple[str, ...]
    """Names of the fields that lead to it from the options of the job."""
    type: Any
    """Without None."""
    default: Any
    panel: str | None
    """Title of its group in the help."""
    declared: Declaration

    @property
    def flag(self) -> str:
        """As it is typed, for instance --max-features."""
        return self.declared.flag or _flag_of(self.name)

    @property
    def negative_flag(self) -> str:
        """What turns it off, if it is a switch."""
        return f"--no-{self.flag[2:]}"

    @property
    def metavar(self) -> str | None:
        """What the help shows in the place of the value; None: its type."""
        return self.declared.metavar or (self.declared.unit or "").upper() or None

    @property
    def label(self) -> str:
        """How an error names it: also by its flag, if that is spelt otherwise."""
        if self.flag == _flag_of(self.name):
            return self.name
        return f"{self.flag} ({self.name})"

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it may be, or that may be among its values."""
        item = get_args(self.type)[0] if self.is_list else self.type
        return get_args(item) if get_origin(item) is Literal else ()

    @property
    def is_list(self) -> bool:
        """Whether it has any number of words."""
        return get_origin(self.type) is tuple and get_args(self.type)[-1] is Ellipsis

    @property
    def is_vector(self) -> bool:
        """Whether it is three numbers, X,Y,Z."""
        return get_origin(self.type) is tuple and not self.is_list

    @property
    def is_mapping(self) -> bool:
        """Whether it is numbers by key, KEY=VALUE."""
        return get_origin(self.type) is not None and not (
            self.is_list or self.is_vector or self.choices
        )

    def value_of(self, given: Any) -> Any:
        """What was given in Python or in a file, as the declared type."""
        if self.is_list:
            return tuple(given or ())
        if self.is_mapping:
            return dict(given or {})
        if given is None:
            return None
        if self.is_vector:
            try:
                return tuple(float(number) for number in given)
            except (TypeError, ValueError):
                raise InputError(
                    f"{self.label} must be three numbers, got {given!r}"
                ) from None
        return Path(given) if self.type is Path else given

    def texts(self, value: Any) -> list[str]:
        """A value as it is typed after the flag: one text for each time it is given."""
        if self.is_vector:
            return [",".join(map(_text, value))]
        if self.is_list:
            return [_text(item) for item in value]
        if self.is_mapping:
            return [f"{key}={_text(number)}" for key, number in value.items()]
        return [_text(value)]

    def words(self, value: Any) -> list[str]:
        """The option and its value as words of a command; none for the default."""
        if value == self.default or value is None:
            return []
        if self.type is bool:
            return [self.flag if value else self.negative_flag]
        if self.is_vector:  # joined, as it may begin with a minus
            return [f"{self.flag}={text}" for text in self.texts(value)]
        return [word for text in self.texts(value) for word in (self.flag, text)]

    def check(self, value: Any) -> None:
        """Refuse a value that is out of the declared bounds, or no declared choice.

        Raises:
            InputError: one sentence with the name, the bounds and the value.
        """
        if value is None:
            return
        for item in value if self.is_list else (value,):
            if self.choices and item not in self.choices:
                known = ", ".join(self.choices)
                raise InputError(f"{self.label} must be one of {known}, got {item!r}")
        low, high = self.declared.minimum, self.declared.maximum
        if low is not None and high is not None and not low <= value <= high:
            raise InputError(
                f"{self.label} must be between {low} and {high}, got {value}"
            )
        if low is not None and not low <= value:
            why = f": {self.declared.because}" if self.declared.because else ""
            raise InputError(f"{self.label} must be at least {low}, got {value}{why}")
        if self.declared.positive and not 0.0 < value < math.inf:
            raise InputError(f"{self.label} must be positive and finite, got {value}")


def option(default: Any, **declared: Any) -> Any:
    """A field that is an option: its default, and the fields of `Declaration`."""
    metadata = {_OPTION: Declaration(**declared)}
    if isinstance(default, Mapping):
        return dataclasses.field(
            default_factory=lambda: dict(default), metadata=metadata
        )
    return dataclasses.field(default=default, metadata=metadata)


def group(kind: Callable[[], Any], title: str | None = None) -> Any:
    """A field that holds further options.

    Args:
        kind: Their dataclass, or what makes its default.
        title: Of the group in the help; None: that of the group around it.
    """
    return dataclasses.field(default_factory=kind, metadata={_GROUP: title})


class Checked:
    """Base of a frozen dataclass of options: they have their declared types, and lie
    within their declared bounds."""

    def __post_init__(self) -> None:
        for item in _own_options(type(self)):
            (field,) = item.path
            value = item.value_of(getattr(self, field))
            item.check(value)
            object.__setattr__(self, field, value)


def options_of(kind: type) -> tuple[Option, ...]:
    """All options of a dataclass and of the groups in it, in their order.

    A default is that of an instance: a group may begin with another one than its
    dataclass declares.
    """
    return tuple(_walked(kind(), None))


def option_named(kind: type, name: str) -> Option:
    """One of `options_of`."""
    return next(item for item in options_of(kind) if item.name == name)


def unknown(name: str, known: Sequence[str]) -> str:
    """What to say of a name that no option has: the one that was meant, or all."""
    close = difflib.get_close_matches(name.lower().replace("-", "_"), known, n=1)
    if close:
        return f"did you mean {close[0]}?"
    return f"known are {', '.join(known)}"


def documented(kind: type[Kind]) -> type[Kind]:
    """Add all options of a dataclass to its docstring, for those who use Python."""
    lines = [kind.__doc__ or "", "", "Args:"]
    wrapper = textwrap.TextWrapper(
        88, initial_indent=4 * " ", subsequent_indent=8 * " "
    )
    for item in options_of(kind):
        text = f"{item.name} ({item.default!r}): {item.declared.help}"
        lines.append(wrapper.fill(text))
    kind.__doc__ = "\n".join(lines)
    return kind


def group_names(kind: type) -> tuple[str, ...]:
    """The fields of a dataclass that are groups of options."""
    fields = dataclasses.fields(kind)
    return tuple(field.name for field in fields if _GROUP in field.metadata)


def value_at(options: Any, path: tuple[str, ...]) -> Any:
    """The value of an option, by `Option.path`."""
    for name in path:
        options = getattr(options, name)
    return options


def replaced(options: Options, changes: Mapping[tuple[str, ...], Any]) -> Options:
    """Options with some values changed, by `Option.path`, all of a group at once."""
    own = {path[0]: value for path, value in changes.items() if len(path) == 1}
    below: dict[str, dict[tuple[str, ...], Any]] = {}
    for path, value in changes.items():
        if len(path) > 1:
            below.setdefault(path[0], {})[path[1:]] = value
    for name, inner in below.items():
        own[name] = replaced(own.get(name, getattr(options, name)), inner)
    return replace(options, **own)  # type: ignore[type-var]


def _walked(options: Any, panel: str | None) -> list[Option]:
    found = []
    own = {item.path[0]: item for item in _own_options(type(options))}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in own:
            found.append(replace(own[field.name], default=value, panel=panel))
        elif _GROUP in field.metadata:
            title = field.metadata[_GROUP] or panel
            found += [
                replace(item, path=(field.name, *item.path))
                for item in _walked(value, title)
            ]
    return found


def _own_options(kind: type) -> tuple[Option, ...]:
    """Those that a dataclass declares itself."""
    hints = get_type_hints(kind)
    return tuple(
        Option(
            name=field.metadata[_OPTION].name or field.name,
            path=(field.name,),
            type=_without_none(hints[field.name]),
            default=None,  # known of an instance only
            panel=None,
            declared=field.metadata[_OPTION],
        )
        for field in dataclasses.fields(kind)
        if _OPTION in field.metadata
    )


def _without_none(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
        (annotation,) = kinds
    return annotation


def _flag_of(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value).removesuffix(".0") if isinstance(value, float) else str(value)
