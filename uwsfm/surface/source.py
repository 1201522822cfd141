"""The cloud that is meant by a result folder or by a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwsfm._ply import read_vertices
from uwsfm.cloud import Cloud, read_cloud, unit_of_cloud
from uwsfm.errors import InputError
from uwsfm.export.files import POINTS, SPARSE, read_model, unit_of_model
from uwsfm.geometry.rigid3 import Array

DENSE_CLOUD = "dense/cloud.ply"


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
        """Of its lengths: "metre", or "scale arbitrary"."""
        if self.folder is not None:
            return unit_of_model(self.folder)
        return unit_of_cloud(self.path)

    def table(self) -> np.ndarray:
        """All columns of its vertices, a structured array (N,)."""
        return read_vertices(self.path)[0]

    def cloud(self) -> Cloud:
        """Its points; of sparse ones, ranges and standard deviations as a cloud's."""
        cloud = read_cloud(self.path)
        if not self.is_sparse:
            return cloud
        table = self.table()
        names = table.dtype.names or ()
        stddev = cloud.stddev
        if "depth_stddev_m" in names:
            stddev = table["depth_stddev_m"].astype(np.float64)
        return Cloud(
            points=cloud.points,
            normals=cloud.normals,
            colors=cloud.colors,
            stddev=stddev,
            num_views=table["track_length"].astype(np.int64),
            view_range=self.sparse_ranges(len(cloud)),
        )

    def sparse_ranges(self, count: int) -> Array:
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

    def camera_centers(self) -> Array | None:
        """Of the frames (F, 3) in the world; None without a reconstruction."""
        if self.folder is None:
            return None
        from uwsfm.geometry import rigid3

        return rigid3.inverse(read_model(self.folder).scene.rig_from_world)[:, 4:]


def find_source(path: str | Path) -> Source:
    """The dense cloud of a result folder, or its points if there is none; or a file.

    Raises:
        InputError: neither is there.
    """
    path = Path(path)
    if path.is_file():
        for folder in (path.parent, path.parent.parent):
            if (folder / SPARSE).is_dir() and (folder / POINTS).is_file():
                return Source(path=path, folder=folder)
        return Source(path=path, folder=None)
    if not path.is_dir():
        raise InputError(f"{path}: no such file or folder")
    for name in (DENSE_CLOUD, POINTS):
        if (path / name).is_file():
            return Source(path=path / name, folder=path)
    raise InputError(f"{path}: has neither {DENSE_CLOUD} nor {POINTS}")
