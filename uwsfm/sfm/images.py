"""Which images belong together, and whether they can be read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uwsfm._paths import check_image_names
from uwsfm.errors import InputError
from uwsfm.rig import Rig

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"})
MIN_FRAMES = 2


@dataclass(frozen=True, kw_only=True)
class Frames:
    """The frames of a dive: file names that every camera's folder holds."""

    image_dir: Path
    folders: tuple[str, ...]
    """Sub-folder of each camera (C), in the order of the rig."""
    names: tuple[str, ...]
    """File name of each frame (F), in natural order: frame2 before frame10."""
    unmatched: tuple[str, ...]
    """Images left out, "folder/name": another camera has no image of that name."""

    def image_name(self, camera_idx: int, frame_idx: int) -> str:
        """An image as the COLMAP database knows it: "folder/name"."""
        return f"{self.folders[camera_idx]}/{self.names[frame_idx]}"

    def image_names(self) -> Iterator[str]:
        """All images, frame by frame."""
        for f in range(len(self.names)):
            for c in range(len(self.folders)):
                yield self.image_name(c, f)

    def warnings(self) -> list[str]:
        """What the user should know, one sentence each."""
        if not self.unmatched:
            return []
        reason = "the other cameras have no image of that name"
        if len(self.unmatched) == 1:
            return [f"image {self.unmatched[0]} was left out: {reason}"]
        return [
            f"{len(self.unmatched)} images were left out, for instance "
            f"{self.unmatched[0]}: {reason}"
        ]

    def fingerprint(self) -> list[Any]:
        """Names, sizes and times of the images, whichever camera comes first."""
        stats = {n: (self.image_dir / n).stat() for n in sorted(self.image_names())}
        return [[n, stat.st_size, stat.st_mtime_ns] for n, stat in stats.items()]


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts "frame10" after "frame2"; the name itself breaks ties."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts], name


def find_frames(image_dir: Path, rig: Rig, min_num_frames: int = MIN_FRAMES) -> Frames:
    """Pair the images of the rig's folders by equal file name.

    Raises:
        InputError: a folder that is missing or holds no image, no common name, fewer
            frames than ``min_num_frames``, a file name that contains white space, or a
            file that is empty.
    """
    image_dir = Path(image_dir)
    if not image_dir.is_dir():
        what = "is not a folder" if image_dir.exists() else "does not exist"
        raise InputError(f"image directory {image_dir} {what}")
    found = {c.images: _images_of(image_dir, c.images, c.name) for c in rig.cameras}
    common = set.intersection(*found.values())
    if not common:
        first, second = list(found)[:2]
        raise InputError(
            f"no image name is common to the folders of {image_dir}: "
            f"{first} has {min(found[first])}, {second} has {min(found[second])}; "
            "images of one frame must have equal names"
        )
    if len(common) < min_num_frames:
        raise InputError(
            f"only one frame ({common.pop()}) has an image of every camera in "
            f"{image_dir}; a reconstruction needs at least {min_num_frames}"
        )
    frames = Frames(
        image_dir=image_dir,
        folders=tuple(found),
        names=tuple(sorted(common, key=natural_key)),
        unmatched=tuple(
            f"{folder}/{name}"
            for folder, names in found.items()
            for name in sorted(names - common, key=natural_key)
        ),
    )
    check_image_names(image_dir, frames.image_names())
    for image_name in frames.image_names():
        # COLMAP's lists of image pairs are separated by spaces.
        if re.search(r"\s", image_name):
            raise InputError(
                f"image {image_dir / image_name}: its name contains white space; "
                "rename it"
            )
        if (image_dir / image_name).stat().st_size == 0:
            raise InputError(f"image {image_dir / image_name} is an empty file")
    return frames


def _images_of(image_dir: Path, folder: str, camera: str) -> set[str]:
    path = image_dir / folder
    if not path.is_dir():
        raise InputError(f"folder {path} of camera {camera!r} does not exist")
    names = {
        item.name
        for item in path.iterdir()
        if item.suffix.lower() in SUFFIXES
        and not item.name.startswith(".")
        and item.is_file()
    }
    if not names:
        raise InputError(f"folder {path} of camera {camera!r} holds no image")
    return names


def check_masks(frames: Frames, rig: Rig, mask_dir: Path) -> None:
    """Every image needs a mask of its size: ``<mask_dir>/left/0001.jpg.png``.

    Raises:
        InputError: a mask that is missing, cannot be decoded, or has another size.
    """
    sizes = {c.images: (c.camera.width, c.camera.height) for c in rig.cameras}
    for name in frames.image_names():
        path = Path(mask_dir) / f"{name}.png"
        if not path.is_file():
            raise InputError(f"mask {path} of image {name} does not exist")
        mask = read_gray(path)
        if mask is None:
            raise InputError(f"mask {path} cannot be read: it is not an image")
        width, height = sizes[name.rpartition("/")[0]]
        if mask.shape != (height, width):
            raise InputError(
                f"mask {path} has {mask.shape[1]} x {mask.shape[0]} pixels, but its "
                f"image has {width} x {height}"
            )


def image_fault(path: Path, size: tuple[int, int]) -> str | None:
    """Why an image cannot be used by a camera of ``size`` (width, height), or None."""
    return size_fault(path, read_gray(path), size)


def size_fault(path: Path, image: Any, size: tuple[int, int]) -> str | None:
    """`image_fault` of what was read from a file: rows, columns, or None."""
    if image is None:
        return f"image {path} cannot be read: it is not an image, or it is damaged"
    height, width = image.shape[:2]
    if (width, height) != size:
        return (
            f"image {path} has {width} x {height} pixels, but the intrinsics of its "
            f"camera are for {size[0]} x {size[1]}"
        )
    return None


def read_gray(path: Path) -> Any:
    """An image (height, width) uint8 as stored, or None if it cannot be decoded.

    The orientation tag is ignored, as by COLMAP: intrinsics belong to the sensor.
    """
    return _read(path, cv2.IMREAD_GRAYSCALE)


def read_color(path: Path) -> Any:
    """`read_gray` in blue, green and red: (height, width, 3)."""
    return _read(path, cv2.IMREAD_COLOR)


def _read(path: Path, flags: int) -> Any:
    try:
        data = np.fromfile(path, dtype=np.uint8)
        if not _chunks_fit(data.data):
            return None
        return cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, cv2.error):  # cv2.error: an empty file
        return None


_PNG = b"\x89PNG\r\n\x1a\n"


def _chunks_fit(data: memoryview) -> bool:
    """Whether the parts of a PNG are as long as they claim; OpenCV takes the memory
    for four gigabytes, and seconds, before it finds out."""
    at = len(_PNG)
    if data[:at] != _PNG:
        return True
    while at + 8 <= len(data):
        kind = bytes(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")  # length, kind, checksum
        if kind == b"IEND":
            return at <= len(data)
    return False
