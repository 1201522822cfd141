"""COLMAP's model files, checked before COLMAP reads them.

COLMAP believes the counts in its binary files: of a file that was cut, or of another
kind, it reads without end. Here the counts are held against the length of the file,
and identifiers against each other. Both layouts are known: cameras, images and
points3D, and with them rigs and frames (4.x). In text files the lines are counted
out. The formats: https://colmap.github.io/format.html
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.files import require_regular
from uwsfm._base.paths import check_image_names, shown
from uwsfm.colmap.text_files import check_text
from uwsfm.errors import InputError

NAMES = ("cameras", "images", "points3D")
RIG_NAMES = ("rigs", "frames")
NO_POINT = 2**64 - 1
"""COLMAP's identifier of no point."""
_POSE = 7 * 8
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_ELEMENT = np.dtype([("image", "<u4"), ("index", "<u4")])
_CHUNK = 1_000_000
"""Elements of tracks that are compared at a time: bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class ImageEntry:
    """What the other files may refer to."""

    name: str
    camera_id: int
    num_points: int


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The identifiers of a model, by file."""

    cameras: set[int] = field(default_factory=set)
    images: dict[int, ImageEntry] = field(default_factory=dict)
    points: set[int] = field(default_factory=set)
    rigs: dict[int, set[int]] = field(default_factory=dict)
    """Cameras of each rig."""


def has_files(folder: Path, kind: str) -> bool:
    """Whether a folder holds a model in binary files ("bin") or in text ("txt")."""
    return all((folder / f"{name}.{kind}").exists() for name in NAMES)


def check_model_files(folder: Path) -> None:
    """Refuse a model whose files are damaged, cut short or of different models.

    Raises:
        InputError: the file, and what is wrong with it.
    """
    if has_files(folder, "bin"):
        _check_binary(folder)
    elif has_files(folder, "txt"):
        check_text(folder)
    else:
        binary = any((folder / f"{name}.bin").exists() for name in (*NAMES, *RIG_NAMES))
        kind = "bin" if binary else "txt"
        missing = [n for n in NAMES if not (folder / f"{n}.{kind}").exists()]
        raise InputError(
            f"{folder}: not a COLMAP model that can be read: {missing[0]}.{kind} is "
            "missing; was all of the folder copied?"
        )


