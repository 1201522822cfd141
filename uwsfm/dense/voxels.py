"""One point per voxel: inverse-variance means that keep double precision.

A hash of voxels in numpy: points are sorted by voxel and summed, new ones are merged
with what is there, one part of the voxels at a time. A voxel is about a pixel's
footprint, and its points come from maps that were fused before: it thins out, the noise
was averaged along the lines of sight. Voxels that would not fit the memory become
larger ones: a cloud that is coarser than asked for is better than none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.cloud import Cloud
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

BYTES_PER_VOXEL = 207
"""Where all become a cloud and its file, about."""
COARSER = 2.0**0.5
"""Of a side, so that half of the voxels of a surface remain."""
_BITS = 21
_PARTS = 16
_PENDING = 500_000
"""Rows that wait: sorting them takes three times their memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """Points (N,) of one depth map; as in `Cloud`."""

    points: Array
    normals: Array
    colors: NDArray[np.uint8]
    stddev: Array
    num_views: NDArray[np.int64]
    view_range: Array
    plain: NDArray[np.bool_]
    color_weight: Array
    """(N,) how well the image shows the colour: less at an edge, where it is mixed with
    that of another surface, from aside and from afar."""

    def __len__(self) -> int:
        return len(self.points)


class Voxels:
    """Merges points into voxels.

    Args:
        size: of a voxel, metres.
        origin: (3,) about the middle of the scene.
        max_bytes: of the voxels.
    """

    def __init__(self, size: float, origin: Array, max_bytes: float) -> None:
        self.size = size
        """Of a side, metres: larger than asked for if that did not fit."""
        self._origin, self._max_bytes = origin, max_bytes
        self._pending: list[np.ndarray] = []
        self._parts = [np.empty(0, dtype=_ROW) for _ in range(_PARTS)]

    def add(self, fused: Fused) -> None:
        """Add points.

        Raises:
            InputError: they are too far apart for voxels of this size.
        """
        if not len(fused):
            return
        local = fused.points - self._origin
        rows = np.zeros(len(fused), dtype=_ROW)
        rows["key"] = self._keys(local)
        weight = fused.stddev**-2.0
        rows["weight"] = weight
        rows["position"] = weight[:, None] * local
        rows["normal"] = np.nan_to_num(weight[:, None] * fused.normals)
        rows["stddev"] = weight * fused.stddev
        for name in ("num_views", "view_range", "plain"):
            rows[name] = getattr(fused, name)
        rows["color_weight"] = fused.color_weight
        rows["color"] = fused.color_weight[:, None] * fused.colors
        self._pending.append(_merged(rows))
        if sum(map(len, self._pending)) > _PENDING:
            self._flush()

    def _keys(self, local: Array) -> NDArray[np.int64]:
        cell = np.floor(local / self.size).astype(np.int64) + (1 << (_BITS - 1))
        inside = np.all((cell >= 0) & (cell < 1 << _BITS), axis=1)
        if not inside.all():
            raise InputError(
                f"the cloud spans more than {1 << _BITS} voxels of {self.size:g}: "
                "choose a larger --voxel"
            )
        return (cell[:, 0] << (2 * _BITS)) | (cell[:, 1] << _BITS) | cell[:, 2]

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def _flush(self) -> None:
        pending, self._pending = self._pending, []
        if pending:
            self._merge(np.concatenate(pending))
        while len(self) * BYTES_PER_VOXEL > self._max_bytes and len(self) > _PARTS:
            self._coarsen()

    def _merge(self, rows: np.ndarray) -> None:
        part = rows["key"] % _PARTS
        for index in range(_PARTS):
            both = [self._parts[index], rows[part == index]]
            self._parts[index] = _merged(np.concatenate(both))

    def _coarsen(self) -> None:
        self.size *= COARSER
        parts, self._parts = self._parts, [np.empty(0, dtype=_ROW)] * _PARTS
        while parts:
            rows = parts.pop()
            rows["key"] = self._keys(rows["position"] / rows["weight"][:, None])
            self._merge(rows)

    def cloud(self) -> Cloud:
        """The mean point of each voxel; they are given up as it is made."""
        self._flush()
        count, first = len(self), 0
        cloud = _room_for(count)
        while self._parts:
            rows = self._parts.pop(0)
            to = slice(first, first + len(rows))
            first += len(rows)
            weight = rows["weight"][:, None]
            normals = rows["normal"].astype(np.float64)
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            with np.errstate(invalid="ignore", divide="ignore"):
                cloud.normals[to] = np.where(length > 0.0, normals / length, np.nan)
            cloud.points[to] = rows["position"] / weight + self._origin
            cloud.stddev[to] = rows["stddev"] / rows["weight"]
            for name in ("num_views", "view_range", "plain"):
                getattr(cloud, name)[to] = rows[name]
            mean = rows["color"] / rows["color_weight"][:, None]
            cloud.colors[to] = np.rint(mean).astype(np.uint8)
        return cloud


_ROW = np.dtype(
    [
        ("key", "<i8"),
        ("weight", "<f8"),
        ("position", "<f8", 3),
        ("normal", "<f4", 3),
        ("stddev", "<f8"),
        ("color", "<f4", 3),
        ("color_weight", "<f4"),
        ("num_views", "<i4"),
        ("view_range", "<f4"),
        ("plain", "?"),
    ]
)


def _room_for(count: int) -> Cloud:
    return Cloud(
        points=np.empty((count, 3)),
        normals=np.empty((count, 3)),
        colors=np.empty((count, 3), dtype=np.uint8),
        stddev=np.empty(count),
        num_views=np.empty(count, dtype=np.int64),
        view_range=np.empty(count),
        plain=np.empty(count, dtype=bool),
    )


def _merged(rows: np.ndarray) -> np.ndarray:
    """One row per key: sums, the most views, the nearest range, and whether it is plain
    in all of them."""
    if not len(rows):
        return rows
    order = np.lexsort((rows["view_range"], rows["key"]))
    rows = rows[order]
    key = rows["key"]
    starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    merged = rows[starts]
    for name in ("weight", "position", "normal", "stddev", "color", "color_weight"):
        merged[name] = np.add.reduceat(rows[name], starts, axis=0)
    merged["num_views"] = np.maximum.reduceat(rows["num_views"], starts)
    merged["plain"] = np.logical_and.reduceat(rows["plain"], starts)
    return merged
