"""Depth of every pixel of an image, along its exact water ray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import replaced_file
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

# OpenCV's functions return arrays of any type, as far as type checkers know.
Plane = NDArray[Any]
"""(h, w) float32"""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthMap:
    """What one image's pixels (H, W) see; NaN where nothing was matched."""

    ranges: Plane
    """From the outer surface of the port along the water ray, metres."""
    sensitivity: Plane
    """Change of the range per pixel of disparity, metres."""
    spread: Plane | None = None
    """Standard deviation of the disparity, of that of ordinary texture: plain areas are
    known less well. None: all alike."""
    normals: NDArray[Any] | None = None
    """(H, W, 3) of the surface, in the camera, towards it; None: not known."""
    plain: NDArray[np.bool_] | None = None
    """(H, W) where the image itself shows no depth, so that it is that of planes
    through what is sure around it. None: nowhere."""

    @property
    def num_valid(self) -> int:
        return int(np.count_nonzero(np.isfinite(self.ranges)))


def pixel_rows(camera: RefractiveCamera, first: int, last: int, step: int = 1) -> Array:
    """Centres (N, 2) of the pixels in rows first to last - 1, every step-th."""
    x = np.arange(0, camera.width, step) + 0.5
    y = np.arange(first, last, step) + 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def write_depth_map(depth: DepthMap, path: Path, key: str) -> None:
    """Write a depth map with a key that tells what it was made of."""
    planes = {name: getattr(depth, name) for name in DepthMap.__dataclass_fields__}
    known = {name: plane for name, plane in planes.items() if plane is not None}
    write_planes(path, key, known)


def read_depth_map(path: Path, key: str) -> DepthMap | None:
    """Read a depth map; None if it is not there or of another key."""
    planes = read_planes(path, key)
    try:
        return None if planes is None else DepthMap(**planes)
    except TypeError:  # of another version
        return None


def write_planes(path: Path, key: str, planes: dict[str, NDArray[Any]]) -> None:
    """Write arrays by name, with a key that tells what they were made of."""
    with replaced_file(path) as partial, partial.open("wb") as file:
        arrays: dict[str, Any] = {"key": np.array(key), **planes}
        np.savez(file, **arrays)


def read_planes(path: Path, key: str) -> dict[str, NDArray[Any]] | None:
    """Read arrays; None if they are not there or of another key.

    A file that was cut short counts as absent: it is made again.
    """
    try:
        with np.load(path) as content:
            if str(content["key"]) != key:
                return None
            return {name: content[name] for name in content.files if name != "key"}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
