"""The camera rig that a reconstruction works on: lenses in air, ports, placement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY, Array

if TYPE_CHECKING:  # heavy: importing a rig must not load pycolmap or numba
    import pycolmap

    from uwsfm.models.port import FlatPort
    from uwsfm.models.refractive import RefractiveCamera

UNIT_TOLERANCE = 1e-9
"""Quaternions and normals nearer to unit length than this are taken as they are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigCamera:
    """One camera of a rig, behind its own port."""

    name: str
    images: str
    """Sub-folder of the image directory, with forward slashes."""
    camera: pycolmap.Camera
    """Intrinsics in air, with width and height; pixel origin as COLMAP."""
    port: FlatPort
    """In the camera frame; the initial value of whatever is refined."""
    refine_normal: bool
    refine_distance: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras fixed to each other; the first one is the reference.

    Raises:
        InputError: fewer than two cameras, a name or folder used twice, ports that
            disagree on the water, or poses and baseline that contradict each other.
    """

    cameras: tuple[RigCamera, ...]
    cam_from_rig: Array | None
    """(C, 7) poses, row 0 the identity; None if only the baseline length is known."""
    baseline_m: float
    """Length of the second camera's translation: the only source of scale."""
    baseline_stddev_m: float
    """Standard deviation of the baseline; 0 holds it exactly."""

    def __post_init__(self) -> None:
        if len(self.cameras) < 2:
            raise InputError(
                f"a rig needs at least two cameras, got {len(self.cameras)}: "
                "the baseline between them is the only source of scale"
            )
        for what in ("name", "images"):
            values = [getattr(camera, what) for camera in self.cameras]
            if len(set(values)) < len(values):
                raise InputError(f"cameras of a rig share the same {what}: {values}")
        waters = sorted({camera.port.n_water for camera in self.cameras})
        if len(waters) > 1:
            raise InputError(f"the ports of a rig are in different waters: {waters}")
        if not 0.0 < self.baseline_m < np.inf:
            raise InputError(f"rig baseline must be positive, got {self.baseline_m} m")
        if not 0.0 <= self.baseline_stddev_m <= self.baseline_m:
            raise InputError(
                "rig baseline_stddev_m must lie between 0 and the baseline, got "
                f"{self.baseline_stddev_m} for a baseline of {self.baseline_m} m"
            )
        if self.cam_from_rig is not None:
            object.__setattr__(self, "cam_from_rig", self._checked_poses())
        elif len(self.cameras) != 2:
            raise InputError(
                "a baseline length alone describes a rig of two cameras, "
                f"this one has {len(self.cameras)}"
            )

    def _checked_poses(self) -> Array:
        """A read-only copy of `cam_from_rig` (C, 7)."""
        poses = np.array(self.cam_from_rig, dtype=np.float64)
        if poses.shape != (len(self.cameras), 7) or not np.all(np.isfinite(poses)):
            raise InputError(
                f"rig cam_from_rig must be {len(self.cameras)} rows of 7 finite "
                f"numbers, got shape {poses.shape}"
            )
        lengths = np.linalg.norm(poses[:, :4], axis=1)
        if np.any(np.abs(lengths - 1.0) > UNIT_TOLERANCE):
            raise InputError(f"rig quaternions must be unit, got lengths {lengths}")
        if not np.array_equal(poses[0], IDENTITY):
            raise InputError(
                "the first camera is the reference of the rig: its cam_from_rig must "
                f"be the identity, got {poses[0]}"
            )
        baseline = float(np.linalg.norm(poses[1, 4:]))
        # A guard against a silent change of scale, not against rounding.
        if abs(baseline - self.baseline_m) > UNIT_TOLERANCE * self.baseline_m:
            raise InputError(
                f"rig baseline_m is {self.baseline_m}, but the second camera's "
                f"cam_from_rig has a translation of {baseline} m"
            )
        poses.setflags(write=False)
        return poses

    def refractive_cameras(self) -> tuple[RefractiveCamera, ...]:
        """Each camera with its port, in the order of `cameras`."""
        from uwsfm.models.refractive import RefractiveCamera

        return tuple(RefractiveCamera(c.camera, c.port) for c in self.cameras)

    def with_geometry(self, cam_from_rig: ArrayLike, ports: Sequence[FlatPort]) -> Rig:
        """This rig with new poses (C, 7) and ports (C); the baseline follows."""
        poses = np.asarray(cam_from_rig, dtype=np.float64)
        pairs = zip(self.cameras, ports, strict=True)
        return replace(
            self,
            cameras=tuple(replace(camera, port=port) for camera, port in pairs),
            cam_from_rig=poses,
            baseline_m=float(np.linalg.norm(poses[1, 4:])),
        )
