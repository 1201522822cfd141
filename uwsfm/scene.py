"""`Scene`: cameras, poses, points and observations as plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm._base.indices import renumbered
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import Port
from uwsfm.models.refractive import RefractiveCamera

IndexArray = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A rig of refractive cameras that saw points from several places.

    Build it with `from_arrays`, which checks it. Lengths are metres; poses are rows
    [qx, qy, qz, qw, tx, ty, tz] as `pycolmap.Rigid3d.params`. Arrays are never changed
    in place.
    """

    cameras: tuple[RefractiveCamera, ...]
    """C cameras; the first is the reference."""
    cam_from_rig: Array
    """(C, 7); row 0 is the identity."""
    rig_from_world: Array
    """(F, 7), one pose per frame."""
    points: Array
    """(P, 3) in the world; NaN rows are points without enough observations."""
    camera_idx: IndexArray
    """(N,) of each observation."""
    frame_idx: IndexArray
    """(N,)"""
    point_idx: IndexArray
    """(N,)"""
    xy: Array
    """(N, 2) pixels; the centre of the first pixel is (0.5, 0.5)."""

    @classmethod
    def from_arrays(
        cls,
        *,
        cameras: Sequence[RefractiveCamera],
        cam_from_rig: ArrayLike,
        rig_from_world: ArrayLike,
        points: ArrayLike,
        camera_idx: ArrayLike,
        frame_idx: ArrayLike,
        point_idx: ArrayLike,
        xy: ArrayLike,
    ) -> "Scene":
        """Check and copy the arrays (shapes as in the class).

        Raises:
            InputError: a wrong shape, an index out of range, a quaternion that is not
                unit, a reference camera that is not the rig, or observations that are
                not finite; the message names the array and the row.
        """
        cameras = tuple(cameras)
        if not cameras:
            raise InputError("cameras is empty: a scene needs at least one camera")
        for index, camera in enumerate(cameras):
            if not isinstance(camera, RefractiveCamera):
                raise InputError(
                    f"cameras[{index}] must be a RefractiveCamera, got {camera!r}"
                )
        cam_poses = _poses("cam_from_rig", cam_from_rig)
        frame_poses = _poses("rig_from_world", rig_from_world)
        if len(cam_poses) != len(cameras):
            raise InputError(
                f"{len(cam_poses)} rows in cam_from_rig for {len(cameras)} cameras"
            )
        if not np.allclose(np.abs(cam_poses[0]), rigid3.IDENTITY, atol=1e-9):
            raise InputError(
                "cam_from_rig[0] must be the identity: the first camera is the rig"
            )
        cam_poses[0] = rigid3.IDENTITY
        pixels = _floats("xy", xy, 2)
        if not np.all(np.isfinite(pixels)):
            row = int(np.nonzero(~np.isfinite(pixels).all(axis=1))[0][0])
            raise InputError(f"xy[{row}] is not finite: {pixels[row].tolist()}")
        point_rows = _floats("points", points, 3)
        count = len(pixels)
        return cls(
            cameras=cameras,
            cam_from_rig=cam_poses,
            rig_from_world=frame_poses,
            points=point_rows,
            camera_idx=_indices("camera_idx", camera_idx, count, len(cameras)),
            frame_idx=_indices("frame_idx", frame_idx, count, len(frame_poses)),
            point_idx=_indices("point_idx", point_idx, count, len(point_rows)),
            xy=pixels,
        )

    def __repr__(self) -> str:
        return (
            f"Scene({len(self.cameras)} cameras, {self.num_frames} frames, "
            f"{self.num_points} points, {self.num_observations} observations)"
        )

    @property
    def num_frames(self) -> int:
        return len(self.rig_from_world)

    @property
    def num_points(self) -> int:
        return len(self.points)

    @property
    def num_observations(self) -> int:
        return len(self.xy)

    @property
    def ports(self) -> tuple[Port, ...]:
        return tuple(camera.port for camera in self.cameras)

    def points_in_cam(self) -> Array:
        """The observed point in its camera's frame, per observation (N, 3)."""
        poses = rigid3.compose(self.cam_from_rig[:, None], self.rig_from_world)
        image = self.camera_idx * self.num_frames + self.frame_idx
        in_world = self.points[self.point_idx]
        return rigid3.transform_indexed(poses.reshape(-1, 7), image, in_world)

    def projections(self) -> tuple[Array, NDArray[np.bool_]]:
        """Exact projections (N, 2) of the points, NaN where not ``valid`` (N,)."""
        in_cam = self.points_in_cam()
        xy = np.full((self.num_observations, 2), np.nan)
        valid = np.zeros(self.num_observations, dtype=bool)
        for index, camera in enumerate(self.cameras):
            rows = self.camera_idx == index
            xy[rows], valid[rows] = camera.img_from_point(in_cam[rows])
        return xy, valid

    def residuals(self) -> Array:
        """True pixel errors, projection minus observation (N, 2); NaN if invalid."""
        return self.projections()[0] - self.xy

    def water_rays(self) -> tuple[Array, Array]:
        """Water rays of the observations in the world: origins, directions (N, 3)."""
        origins = np.full((self.num_observations, 3), np.nan)
        dirs = np.full((self.num_observations, 3), np.nan)
        for index, camera in enumerate(self.cameras):
            rows = self.camera_idx == index
            origin, direction = camera.ray_from_img(self.xy[rows])
            cam_from_world = rigid3.compose(
                self.cam_from_rig[index], self.rig_from_world[self.frame_idx[rows]]
            )
            world_from_cam = rigid3.inverse(cam_from_world)
            origins[rows] = rigid3.transform(world_from_cam, origin)
            dirs[rows] = rigid3.rotate(world_from_cam, direction)
        return origins, dirs

    def select(self, keep: ArrayLike) -> tuple["Scene", IndexArray]:
        """Keep some observations and only the points they see.

        Args:
            keep: (N,) mask.

        Returns:
            The smaller scene, and the old index of each of its points (P',).
        """
        mask = np.asarray(keep, dtype=bool)
        used, point_idx = renumbered(self.point_idx[mask], self.num_points)
        smaller = replace(
            self,
            points=self.points[used],
            camera_idx=self.camera_idx[mask],
            frame_idx=self.frame_idx[mask],
            point_idx=point_idx,
            xy=self.xy[mask],
        )
        return smaller, used


def _floats(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.array(values, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(f"{name}.shape={array.shape}, expected (N, {columns})")
    return array


def _poses(name: str, values: ArrayLike) -> Array:
    poses = _floats(name, values, 7)
    norms = np.linalg.norm(poses[:, :4], axis=1)
    wrong = ~(np.abs(norms - 1.0) < 1e-6) | ~np.all(np.isfinite(poses), axis=1)
    if np.any(wrong):
        row = int(np.nonzero(wrong)[0][0])
        raise InputError(
            f"{name}[{row}] must be a unit quaternion xyzw and a translation, "
            f"got {poses[row].tolist()}"
        )
    poses[:, :4] /= norms[:, None]
    return poses


def _indices(name: str, values: ArrayLike, count: int, limit: int) -> IndexArray:
    array = np.asarray(values)
    if array.shape != (count,) or array.dtype.kind not in "iu":
        raise InputError(
            f"{name} must be {count} integers, one per row of xy, "
            f"got shape {array.shape} of {array.dtype}"
        )
    indices = array.astype(np.int64)
    if count and (indices.min() < 0 or indices.max() >= limit):
        row = int(np.nonzero((indices < 0) | (indices >= limit))[0][0])
        raise InputError(
            f"{name}[{row}]={indices[row]} is out of range: there are {limit}"
        )
    return indices
