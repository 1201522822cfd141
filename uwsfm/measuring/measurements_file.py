"""measurements.yaml: what is to be measured.

    version: 1
    click_stddev_px: 1.0              # of every click; may be left out, or per entry
    distances:
      - {name: width, ends: [1234, 5678]}
    polylines:
      - {name: branch, through: [PICK, PICK, PICK]}
    areas:
      - {name: plate, corners: [PICK, PICK, PICK, PICK]}
    heights:                          # above the plane through three or more places
      - {name: colony, of: PICK, above: [PICK, PICK, PICK]}
    angles:
      - {name: fork, at: PICK, between: [PICK, PICK]}
    scale_bars:                       # of known length: a check, as in lengths.yaml
      - {name: bar, length_m: 0.5, stddev_m: 0.0005, ends: [PICK, PICK]}

A PICK is what `uwsfm.measuring.picks` reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PlainValidator, ValidationError

from uwsfm._base.yaml import read_yaml
from uwsfm.errors import InputError
from uwsfm.measuring.picks import Pick, parsed_pick
from uwsfm.rig.problems import first_problem
from uwsfm.rig.schema import Entry

CLICK_STDDEV_PX = 1.0

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Deviation = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Pick = Annotated[Pick, PlainValidator(parsed_pick)]
_Two = Annotated[tuple[_Pick, ...], Field(strict=False, min_length=2, max_length=2)]
_Three = Annotated[tuple[_Pick, ...], Field(strict=False, min_length=3)]
_Line = Annotated[tuple[_Pick, ...], Field(strict=False, min_length=2)]


class _Item(Entry):
    name: str | None = None
    click_stddev_px: _Positive | None = None


class DistanceItem(_Item):
    ends: _Two


class PolylineItem(_Item):
    through: _Line


class AreaItem(_Item):
    corners: _Three


class HeightItem(_Item):
    of: _Pick
    above: _Three


class AngleItem(_Item):
    at: _Pick
    between: _Two


class ScaleBarItem(_Item):
    length_m: _Positive
    stddev_m: _Deviation = 0.0
    ends: _Two


class MeasurementsFile(Entry):
    version: Literal[1]
    click_stddev_px: _Positive = CLICK_STDDEV_PX
    distances: Annotated[tuple[DistanceItem, ...], Field(strict=False)] = ()
    polylines: Annotated[tuple[PolylineItem, ...], Field(strict=False)] = ()
    areas: Annotated[tuple[AreaItem, ...], Field(strict=False)] = ()
    heights: Annotated[tuple[HeightItem, ...], Field(strict=False)] = ()
    angles: Annotated[tuple[AngleItem, ...], Field(strict=False)] = ()
    scale_bars: Annotated[tuple[ScaleBarItem, ...], Field(strict=False)] = ()


ENTRIES: dict[str, type[Entry]] = {
    "": MeasurementsFile,
    "distances": DistanceItem,
    "polylines": PolylineItem,
    "areas": AreaItem,
    "heights": HeightItem,
    "angles": AngleItem,
    "scale_bars": ScaleBarItem,
}

Kind = Literal["distance", "polyline", "area", "height", "angle", "scale bar"]
_LISTS: dict[str, tuple[Kind, tuple[str, ...]]] = {
    "distances": ("distance", ("ends",)),
    "polylines": ("polyline", ("through",)),
    "areas": ("area", ("corners",)),
    "heights": ("height", ("of", "above")),
    "angles": ("angle", ("at", "between")),
    "scale_bars": ("scale bar", ("ends",)),
}


@dataclass(frozen=True)
class Task:
    """One thing to measure."""

    kind: Kind
    name: str
    where: str
    """Of the file and the key, for messages."""
    picks: tuple[Pick, ...]
    """In the order that `uwsfm.measuring.quantities` takes them."""
    keys: tuple[str, ...]
    """Of each pick."""
    click_stddev_px: float
    length_m: float | None = None
    stddev_m: float = 0.0


def load_measurements(source: str | Path | Mapping[str, Any]) -> list[Task]:
    """Read and check a measurements.yaml, or its content.

    Raises:
        InputError: one sentence with the file, the key path and what is wrong.
    """
    prefix = "" if isinstance(source, Mapping) else f"{source}: "
    try:
        data = source if isinstance(source, Mapping) else read_yaml(Path(source))
        file = MeasurementsFile.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{prefix}{first_problem(error, ENTRIES)}") from None
    except InputError as error:
        raise InputError(f"{prefix}{error}") from None
    tasks = list(_tasks(file, prefix))
    if not tasks:
        raise InputError(f"{prefix}there is nothing to measure: {', '.join(_LISTS)}")
    return tasks


def _tasks(file: MeasurementsFile, prefix: str) -> Iterator[Task]:
    for key, (kind, parts) in _LISTS.items():
        for i, item in enumerate(getattr(file, key)):
            picks: list[Pick] = []
            keys: list[str] = []
            for part in parts:
                value = getattr(item, part)
                several = isinstance(value, tuple)
                found = value if several else (value,)
                picks += found
                keys += [f"{part}[{j}]" if several else part for j in range(len(found))]
            yield Task(
                kind=kind,
                name=item.name or f"{kind} {i + 1}",
                where=f"{prefix}{key}[{i}]",
                picks=tuple(picks),
                keys=tuple(keys),
                click_stddev_px=item.click_stddev_px or file.click_stddev_px,
                length_m=getattr(item, "length_m", None),
                stddev_m=getattr(item, "stddev_m", 0.0),
            )
