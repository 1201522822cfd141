"""`Cloud`: dense points with what is known of each, and its file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm._base.ply import read_vertices, write_ply
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

_COLUMNS = (
    *((name, "<f8") for name in ("x", "y", "z")),
    *((name, "<f4") for name in ("nx", "ny", "nz")),
    *((name, "u1") for name in ("red", "green", "blue")),
    ("stddev", "<f4"),
    ("num_views", "<i4"),
    ("view_range", "<f4"),
    ("plain", "u1"),
)
STDDEV_NAMES = ("stddev", "depth_stddev_m")
"""Properties that hold standard deviations along the line of sight: of dense clouds,
and of the points of an adjustment."""
VIEWS_NAMES = ("num_views", "track_length")
"""Properties that hold how many views agree on a point, likewise."""
_UNIT = "unit: "
UNKNOWN_UNIT = "unknown unit"
"""Of lengths that nobody tells the unit of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """N points on surfaces, in the world frame of a reconstruction, metres.

    Raises:
        InputError: arrays of different lengths.
    """

    points: Array
    """(N, 3)"""
    normals: Array
    """(N, 3) unit, towards the cameras that saw the point; NaN if undetermined."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB"""
    stddev: Array
    """(N,) along the line of sight, metres; NaN if undetermined."""
    num_views: NDArray[np.int64]
    """(N,) depth maps that agree on the point; of an adjustment, images that see it."""
    view_range: Array
    """(N,) distance from the camera that gives the colour, through the water, or the
    mean over the images of a point of an adjustment; NaN if unknown."""
    plain: NDArray[np.bool_] | None = None
    """(N,) where no image shows a depth by its texture, so that it is that of planes
    through what is sure around the point. None, when made: nowhere."""

    def __post_init__(self) -> None:
        if self.plain is None:
            nowhere = np.zeros(len(self.points), dtype=bool)
            object.__setattr__(self, "plain", nowhere)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("points", "normals", "colors"), (3,)
        )
        shapes |= dict.fromkeys(("stddev", "num_views", "view_range", "plain"), ())
        for name, tail in shapes.items():
            shape, expected = getattr(self, name).shape, (len(self.points), *tail)
            if shape != expected:
                raise InputError(f"cloud {name} has shape {shape}, expected {expected}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: ArrayLike) -> Cloud:
        """The points of a mask (N,) or of indices."""
        rows = np.asarray(keep)
        return Cloud(**{name: value[rows] for name, value in vars(self).items()})


def write_cloud(cloud: Cloud, path: str | Path, unit: str = "metre") -> None:
    """Write a binary PLY.

    Properties: x y z (double, world), nx ny nz (float), red green blue (uchar), stddev
    (float), num_views (int), view_range (float), plain (uchar, 0 or 1).

    Args:
        cloud: what to write.
        path: the file.
        unit: of all lengths, for the comment in the file.
    """
    table = np.empty(len(cloud), dtype=list(_COLUMNS))
    columns = [*cloud.points.T, *cloud.normals.T, *cloud.colors.T]
    columns += [cloud.stddev, cloud.num_views, cloud.view_range, cloud.plain]
    for (name, _), values in zip(_COLUMNS, columns, strict=True):
        table[name] = values
    write_ply(Path(path), [("vertex", table)], comment=f"{_UNIT}{unit}; uwsfm dense")


def read_cloud(path: str | Path) -> Cloud:
    """Read a file of `write_cloud`, points of an adjustment, or any other PLY.

    What the file does not hold is NaN; colours are then grey, views one.

    Raises:
        InputError: the file is not there, no such PLY, or without x, y and z.
    """
    return cloud_of_table(read_table(path))


def read_table(path: str | Path) -> np.ndarray:
    """All columns of the vertices of a cloud's file, a structured array (N,).

    Raises:
        InputError: as `read_cloud`.
    """
    table, _ = read_vertices(Path(path))
    if not {"x", "y", "z"} <= set(table.dtype.names or ()):
        raise InputError(f"{path}: its vertices have no x, y and z")
    return table


def cloud_of_table(table: np.ndarray) -> Cloud:
    """The cloud of what `read_table` returns."""

    def columns(wanted: tuple[str, ...], default: float) -> np.ndarray:
        if not set(wanted) <= set(table.dtype.names or ()):
            return np.full((len(table), len(wanted)), default)
        return np.stack([table[name] for name in wanted], axis=1)

    def column(names: tuple[str, ...], default: float) -> np.ndarray:
        found = column_of(table, names)
        return np.full(len(table), default) if found is None else found

    return Cloud(
        points=columns(("x", "y", "z"), np.nan).astype(np.float64),
        normals=columns(("nx", "ny", "nz"), np.nan).astype(np.float64),
        colors=columns(("red", "green", "blue"), 128).astype(np.uint8),
        stddev=column(STDDEV_NAMES, np.nan).astype(np.float64),
        num_views=column(VIEWS_NAMES, 1).astype(np.int64),
        view_range=column(("view_range",), np.nan).astype(np.float64),
        plain=column(("plain",), 0) > 0,
    )


def column_of(table: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    """The first of these columns (N,) that a table has; None if it has none."""
    found = next((name for name in names if name in (table.dtype.names or ())), None)
    return None if found is None else table[found]


def unit_of_cloud(path: str | Path) -> str:
    """What the lengths of a cloud file are in, by its comment; `UNKNOWN_UNIT` without.

    Raises:
        InputError: the file is not there, or no such PLY.
    """
    _, comments = read_vertices(Path(path))
    for comment in comments:
        if comment.startswith(_UNIT):
            return comment[len(_UNIT) :].split(";")[0]
    return UNKNOWN_UNIT
