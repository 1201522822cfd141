"""What other commands left in an output folder, and what they say of it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from uwsfm.errors import InputError
from uwsfm.export.files import POINTS, SPARSE, SUMMARY, WORK
from uwsfm.result_folder import DENSE_CLOUD, find_dense_cloud

_KINDS = {
    ".ply": "cloud or mesh",
    ".las": "cloud",
    ".laz": "cloud",
    ".obj": "mesh",
    ".glb": "mesh for the web",
    ".tif": "map",
}
_MEASURED = "measure*.json"


def left_files(
    out: Path, own: str, small_unit: str, small_scale: float
) -> tuple[tuple[str, str], ...]:
    """Path in the output folder, and what it is.

    Args:
        out: the folder.
        own: name of the report's folder in it.
        small_unit: of small lengths.
        small_scale: how many of it a unit of the model is.
    """
    scale = small_scale, small_unit
    own_names = {SPARSE, POINTS, own, WORK}
    found = [
        (path, _words(path, out, scale))
        for path in sorted([*out.glob("*.*"), *out.glob("*/*.*")])
        if path.suffix in _KINDS and path.is_file()
    ]
    found += [(path, _measured_words(path)) for path in sorted(out.glob(_MEASURED))]
    places = [(path.relative_to(out), what) for path, what in found]
    return tuple(
        (path.as_posix(), what)
        for path, what in places
        if path.parts[0] not in own_names
    )


def _words(path: Path, out: Path, scale: tuple[float, str]) -> str:
    if path == out / DENSE_CLOUD:
        return _dense_words(out, scale)
    kind = _KINDS[path.suffix]
    try:
        if path.suffix == ".tif":
            found = _read(path.with_name("map.json"))
            cell = _small(found["resolution"], scale)
            size = f"{found['num_columns']} x {found['num_rows']}"
            share = f"{found['share_with_data']:.0%} with data"
            return f"map: {size} cells of {cell}, {share}, {found['level']}"
        if path.stem in ("mesh", "web"):
            found = _read(path.with_name("mesh.json"))
            count = found[path.stem]["num_triangles"]
            far = _small(found["max_distance"], scale)
            return f"mesh: {count} triangles, none further than {far} from a point"
    except (OSError, ValueError, KeyError, TypeError):
        pass  # it was put there by hand
    return kind


def _dense_words(out: Path, scale: tuple[float, str]) -> str:
    try:
        find_dense_cloud(out)
    except InputError:
        return "a dense cloud, but of another model: run uwsfm dense again"
    try:
        found = _read((out / DENSE_CLOUD).with_name(SUMMARY))
        spread = [found["stddev_percentiles"][share] for share in ("5", "50", "95")]
        matched = [entry["share_matched"] for entry in found["depth_maps"]]
        return (
            f"dense cloud: {found['num_points']} points; standard deviation along the "
            f"sight {', '.join(f'{scale[0] * x:.2g}' for x in spread)} {scale[1]} "
            f"(5, 50, 95 %); noise of a disparity {found['noise_px']:.2f} px "
            f"({found['noise_from']}); {sum(matched) / len(matched):.0%} of the pixels "
            "have a depth"
        )
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        return "cloud, without a summary of uwsfm dense"


def _measured_words(path: Path) -> str:
    try:
        items = _read(path)["measurements"]
        determined = sum(item["value"] is not None for item in items)
    except (OSError, ValueError, KeyError, TypeError):
        return "measurements"
    return f"measurements: {len(items)}, of these {determined} determined"


def _small(value: float, scale: tuple[float, str]) -> str:
    return f"{scale[0] * value:.2g} {scale[1]}"


def _read(path: Path) -> Mapping[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))
