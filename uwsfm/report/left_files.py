"""What other commands left in an output folder, and what they say of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from uwsfm.results.files import POINTS, SPARSE, WORK
from uwsfm.results.folder import DENSE_CLOUD, fingerprint_of, read_told, told_of

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
    folder = _Folder(out, small_unit, small_scale)
    own_names = {SPARSE, POINTS, own, WORK}
    found = [
        (path, folder.words(path, told_of(path)))
        for path in sorted([*out.glob("*.*"), *out.glob("*/*.*")])
        if path.suffix in _KINDS and path.is_file()
    ]
    found += [
        (path, folder.words(path, read_told(path)))
        for path in sorted(out.glob(_MEASURED))
    ]
    places = [(path.relative_to(out), what) for path, what in found]
    return tuple(
        (path.as_posix(), what)
        for path, what in places
        if path.parts[0] not in own_names
    )


@dataclass(frozen=True)
class _Folder:
    """An output folder, and the small lengths of its model."""

    out: Path
    small_unit: str
    small_scale: float

    @cached_property
    def fingerprint(self) -> str:
        return fingerprint_of(self.out)

    def words(self, path: Path, told: Mapping[str, Any]) -> str:
        """What a file is, by what is told of it."""
        is_dense, mark = path == self.out / DENSE_CLOUD, told.get("model")
        kind = "dense cloud" if is_dense else _KINDS.get(path.suffix, "measurements")
        if mark is not None and mark != self.fingerprint:
            return f"{kind}, but of another model: make it again"
        try:
            if is_dense:
                return self._dense(told)
            if path.suffix == ".tif":
                return self._map(told)
            if path.suffix == ".json":
                return _measured(told)
            return self._mesh(told[path.stem], told["max_distance"])
        except (ValueError, KeyError, TypeError, ZeroDivisionError):
            return kind  # it was put there by hand

    def _dense(self, told: Mapping[str, Any]) -> str:
        spread = [told["stddev_percentiles"][share] for share in ("5", "50", "95")]
        spread = [f"{self.small_scale * value:.2g}" for value in spread]
        matched = [entry["share_matched"] for entry in told["depth_maps"]]
        return (
            f"dense cloud: {told['num_points']} points; standard deviation along the "
            f"sight {', '.join(spread)} {self.small_unit} "
            f"(5, 50, 95 %); noise of a disparity {told['noise_px']:.2f} px "
            f"({told['noise_from']}); {sum(matched) / len(matched):.0%} of the pixels "
            "have a depth"
        )

    def _map(self, told: Mapping[str, Any]) -> str:
        size = f"{told['num_columns']} x {told['num_rows']}"
        cell, share = self._small(told["resolution"]), told["share_with_data"]
        return f"map: {size} cells of {cell}, {share:.0%} with data, {told['level']}"

    def _mesh(self, told: Mapping[str, Any], distance: float) -> str:
        return (
            f"mesh: {told['num_triangles']} triangles, none further than "
            f"{self._small(distance)} from a point"
        )

    def _small(self, value: float) -> str:
        return f"{self.small_scale * value:.2g} {self.small_unit}"


def _measured(told: Mapping[str, Any]) -> str:
    items = told["measurements"]
    determined = sum(item["value"] is not None for item in items)
    return f"measurements: {len(items)}, of these {determined} determined"