class _File:
    """A binary file, read from its start; it ends where its counts say."""

    def __init__(self, path: Path, data: mmap.mmap | bytes) -> None:
        self.path, self.data, self.at = path, data, 0

    def take(self, kind: struct.Struct) -> tuple[int, ...]:
        """The next numbers."""
        start = self.skip(kind.size)
        return kind.unpack_from(self.data, start)

    def skip(self, num_bytes: int) -> int:
        """Go on by some bytes; where they start."""
        start, self.at = self.at, self.at + num_bytes
        if self.at > len(self.data):
            raise InputError(
                f"{self.path}: is cut short or damaged: it has {len(self.data)} bytes, "
                f"its counts need at least {self.at}; copy it again"
            )
        return start

    def count(self, smallest: int) -> int:
        """How many records follow, of ``smallest`` bytes or more each."""
        (number,) = self.take(_U64)
        if number * smallest > len(self.data) - self.at:
            raise InputError(
                f"{self.path}: is cut short or damaged: {number} records do not fit "
                f"into its {len(self.data)} bytes; copy it again"
            )
        return number

    def text(self) -> str:
        """Up to a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path}: is cut short or damaged: a name has no end")
        raw = self.data[self.at : end]
        self.at = end + 1
        return raw.decode("utf-8", "surrogateescape")

    def damaged(self, what: str) -> InputError:
        return InputError(f"{self.path}: is damaged, or of another model: {what}")


_U64, _U32 = struct.Struct("<Q"), struct.Struct("<I")
_CAMERA, _RIG = struct.Struct("<IiQQ"), struct.Struct("<II")
_SENSOR, _DATA = struct.Struct("<iI"), struct.Struct("<iIQ")
_BYTE = struct.Struct("<B")
CAMERA_SENSOR = 0


@contextmanager
def _opened(path: Path) -> Iterator[_File]:
    """A file, whose end must have been reached."""
    try:
        size = require_regular(path).st_size
        if size == 0:
            raise InputError("is empty; was all of the model copied?")
        with (
            path.open("rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            file = _File(path, data)
            yield file
            if file.at != size:
                raise file.damaged(
                    f"{size - file.at} bytes follow after its last record"
                )
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except InputError as error:
        text = str(error)
        raise InputError(
            text if text.startswith(str(path)) else f"{path}: {text}"
        ) from None


def _check_binary(folder: Path) -> None:
    found = Contents()
    there = [name for name in RIG_NAMES if (folder / f"{name}.bin").exists()]
    if len(there) == 1:
        (missing,) = set(RIG_NAMES) - set(there)
        raise InputError(
            f"{folder}: {there[0]}.bin is there but {missing}.bin is missing; was all "
            "of the folder copied?"
        )
    with _opened(folder / "cameras.bin") as file:
        _walk_cameras(file, found)
    with _opened(folder / "images.bin") as file:
        seen = _walk_images(file, found)
        with _opened(folder / "points3D.bin") as points:
            _walk_points(points, found)
        _check_seen(file, found, seen)
    if there:
        with _opened(folder / "rigs.bin") as file:
            _walk_rigs(file, found)
        with _opened(folder / "frames.bin") as file:
            _walk_frames(file, found)
    check_image_names(folder / "images.bin", (i.name for i in found.images.values()))


@cache
def _num_params() -> dict[int, int]:
    """Of each camera model, by COLMAP's number of it."""
    found = {}
    for name, model in pycolmap.CameraModelId.__members__.items():
        if name != "INVALID":
            lens = pycolmap.Camera.create_from_model_name(1, name, 10.0, 10, 10)
            found[int(model)] = len(lens.params)
    return found


def _walk_cameras(file: _File, found: Contents) -> None:
    for _ in range(file.count(_CAMERA.size)):
        camera_id, model, _, _ = file.take(_CAMERA)
        if model not in _num_params():
            raise file.damaged(f"camera {camera_id} has the unknown model {model}")
        _once(file, found.cameras, camera_id, "camera")
        file.skip(8 * _num_params()[model])


def _once(file: _File, seen: set[int] | dict, number: int, what: str) -> None:
    if number in seen:
        raise file.damaged(f"{what} {number} comes twice")
    if isinstance(seen, set):
        seen.add(number)


def _walk_images(file: _File, found: Contents) -> dict[int, np.ndarray]:
    """The points that each image claims to see, by its identifier."""
    seen = {}
    for _ in range(file.count(_U32.size + _POSE + _U32.size + 1 + _U64.size)):
        (image_id,) = file.take(_U32)
        _once(file, found.images, image_id, "image")
        file.skip(_POSE)
        (camera_id,) = file.take(_U32)
        name = file.text()
        if camera_id not in found.cameras:
            raise file.damaged(
                f"image {shown(name)} is of camera {camera_id}, which cameras.bin lacks"
            )
        number = file.count(_POINT2D.itemsize)
        start = file.skip(number * _POINT2D.itemsize)
        table = np.frombuffer(file.data, _POINT2D, number, start)
        ids = table["point"].copy()
        seen[image_id] = ids[ids != NO_POINT]
        del table  # it would keep the file from being closed
        found.images[image_id] = ImageEntry(
            name=name, camera_id=camera_id, num_points=number
        )
    return seen


_POINT_HEAD = 8 + 3 * 8 + 3 + 8
"""Identifier, position, colour and error."""


def _walk_points(file: _File, found: Contents) -> None:
    number = file.count(_POINT_HEAD + _U64.size)
    starts = np.empty(number, dtype=np.int64)
    lengths = np.empty(number, dtype=np.int64)
    ids = np.empty(number, dtype=np.uint64)
    for i in range(number):
        ids[i] = _U64.unpack_from(file.data, file.skip(_POINT_HEAD))[0]
        lengths[i] = file.count(_ELEMENT.itemsize)
        starts[i] = file.skip(int(lengths[i]) * _ELEMENT.itemsize)
    found.points.update(ids.tolist())
    if len(found.points) < number:
        raise file.damaged("a point comes twice")
    _check_tracks(file, found, starts, lengths)


