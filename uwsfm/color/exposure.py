"""How images were exposed, by their EXIF (JPEG and TIFF)."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

_EXPOSURE, _APERTURE, _ISO, _BALANCE, _EXIF = 33434, 33437, 34855, 41987, 34665
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}
_WHOLE = {1: "B", 3: "H", 4: "I"}
_MAX_HEADER = 262_144
_SAME = 1.02
"""Exposures whose ratio is below are the same: cameras round what they tell."""


@dataclass(frozen=True)
class Exposure:
    """What the camera says of an image; None where it does not."""

    light: float | None
    """Relative: time times sensitivity over the square of the aperture."""
    auto_white_balance: bool | None


def read_exposure(path: Path) -> Exposure | None:
    """What the EXIF of an image tells; None without any."""
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_HEADER)
        tags = _exif_tags(data)
    except (OSError, struct.error, IndexError):
        return None
    if not tags:
        return None
    time, iso = tags.get(_EXPOSURE), tags.get(_ISO)
    light = None
    if time and iso:
        light = time * iso / tags.get(_APERTURE, 1.0) ** 2
    balance = tags.get(_BALANCE)
    return Exposure(light, None if balance is None else balance == 0)


def exposure_warnings(paths: Iterable[Path]) -> list[str]:
    """Sentences on exposures that differ, or white balances that were automatic."""
    known = [(p, e) for p in paths if (e := read_exposure(p)) is not None]
    found = []
    lights = [(e.light, p.name) for p, e in known if e.light]
    if lights:
        (least, darkest), (most, brightest) = min(lights), max(lights)
        if most > _SAME * least:
            found.append(
                f"exposures differ by a factor of {most / least:.3g} ({darkest} to "
                f"{brightest}, by their EXIF), which is not allowed for"
            )
    automatic = [p.name for p, e in known if e.auto_white_balance]
    if automatic:
        found.append(
            f"the white balance of {len(automatic)} images, for instance "
            f"{automatic[0]}, was automatic: it may change from image to image"
        )
    return found


def _exif_tags(data: bytes) -> dict[int, float]:
    """Numbers of the first image directory and of its EXIF directory."""
    start = 0
    if data[:2] == b"\xff\xd8":
        start = _app1(data)
    if data[start : start + 2] not in (b"II", b"MM"):
        return {}
    order = "<" if data[start : start + 2] == b"II" else ">"
    tiff = data[start:]
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    tags = _directory(tiff, first, order)
    if _EXIF in tags:
        tags |= _directory(tiff, int(tags[_EXIF]), order)
    return tags


def _app1(data: bytes) -> int:
    """Where the TIFF structure of a JPEG file's EXIF begins; its end without any."""
    place = 2
    while data[place : place + 1] == b"\xff":
        marker, size = struct.unpack_from(">xBH", data, place)
        if marker == 0xE1 and data[place + 4 : place + 10] == b"Exif\0\0":
            return place + 10
        if marker == 0xDA:
            break
        place += 2 + size
    return len(data)


def _directory(tiff: bytes, place: int, order: str) -> dict[int, float]:
    """First number of each tag that holds numbers."""
    (count,) = struct.unpack_from(order + "H", tiff, place)
    tags: dict[int, float] = {}
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(order + "HHI", tiff, entry)
        where = entry + 8
        if _SIZES.get(kind, 0) * number > 4:
            (where,) = struct.unpack_from(order + "I", tiff, where)
        if kind in _WHOLE:
            (tags[tag],) = struct.unpack_from(order + _WHOLE[kind], tiff, where)
        elif kind in (5, 10):
            form = order + ("II" if kind == 5 else "ii")
            top, bottom = struct.unpack_from(form, tiff, where)
            if bottom:
                tags[tag] = top / bottom
    return tags
