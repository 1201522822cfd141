"""One point per voxel: inverse-variance means that keep double precision.

A hash of voxels in numpy: points are sorted by voxel and summed, new ones are merged
with what is there. A voxel is about a pixel's footprint, and its points come from maps
that were fused before: it thins out, the noise was averaged along the lines of sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.cloud import Cloud
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

BYTES_PER_VOXEL = 250
"""While voxels are merged (measured)."""
_BITS = 21
_PENDING = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """Points (N,) of one depth map; as in `Cloud`."""

    points: Array
    normals: Array
    colors: NDArray[np.uint8]
    stddev: Array
    num_views: NDArray[np.int64]
    view_range: Array

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
        self._size, self._origin, self._max_bytes = size, origin, max_bytes
        self._pending: list[np.ndarray] = []
        self._rows = np.empty(0, dtype=_ROW)

    def add(self, fused: Fused) -> None:
        """Add points.

        Raises:
            InputError: the voxels need more memory than allowed.
        """
        if not len(fused):
            return
        local = fused.points - self._origin
        cell = np.floor(local / self._size).astype(np.int64) + (1 << (_BITS - 1))
        inside = np.all((cell >= 0) & (cell < 1 << _BITS), axis=1)
        if not inside.all():
            raise InputError(
                f"the cloud spans more than {1 << _BITS} voxels of {self._size:g}: "
                "choose a larger --voxel"
            )
        rows = np.zeros(len(fused), dtype=_ROW)
        rows["key"] = (cell[:, 0] << (2 * _BITS)) | (cell[:, 1] << _BITS) | cell[:, 2]
        weight = fused.stddev**-2.0
        rows["weight"] = weight
        rows["position"] = weight[:, None] * local
        rows["normal"] = np.nan_to_num(weight[:, None] * fused.normals)
        rows["stddev"] = weight * fused.stddev
        for name in ("colors", "num_views", "view_range"):
            rows[name] = getattr(fused, name)
        self._pending.append(_merged(rows))
        if sum(map(len, self._pending)) > _PENDING:
            self._flush()

    def _flush(self) -> None:
        rows = np.concatenate([self._rows, *self._pending])
        self._pending = []
        self._rows = _merged(rows)
        if len(self._rows) * BYTES_PER_VOXEL > self._max_bytes:
            raise InputError(
                f"{len(self._rows)} voxels of {self._size:g} do not fit the memory "
                f"left of --max-memory ({self._max_bytes / 1e9:.1f} GB): choose a "
                "larger --voxel"
            )

    def cloud(self) -> Cloud:
        """The mean point of each voxel."""
        self._flush()
        rows = self._rows
        weight = rows["weight"][:, None]
        normals = rows["normal"].astype(np.float64)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            normals = np.where(length > 0.0, normals / length, np.nan)
        return Cloud(
            points=rows["position"] / weight + self._origin,
            normals=normals,
            colors=rows["colors"],
            stddev=rows["stddev"] / rows["weight"],
            num_views=rows["num_views"].astype(np.int64),
            view_range=rows["view_range"].astype(np.float64),
        )


_ROW = np.dtype(
    [
        ("key", "<i8"),
        ("weight", "<f8"),
        ("position", "<f8", 3),
        ("normal", "<f8", 3),
        ("stddev", "<f8"),
        ("colors", "u1", 3),
        ("num_views", "<i4"),
        ("view_range", "<f4"),
    ]
)


def _merged(rows: np.ndarray) -> np.ndarray:
    """One row per key: sums, the most views, and the colour of the nearest view."""
    if not len(rows):
        return rows
    order = np.lexsort((rows["view_range"], rows["key"]))
    rows = rows[order]
    key = rows["key"]
    starts = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    merged = rows[starts]
    for name in ("weight", "position", "normal", "stddev"):
        merged[name] = np.add.reduceat(rows[name], starts, axis=0)
    merged["num_views"] = np.maximum.reduceat(rows["num_views"], starts)
    return merged
