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
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from uwsfm._yaml import read_yaml
from uwsfm.errors import InputError
from uwsfm.rig_problems import first_problem
from uwsfm.rig_schema import AccuracyEntry, Entry

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[_Number, Field(gt=0)]
_Arm = Annotated[tuple[_Number, ...], Field(strict=False, min_length=3, max_length=3)]
_Refined = Literal["water-index", "focal", "principal-point", "distortion"]

PATHS = ("masks", "positions", "lengths")


def _one_name(name: str) -> str:
    if not name or name in (".", "..") or set(name) & set("/\\"):
        raise ValueError("must be the name of a folder")
    return name


class PriorEntry(AccuracyEntry):
    distance_stddev_m: _Positive | None = None
    normal_stddev_deg: _Positive | None = None
    center_stddev_m: _Positive | None = None
    water_index_stddev: _Positive | None = None
    focal_stddev: _Positive | None = None
    principal_point_stddev_px: _Positive | None = None
    distortion_stddev: _Positive | None = None


class OptionsEntry(Entry):
    """As of `uwsfm reconstruct`; None: its default."""

    clahe: bool | None = None
    max_features: Annotated[int, Field(ge=100)] | None = None
    masks: str | None = None
    matching: Literal["auto", "exhaustive", "sequential"] | None = None
    matcher: Literal["colmap", "paper"] | None = None
    mapper: Literal["pinhole", "refractive"] | None = None
    positions: str | None = None
    lever_arm: _Arm | None = None
    lengths: str | None = None
    scene_distance_m: _Positive | None = None
    refine: Annotated[tuple[_Refined, ...], Field(strict=False)] | None = None
    prior: PriorEntry | None = None
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = None
    submap_frames: Annotated[int, Field(ge=10)] | None = None
    report: bool | None = None


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


ENTRIES: dict[str, type[Entry]] = {
    "": DivesFile,
    "options": OptionsEntry,
    "prior": PriorEntry,
    "dives": DiveEntry,
}


@dataclass(frozen=True, kw_only=True)
class Dive:
    """One dive, all paths absolute."""

    name: str
    rig: Path
    images: Path
    out: Path
    options: dict[str, Any]
    """Keyword arguments of `uwsfm.reconstruct`."""


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
    dives = [_dive(entry, found.options, folder) for entry in found.dives]
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
    for what in given.pop("refine", ()):
        given[f"refine_{what.replace('-', '_')}"] = True
    given.update(given.pop("prior", {}))
    for name in PATHS:
        if name in given:
            given[name] = folder / given[name]
    return Dive(
        name=entry.name,
        rig=folder / entry.rig,
        images=folder / entry.images,
        out=folder / (entry.name if entry.out is None else entry.out),
        options=given,
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