def _check_tracks(
    file: _File, found: Contents, starts: np.ndarray, lengths: np.ndarray
) -> None:
    """Every element (image, keypoint) of every track is there."""
    image_ids = np.array(sorted(found.images), dtype=np.int64)
    num_keypoints = np.array([found.images[i].num_points for i in image_ids])
    ends = np.cumsum(lengths)
    first = 0
    while first < len(lengths):
        before = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, before + _CHUNK)))
        offsets = np.repeat(starts[first:last], lengths[first:last])
        rank = np.arange(len(offsets)) + before
        rank -= np.repeat(ends[first:last] - lengths[first:last], lengths[first:last])
        raw = np.frombuffer(file.data, np.uint8)
        offsets += rank * _ELEMENT.itemsize
        table = raw[offsets[:, None] + np.arange(8)].copy().view(_ELEMENT).ravel()
        del raw
        place = np.searchsorted(image_ids, table["image"])
        place = np.minimum(place, len(image_ids) - 1)
        good = len(image_ids) > 0 and image_ids[place] == table["image"]
        if not np.all(good):
            stray = int(table["image"][np.argmin(good)])
            raise file.damaged(
                f"a point is seen by image {stray}, which images.bin lacks"
            )
        if np.any(table["index"] >= num_keypoints[place]):
            stray = int(
                table["image"][np.argmax(table["index"] >= num_keypoints[place])]
            )
            raise file.damaged(
                "a point is seen at a keypoint that image "
                f"{shown(found.images[stray].name)} lacks"
            )
        first = last


def _check_seen(file: _File, found: Contents, seen: dict[int, np.ndarray]) -> None:
    points = np.array(sorted(found.points), dtype=np.uint64)
    for image_id, ids in seen.items():
        if not np.all(np.isin(ids, points)):
            raise file.damaged(
                f"image {shown(found.images[image_id].name)} sees a point that "
                "points3D.bin lacks"
            )


def _walk_rigs(file: _File, found: Contents) -> None:
    for _ in range(file.count(_RIG.size)):
        rig_id, num_sensors = file.take(_RIG)
        _once(file, found.rigs, rig_id, "rig")
        cameras = found.rigs.setdefault(rig_id, set())
        for sensor in range(num_sensors):
            kind, sensor_id = file.take(_SENSOR)
            if sensor and file.take(_BYTE)[0]:  # the first is the reference
                file.skip(_POSE)
            if kind == CAMERA_SENSOR:
                if sensor_id not in found.cameras:
                    raise file.damaged(
                        f"rig {rig_id} has camera {sensor_id}, which cameras.bin lacks"
                    )
                cameras.add(sensor_id)


def _walk_frames(file: _File, found: Contents) -> None:
    frames: set[int] = set()
    placed: set[int] = set()
    for _ in range(file.count(_RIG.size + _POSE + _U32.size)):
        frame_id, rig_id = file.take(_RIG)
        _once(file, frames, frame_id, "frame")
        if rig_id not in found.rigs:
            raise file.damaged(f"frame {frame_id} is of rig {rig_id}, which is unknown")
        file.skip(_POSE)
        (number,) = file.take(_U32)
        for _ in range(number):
            kind, sensor_id, data_id = file.take(_DATA)
            if kind != CAMERA_SENSOR:
                continue
            image = found.images.get(data_id)
            if image is None:
                raise file.damaged(
                    f"frame {frame_id} has image {data_id}, which images.bin lacks"
                )
            if image.camera_id != sensor_id or sensor_id not in found.rigs[rig_id]:
                raise file.damaged(
                    f"image {shown(image.name)} is of camera {image.camera_id}, but "
                    f"frame {frame_id} has it of camera {sensor_id}"
                )
            _once(file, placed, data_id, "image")
    for image_id in found.images.keys() - placed:
        raise file.damaged(f"image {shown(found.images[image_id].name)} is in no frame")
