"""The options of commands: those of the jobs, as they are declared, and shared ones."""

import enum
import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from uwsfm._base.options import Option, option_named, options_of
from uwsfm.errors import InputError
from uwsfm.options.jobs import JobOptions, ReconstructOptions
from uwsfm.sfm.options import Mapper

OUT = "out"
"""The parameter of `ResultsOption`, which a file of options may hold, too."""
NOT_GIVEN: tuple[Any, ...] = (None, (), {})
"""Defaults that say nothing: the help of the option does."""


def takes(
    kind: type[JobOptions],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a command take all options of a job, and --config.

    Args:
        kind: Options of the job. The decorated function gets them as ``options``.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        declared = options_of(kind)
        own = inspect.signature(command, eval_str=True).parameters.values()
        parameters = [p for p in own if p.name != "options"]
        parameters += [_parameter(item) for item in declared]
        parameters.append(_config(declared))

        @functools.wraps(command)
        def run(**given: Any) -> None:
            del given["config"]  # its callback has read it
            settings = {i.name: _read(i, given.pop(i.name)) for i in declared}
            command(**given, options=kind.of(**settings))

        by_name = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
        run.__signature__ = inspect.Signature(by_name)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        return run

    return decorated


def as_typed(item: Option) -> Any:
    """A declared option as typer's; its type and its default are the caller's."""
    flag = item.flag
    return typer.Option(
        f"{flag}/{item.negative_flag}" if item.type is bool else flag,
        metavar=item.metavar,
        min=item.declared.minimum,
        max=item.declared.maximum,
        help=item.declared.help,
        show_default=item.default not in NOT_GIVEN,
        rich_help_panel=item.panel,
    )


def _parameter(item: Option) -> inspect.Parameter:
    """A parameter of a command's function, from which typer makes an option."""
    kind: Any = item.type
    if item.is_list:
        words = {word: word for word in item.choices}
        kind = list[enum.Enum(item.name, words, type=str)]  # type: ignore[misc]
    elif item.is_mapping:
        kind = list[str]
    elif item.is_vector:
        kind = str
    default = item.default
    if default in NOT_GIVEN:
        kind, default = kind | None, None
    return inspect.Parameter(
        item.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, as_typed(item)],
    )


def _read(item: Option, value: Any) -> Any:
    """What typer took for an option, as its declared type."""
    if value is None:
        return None
    if item.is_list:
        return tuple(word.value for word in value)
    if item.is_mapping:
        return numbers_of(item, value)
    return vector_of(item, value) if item.is_vector else value


def vector_of(item: Option, text: str) -> tuple[float, ...]:
    """X,Y,Z as numbers.

    Raises:
        InputError: they are not three.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise InputError(f"{item.flag} {text}: write three numbers X,Y,Z in metres")
    return values


def numbers_of(item: Option, texts: Iterable[str]) -> dict[str, float]:
    """KEY=VALUE, given some times, as numbers by key.

    Raises:
        InputError: a key is unknown or given twice, or a value is no number or no
            plausible one.
    """
    from uwsfm.rig.values import checked_accuracy

    numbers: dict[str, float] = {}
    for text in texts:
        typed, known = f"{item.flag} {text}", item.declared.keys
        key, _, value = text.partition("=")
        if key not in known:
            raise InputError(f"{typed}: the key is one of {', '.join(known)}")
        if key in numbers:
            raise InputError(f"{typed}: {key} is given twice")
        try:
            numbers[key] = float(value)
        except ValueError:
            raise InputError(
                f"{typed}: {value!r} is not a number; write KEY=VALUE"
            ) from None
        try:
            checked_accuracy(key, numbers[key])
        except InputError as error:
            raise InputError(f"{typed}: {error}") from None
    return numbers


def _config(declared: Sequence[Option]) -> inspect.Parameter:
    """--config, whose callback puts the file's options in the place of the defaults."""

    def read(context: typer.Context, path: Path | None) -> Path | None:
        if path is not None and not context.resilient_parsing:
            context.default_map = _from_file(context, path, declared)
        return path

    typed = typer.Option(
        "--config",
        metavar="FILE.yaml",
        is_eager=True,
        callback=read,
        help="YAML file of options by name, as the options.yaml of a result. What is "
        "typed besides wins. Paths are relative to the working folder. Default: no "
        "file.",
        show_default=False,
    )
    return inspect.Parameter(
        "config",
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[Path | None, typed],
    )


def _from_file(
    context: typer.Context, path: Path, declared: Sequence[Option]
) -> dict[str, Any]:
    """The options of a file as if they were typed, each checked as if it were.

    Raises:
        InputError: one sentence with the file, the key and what is wrong.
    """
    from uwsfm.options.file import read_typed

    known = {item.name: item for item in declared}
    found = read_typed(path, declared, extra=(OUT,))
    for parameter in context.command.params:
        if parameter.name not in found:
            continue
        item, text = known.get(parameter.name), found[parameter.name]
        try:
            value = parameter.process_value(context, text)
            if item is not None:
                item.check(_read(item, value))
        except typer.BadParameter as error:
            raise InputError(f"{path}: {parameter.name}: {error.message}") from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return found


_SEED, _THREADS, _SCHEDULER, _MAPPER = (
    as_typed(option_named(ReconstructOptions, name))
    for name in ("seed", "num_threads", "scheduler", "mapper")
)
RigArgument = Annotated[Path, typer.Argument(help="The rig file, see uwsfm init.")]
ImagesOption = Annotated[
    Path | None,
    typer.Option(
        help="Folder where the images are now. Default: where they were.",
        show_default=False,
    ),
]
ResultsOption = Annotated[
    Path, typer.Option("--out", "-o", help="Folder that receives the results.")
]
SeedOption = Annotated[int, _SEED]
ThreadsOption = Annotated[int, _THREADS]
SchedulerOption = Annotated[str, _SCHEDULER]
MapperOption = Annotated[Mapper, _MAPPER]
