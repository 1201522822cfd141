"""dives.yaml: the dives of `uwsfm batch`, and how each is to be reconstructed.

    version: 1
    options: {clahe: true}          # of all dives; may be left out
    dives:
      - name: wreck-bow
        rig: rig.yaml
        images: wreck/bow
        out: results/wreck-bow      # may be left out: wreck-bow
      - name: wreck-stern
        rig: rig.yaml
        images: wreck/stern
        options: {clahe: false, lengths: wreck/lengths.yaml, seed: 3}

Paths are relative to the folder of the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args

from pydantic import AfterValidator, Field, ValidationError, create_model

from uwsfm._base.options import Option, options_of
from uwsfm._base.yaml import read_yaml
from uwsfm.errors import InputError
from uwsfm.options.jobs import JobOptions, ReconstructOptions
from uwsfm.rig.problems import first_problem
from uwsfm.rig.schema import AccuracyEntry, Entry

_Number = Annotated[float, Field(allow_inf_nan=False)]


def options_entry(kind: type[JobOptions]) -> type[Entry]:
    """The keys of a block of options, and what their values may be."""
    keys: dict[str, Any] = {
        item.name: (_annotation(item) | None, None)
        for item in options_of(kind)
        if item.declared.per_dive
    }
    return create_model("OptionsEntry", __base__=Entry, **keys)


def _annotation(item: Option) -> Any:
    """What pydantic takes for an option; its lists are YAML's, and not tuples."""
    declared = item.declared
    if item.is_mapping:
        keys: dict[str, Any] = {
            key: (Annotated[_Number, Field(gt=0)] | None, None) for key in declared.keys
        }
        return create_model(item.name, __base__=AccuracyEntry, **keys)
    if item.is_list:
        return Annotated[item.type, Field(strict=False)]
    if item.is_vector:
        three = Field(strict=False, min_length=3, max_length=3)
        return Annotated[tuple[_Number, ...], three]
    if item.type is Path:
        return str
    if item.type not in (int, float):
        return item.type
    low = 0 if declared.positive else None
    bounds = Field(gt=low, ge=declared.minimum, le=declared.maximum)
    return Annotated[_Number if item.type is float else int, bounds]


if TYPE_CHECKING:
    OptionsEntry: TypeAlias = Entry
else:
    OptionsEntry = options_entry(ReconstructOptions)


def _one_name(name: str) -> str:
    if not name or name in (".", "..") or set(name) & set("/\\"):
        raise ValueError("must be the name of a folder")
    return name


class DiveEntry(Entry):
    name: Annotated[str, AfterValidator(_one_name)]
    rig: str
    images: str
    out: str | None = None
    options: OptionsEntry = OptionsEntry()


class DivesFile(Entry):
    version: Literal[1]
    options: OptionsEntry = OptionsEntry()
    dives: Annotated[tuple[DiveEntry, ...], Field(strict=False)]


def _blocks(entry: type[Entry]) -> dict[str, type[Entry]]:
    """The blocks of keys within a block of keys, by their key."""
    fields = entry.model_fields.items()
    inner = {name: get_args(field.annotation)[0] for name, field in fields}
    return {
        name: kind
        for name, kind in inner.items()
        if isinstance(kind, type) and issubclass(kind, Entry)
    }


ENTRIES: dict[str, type[Entry]] = {
    "": DivesFile,
    "options": OptionsEntry,
    "dives": DiveEntry,
    **_blocks(OptionsEntry),
}


@dataclass(frozen=True, kw_only=True)
class Dive:
    """One dive, all paths absolute."""

    name: str
    rig: Path
    images: Path
    out: Path
    options: ReconstructOptions


def load_dives(path: str | Path) -> list[Dive]:
    """Read and check a dives.yaml; whether the files that it names exist is not.

    Raises:
        InputError: one sentence with the file, the key path and what is wrong.
    """
    path = Path(path)
    try:
        found = DivesFile.model_validate(read_yaml(path))
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, ENTRIES)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not found.dives:
        raise InputError(f"{path}: dives: there is none in the list")
    folder = path.absolute().parent
    dives = []
    for index, entry in enumerate(found.dives):
        try:
            dives.append(_dive(entry, found.options, folder))
        except InputError as error:  # options that exclude each other
            where = f"dives[{index}].options"
            raise InputError(f"{path}: {where}: {error}") from None
    _once(path, "name", dives, lambda dive: dive.name)
    # Two spellings of one folder are one folder.
    _once(path, "out", dives, lambda dive: os.path.realpath(dive.out))
    _apart(path, dives)
    return dives


def _dive(entry: DiveEntry, common: OptionsEntry, folder: Path) -> Dive:
    given = {
        **common.model_dump(exclude_none=True),
        **entry.options.model_dump(exclude_none=True),
    }
    for item in options_of(ReconstructOptions):
        if item.type is Path and item.name in given:
            given[item.name] = folder / given[item.name]
    return Dive(
        name=entry.name,
        rig=folder / entry.rig,
        images=folder / entry.images,
        out=folder / (entry.name if entry.out is None else entry.out),
        options=ReconstructOptions.of(**given),
    )


def _once(path: Path, key: str, dives: list[Dive], of: Callable[[Dive], str]) -> None:
    first: dict[str, int] = {}
    for index, dive in enumerate(dives):
        if of(dive) in first:
            raise InputError(
                f"{path}: dives[{index}].{key}: is that of dives[{first[of(dive)]}]"
            )
        first[of(dive)] = index


def _apart(path: Path, dives: list[Dive]) -> None:
    """No dive writes into what another replaces."""
    owner = {Path(os.path.realpath(dive.out)): dive.name for dive in dives}
    for index, dive in enumerate(dives):
        for folder in Path(os.path.realpath(dive.out)).parents:
            if folder in owner:
                raise InputError(
                    f"{path}: dives[{index}].out: the folder of {dive.name!r} is "
                    f"inside that of {owner[folder]!r}"
                )
