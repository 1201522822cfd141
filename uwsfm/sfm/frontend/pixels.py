"""Pixels of image files, in 8 bits: what features and colours are taken from."""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg

from uwsfm.errors import InputError

# What is wrong with a file is said in one sentence, not in the lines of a library.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

_KEEP = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
_PNG = b"\x89PNG\r\n\x1a\n"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"IDAT")
_JPEG = b"\xff\xd8\xff"
_EXTRA_BYTES = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
NO_DAMAGE = ("Unsupported color", "Unsupported JPEG process")
"""What libjpeg says of whole images of kinds that it does not turn into grey."""
MAX_EXTRA_BYTES = 16
"""Before the end of a JPEG: some cameras leave a few, behind the whole image."""


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
    """An image in 8 bits, or None if it is none that can be decoded.

    Raises:
        InputError: the file cannot be read, or is a JPEG whose data are damaged, which
            decoders fill up with grey or noise.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    fault = _jpeg_fault(data)
    if fault is not None:
        raise InputError(
            f"image {path} is damaged ({fault}): copy it again, or remove it"
        )
    image = _decoded(data, flags)
    return None if image is None else _in_8_bits(image)


def _decoded(data: np.ndarray, flags: int) -> Any:
    if not _chunks_fit(data.data):
        return None
    try:
        return cv2.imdecode(data, flags | _KEEP)
    except cv2.error:  # an empty file
        return None


def _in_8_bits(image: np.ndarray) -> np.ndarray:
    """Values scaled to the bits that an image uses; floats to its largest value, or one
    if that is larger.

    Cameras of 10, 12 or 14 bits store them in 16: divided by 256, they would be black.
    """
    if image.dtype == np.uint8:
        return image
    if image.dtype == np.uint16:
        bits = max(8, int(image.max()).bit_length())
        return (image >> (bits - 8)).astype(np.uint8)
    values = np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    scaled = 255.0 * values / max(float(values.max()), 1.0)
    return np.clip(np.round(scaled), 0.0, 255.0).astype(np.uint8)


def value_range(path: Path) -> str:
    """What the values of an image's pixels are, in words, where they are scaled; ''."""
    try:
        image = _decoded(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError:
        return ""
    if image is None or image.dtype == np.uint8:
        return ""
    if image.dtype != np.uint16:
        return f"pixels of type {image.dtype}, up to {float(np.nanmax(image)):.4g}"
    bits = int(image.max()).bit_length()
    return f"{bits} bits in pixels of 16" if bits < 16 else ""


def _jpeg_fault(data: np.ndarray) -> str | None:
    """What libjpeg has to say of the data of a JPEG that it decodes all the same."""
    content = data.tobytes()
    if not content.startswith(_JPEG):
        return None
    words = _strict_words(content)
    extra = _EXTRA_BYTES.search(words)
    if extra is not None and int(extra[1]) <= MAX_EXTRA_BYTES:
        end = content.rfind(b"\xff\xd9")  # without them, nothing else may be wrong
        words = _strict_words(content[: end - int(extra[1])] + content[end:])
    return words or None


def _strict_words(content: bytes) -> str:
    """Of libjpeg, of what is not right in a JPEG; ''."""
    try:
        simplejpeg.decode_jpeg(content, "GRAY", strict=True)
    except ValueError as error:
        words = str(error)
        return "" if words.startswith(NO_DAMAGE) else words
    return ""


def _chunks_fit(data: memoryview) -> bool:
    """Whether the parts of a PNG are as long as they claim, and those of its pixels
    whole; OpenCV takes the memory for four gigabytes, and seconds, before it finds out,
    and fills up what is damaged."""
    at = len(_PNG)
    if data[:at] != _PNG:
        return True
    while at + 8 <= len(data):
        kind = bytes(data[at + 4 : at + 8])
        start = at + 4
        at += 12 + int.from_bytes(data[at : at + 4], "big")  # length, kind, checksum
        if kind in _PIXEL_CHUNKS and at <= len(data):
            expected = int.from_bytes(data[at - 4 : at], "big")
            if zlib.crc32(data[start : at - 4]) != expected:
                return False
        if kind == b"IEND":
            return at <= len(data)
    return False
