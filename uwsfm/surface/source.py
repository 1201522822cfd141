"""The cloud that is meant by a result folder or by a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import append_fields

from uwsfm.cloud import UNKNOWN_UNIT, Cloud, cloud_of_table, read_table, unit_of_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.files import POINTS, SPARSE, read_model, read_summary, unit_of_model
from uwsfm.results.folder import (
    DENSE_CLOUD,
    find_dense_cloud,
    fingerprint_of,
    require_model,
    told_of,
)
from uwsfm.surface.level import Level, find_level


@dataclass(frozen=True, kw_only=True)
class Source:
    """A cloud's file, and the result folder around it."""

    path: Path
    folder: Path | None
    """Of the reconstruction; None for a file that lies elsewhere."""

    @property
    def is_sparse(self) -> bool:
        """Whether these are the points of the adjustment."""
        return self.folder is not None and self.path == self.folder / POINTS

    @property
    def unit(self) -> str:
        """Of its lengths: "metre", "scale arbitrary", what another program's file
        says, or `UNKNOWN_UNIT`."""
        known = UNKNOWN_UNIT if self.folder is None else unit_of_model(self.folder)
        return unit_of_cloud(self.path) if known == UNKNOWN_UNIT else known

    @property
    def model(self) -> str | None:
        """Fingerprint of the model that it was made of; None if nothing tells."""
        if self.folder is None:
            return told_of(self.path).get("model")
        return fingerprint_of(self.folder)

    def table(self) -> np.ndarray:
        """All columns of its vertices, a structured array (N,); of the points of the
        adjustment their ranges too, as view_range.

        Raises:
            InputError: the file cannot be read, has no x, y and z, or has other points
                than the model beside it.
        """
        table = read_table(self.path)
        if not self.is_sparse:
            return table
        ranges = self._sparse_ranges(len(table)).astype(np.float32)
        return append_fields(table, "view_range", ranges, usemask=False)

    def cloud(self) -> Cloud:
        """Its points, and what `table` holds of each."""
        return cloud_of_table(self.table())

    def _sparse_ranges(self, count: int) -> Array:
        """Mean length of the water rays to the points of the adjustment (P,).

        Raises:
            InputError: the file has other points than the model beside it.
        """
        assert self.folder is not None
        scene = read_model(self.folder).scene
        if scene.num_points != count:
            raise InputError(
                f"{self.path}: has {count} points, but the model in "
                f"{self.folder / SPARSE} has {scene.num_points}"
            )
        origins, _ = scene.water_rays()
        ranges = np.linalg.norm(scene.points[scene.point_idx] - origins, axis=1)
        total = np.bincount(scene.point_idx, ranges, minlength=count)
        return total / np.bincount(scene.point_idx, minlength=count)

    def level(self, cloud: Cloud, up: str | None) -> Level:
        """The level frame of its world, see `uwsfm.surface.level.find_level`.

        Raises:
            InputError: which way is up would be a guess.
        """
        has_positions = self.folder is not None and (
            (read_summary(self.folder) or {}).get("positions") is not None
        )
        above = self.above(cloud)
        return find_level(up, cloud.points, above, has_positions=has_positions)

    def above(self, cloud: Cloud) -> Array | None:
        """A place (3,) on the cameras' side of the points: the cameras' middle, or far
        off where most normals point to; None if neither is known."""
        if self.folder is not None:
            poses = read_model(self.folder).scene.rig_from_world
            return rigid3.inverse(poses)[:, 4:].mean(axis=0)
        known = np.isfinite(cloud.normals).all(axis=1)
        if not np.any(known):
            return None
        middle = np.nanmedian(cloud.points, axis=0)
        reach = np.nanmax(np.abs(cloud.points - middle))
        return middle + 1e3 * reach * cloud.normals[known].mean(axis=0)

    def warnings(self) -> list[str]:
        """What the user should know, one sentence each."""
        found = []
        if self.is_sparse:
            assert self.folder is not None
            dense = self.folder / DENSE_CLOUD
            there = "there is" if dense.is_file() else "uwsfm dense makes"
            found.append(
                f"{self.path} holds the points of the adjustment, far fewer than a "
                f"dense cloud, which {there} as {dense}"
            )
        unit = self.unit
        if unit == UNKNOWN_UNIT:
            found.append(f"nothing tells the unit of {self.path}: no metres")
        elif unit != "metre":
            found.append("the scale of this reconstruction is arbitrary: no metres")
        return found


def find_source(path: str | Path) -> Source:
    """The dense cloud of a result folder, or its points if there is none; or a file.

    Raises:
        InputError: neither is there, or the cloud is of another model than the
            result folder that it is in.
    """
    path = Path(path)
    if path.is_file():
        for folder in (path.parent, path.parent.parent):
            if (folder / SPARSE).is_dir() and (folder / POINTS).is_file():
                require_model(path, folder, f"make it again of {folder}")
                return Source(path=path, folder=folder)
        return Source(path=path, folder=None)
    if not path.is_dir():
        raise InputError(f"{path}: no such file or folder")
    cloud = find_dense_cloud(path) or path / POINTS
    if cloud.is_file():
        return Source(path=cloud, folder=path)
    raise InputError(f"{path}: has neither {DENSE_CLOUD} nor {POINTS}")
