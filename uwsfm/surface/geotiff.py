"""GeoTIFF of a local frame: the scale and the place of the pixels (tifffile)."""

from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm._base.packages import import_package
from uwsfm.surface.height_map import HeightMap

# Tags and keys of the GeoTIFF standard (OGC 19-008r4), and GDAL's for missing data.
_PIXEL_SCALE, _TIEPOINT, _KEYS, _ASCII, _NO_DATA = 33550, 33922, 34735, 34737, 42113
_MODEL_TYPE, _RASTER_TYPE, _CITATION, _LINEAR_UNITS = 1024, 1025, 1026, 3076
_USER_DEFINED, _PIXEL_IS_AREA, _METRE = 32767, 1, 9001


def write_height_tiff(found: HeightMap, path: Path, frame: str, unit: str) -> None:
    """Write heights (float, NaN where there is none).

    Args:
        found: the map.
        path: the file.
        frame: name of the frame, for the file's citation.
        unit: of lengths; only metres are declared as such.

    Raises:
        MissingPackageError: tifffile is missing.
    """
    _write(found, found.height, path, frame, unit, {"photometric": "minisblack"})


def write_color_tiff(found: HeightMap, path: Path, frame: str, unit: str) -> None:
    """Write colours with an alpha channel that is 0 where there is no data; the rest as
    in `write_height_tiff`."""
    kind = {"photometric": "rgb", "extrasamples": ["unassalpha"]}
    _write(found, found.colors, path, frame, unit, kind)


def write_origin_tiff(found: HeightMap, path: Path, frame: str, unit: str) -> None:
    """Write what each cell holds: 0 nothing, 1 measured, 2 filled between points; the
    rest as in `write_height_tiff`."""
    _write(found, found.origin, path, frame, unit, {"photometric": "minisblack"})


def _write(
    found: HeightMap,
    pixels: np.ndarray,
    path: Path,
    frame: str,
    unit: str,
    kind: dict[str, Any],
) -> None:
    tifffile = import_package("tifffile", "writing GeoTIFF", "inspect")
    citation = f"{frame}, unit: {unit}|".encode("ascii", "replace").decode()
    keys = [
        (_MODEL_TYPE, 0, 1, _USER_DEFINED),
        (_RASTER_TYPE, 0, 1, _PIXEL_IS_AREA),
        (_CITATION, _ASCII, len(citation), 0),
    ]
    if unit == "metre":
        keys.append((_LINEAR_UNITS, 0, 1, _METRE))
    directory = [1, 1, 0, len(keys), *(number for key in keys for number in key)]
    scale = (found.resolution, found.resolution, 0.0)
    # The outer corner of the first pixel; rows run south.
    tiepoint = (0.0, 0.0, 0.0, found.west, found.north, 0.0)
    tags = [
        (_PIXEL_SCALE, "d", 3, scale, True),
        (_TIEPOINT, "d", 6, tiepoint, True),
        (_KEYS, "H", len(directory), directory, True),
        (_ASCII, "s", 0, citation, True),
    ]
    if pixels.dtype.kind == "f":
        tags.append((_NO_DATA, "s", 0, "nan", True))
    with replaced_file(path) as partial:
        tifffile.imwrite(
            partial,
            pixels,
            compression="zlib",
            extratags=tags,
            metadata=None,
            software="uwsfm",
            **kind,
        )
