"""Lengths and positions from outside as files: lengths.yaml and positions.csv.

`lengths.yaml` holds scale bars, whose ends were marked in two or more images each (the
centre of the first pixel is (0.5, 0.5)), and known distances between two frames:

    version: 1
    scale_bars:
      - length_m: 0.5
        stddev_m: 0.0005
        click_stddev_px: 1.0        # may be left out
        ends:
          - [{image: left/01.png, xy: [412.5, 300.0]}, {image: left/02.png, xy: ...}]
          - [{image: left/01.png, xy: [702.0, 310.5]}, {image: right/01.png, xy: ...}]
    frame_distances:
      - {frames: [01.png, 14.png], length_m: 2.31, stddev_m: 0.01}

A CSV of positions has the header `frame,x,y,z,sx,sy,sz`: file name of the frame,
position of the antenna and its standard deviations, in metres, in a right-handed local
frame (east-north-up, north-east-down, ...). Where only a depth sensor was aboard, the
header is `frame,depth,sdepth`: metres below the surface, positive downwards. The result
is level then, its z upwards; its heading and its place in the horizontal stay open.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from uwsfm._base.files import read_text
from uwsfm._base.yaml import read_yaml
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.problems import first_problem
from uwsfm.rig.schema import Entry

HEADER = ["frame", "x", "y", "z", "sx", "sy", "sz"]
DEPTH_HEADER = ["frame", "depth", "sdepth"]

# Single precision, as in PLY files, is a millimetre there.
LARGEST_M = 1e4
LARGEST_STDDEV_M = 1e6
"""Of a position that is not known at all."""
UNKNOWN_STDDEV_M = 1e3
"""Of the place in the horizontal where only depths are given: it keeps the model from
drifting away, and weighs nothing beside what the images know."""
MAX_BYTES = 50_000_000
"""Half a million positions."""
# A dive is longer; in degrees this is two kilometres.
SHORTEST_M = 0.02

LARGEST_LENGTH_M = 1e6
_Length = Annotated[float, Field(gt=0, le=LARGEST_LENGTH_M)]
_TWO = Field(strict=False, min_length=2, max_length=2)
_Pixel = Annotated[float, Field(allow_inf_nan=False)]


class Click(Entry):
    image: str
    xy: Annotated[tuple[_Pixel, _Pixel], Field(strict=False)]


_Clicks = Annotated[tuple[Click, ...], Field(strict=False, min_length=2)]


class ScaleBar(Entry):
    length_m: _Length
    stddev_m: _Length
    click_stddev_px: _Length = 1.0
    ends: Annotated[tuple[_Clicks, ...], _TWO]


class FrameDistance(Entry):
    length_m: _Length
    stddev_m: _Length
    frames: Annotated[tuple[str, ...], _TWO]


class LengthsFile(Entry):
    version: Literal[1]
    scale_bars: Annotated[tuple[ScaleBar, ...], Field(strict=False)] = ()
    frame_distances: Annotated[tuple[FrameDistance, ...], Field(strict=False)] = ()


ENTRIES: dict[str, type[Entry]] = {
    "": LengthsFile,
    "scale_bars": ScaleBar,
    "ends": Click,
    "frame_distances": FrameDistance,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PositionTable:
    """Positions as a file has them."""

    source: str
    frames: tuple[str, ...]
    positions: Array
    """(M, 3)"""
    stddevs: Array
    """(M, 3)"""
    depths_only: bool = False
    """Then x and y are zero, and nothing is known of them."""


def load_lengths(path: str | Path) -> LengthsFile:
    """Read and check a lengths.yaml.

    Raises:
        InputError: one sentence with the file, the key path and what is wrong.
    """
    try:
        found = LengthsFile.model_validate(read_yaml(Path(path)))
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error, ENTRIES)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not (found.scale_bars or found.frame_distances):
        raise InputError(f"{path}: neither scale_bars nor frame_distances are in it")
    for i, distance in enumerate(found.frame_distances):
        if distance.frames[0] == distance.frames[1]:
            raise InputError(
                f"{path}: frame_distances[{i}].frames: one and the same frame"
            )
    return found


def load_positions(path: str | Path) -> PositionTable:
    """Read and check a CSV of positions.

    Raises:
        InputError: one sentence with the file, the line and what is wrong.
    """
    path = Path(path)
    try:
        text = read_text(path, MAX_BYTES)
        rows = [row for row in csv.reader(io.StringIO(text)) if "".join(row).strip()]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except csv.Error:
        raise InputError(f"{path}: is not a table of text in UTF-8") from None
    header = _header(path, [cell.strip().lower() for cell in rows[0]] if rows else [])
    frames: dict[str, None] = {}
    numbers = []
    for i, row in enumerate(rows[1:], 2):
        name, values = _row(f"{path}: row {i}", row, header)
        if name in frames:
            raise InputError(f"{path}: row {i}: frame {name!r} is given twice")
        frames[name] = None
        numbers.append(values)
    if len(frames) < 3:
        raise InputError(
            f"{path}: {len(frames)} positions are too few: at least 3 are needed"
        )
    table = np.array(numbers)
    depths_only = header == DEPTH_HEADER
    if depths_only:
        table = _upwards(table)
    _check_units(path, table[:, :3])
    return PositionTable(
        source=str(path),
        frames=tuple(frames),
        positions=table[:, :3],
        stddevs=table[:, 3:],
        depths_only=depths_only,
    )


def _upwards(depths: Array) -> Array:
    """Rows x, y, z, sx, sy, sz of depths and their standard deviations (M, 2)."""
    rows = np.zeros((len(depths), 6))
    rows[:, 2], rows[:, 5] = -depths[:, 0], depths[:, 1]
    rows[:, 3:5] = UNKNOWN_STDDEV_M
    return rows


def _header(path: Path, header: list[str]) -> list[str]:
    if header in (HEADER, DEPTH_HEADER):
        return header
    expected = ",".join(HEADER)
    geographic = [name for name in header if name.startswith(("lat", "lon", "lng"))]
    if geographic:
        raise InputError(
            f"{path}: the column {geographic[0]!r} is in degrees: convert to metres in "
            f"a local frame, with the header {expected}"
        )
    found = ",".join(header)
    raise InputError(
        f"{path}: the header must be {expected}, or {','.join(DEPTH_HEADER)} where "
        f"only depths are known; got {found!r}"
    )


def _row(where: str, row: list[str], header: list[str]) -> tuple[str, list[float]]:
    if len(row) != len(header):
        raise InputError(f"{where}: {len(row)} columns instead of {len(header)}")
    values = []
    for name, cell in zip(header[1:], row[1:], strict=True):
        try:
            value = float(cell)
        except ValueError:
            raise InputError(f"{where}: {name}: {cell!r} is not a number") from None
        if not math.isfinite(value):
            raise InputError(f"{where}: {name}: {cell.strip()} is not finite")
        if name.startswith("s") and not 0.0 < value <= LARGEST_STDDEV_M:
            raise InputError(
                f"{where}: {name}: {value:g} m must be positive, and at most "
                f"{LARGEST_STDDEV_M:g} m"
            )
        values.append(value)
    return row[0].strip(), values


def _check_units(path: Path, positions: Array) -> None:
    span = np.ptp(positions[:, :2], axis=0)
    x, y = np.mean(positions[:, :2], axis=0)
    # A dive straight down may stay at zero; a longitude may be near it, not both.
    if span.max() < SHORTEST_M and 1.0 < max(abs(x), abs(y)) <= 360.0:
        raise InputError(
            f"{path}: x and y change by {1e3 * span.max():.3g} mm only over "
            f"{len(positions)} positions: if {x:.4f} and {y:.4f} are degrees of "
            "longitude and latitude, convert them to metres in a local frame"
        )
    if np.ptp(positions, axis=0).max() < SHORTEST_M:
        raise InputError(
            f"{path}: the positions lie within {1e3 * SHORTEST_M:.0f} mm of each "
            "other: are they in metres?"
        )
    largest = float(np.abs(positions).max())
    if largest > LARGEST_M:
        raise InputError(
            f"{path}: coordinates up to {largest:.7g} m are not of a local frame: "
            "subtract a constant, for files in single precision would round them"
        )
