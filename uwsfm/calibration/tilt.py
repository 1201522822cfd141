"""Angles of ports and cameras, each with its own standard deviation.

Port tilts are printed as Sedlazeck & Koch do: azimuth and tilt of the normal,
n = (sin theta cos phi, sin theta sin phi, cos theta) in the camera frame.
"""

import math
from dataclasses import dataclass

import numpy as np

from uwsfm.calibration.result import CalibrationResult
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort
from uwsfm.residuals import border
from uwsfm.solver.layout import HELD


@dataclass(frozen=True, kw_only=True)
class PaperTilt:
    """Angles of one port; a standard deviation is None if there is none."""

    azimuth_deg: float
    """phi, in (-180, 180]."""
    tilt_deg: float
    """theta, from the optical axis."""
    azimuth_stddev_deg: float | None
    """From the images; it grows without bound as the tilt goes to zero."""
    tilt_stddev_deg: float | None
    azimuth_stddev_in_all_deg: float | None
    tilt_stddev_in_all_deg: float | None


def paper_tilt(calibration: CalibrationResult, camera: int) -> PaperTilt:
    """The tilt of a flat port in the terms of the paper.

    Args:
        calibration: with its covariance.
        camera: index of a camera behind a flat port.
    """
    port = calibration.scene.ports[camera]
    assert isinstance(port, PlanePort)
    x, y, z = port.normal
    sine = math.hypot(x, y)
    azimuth = math.atan2(y, x)
    outwards = np.array([z * math.cos(azimuth), z * math.sin(azimuth), -sine])
    around = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    basis = unit_vector.tangent_basis(port.normal)
    angles = np.stack([around, outwards]) @ basis  # (2, 2) by the normal's tangents
    angles[0] /= max(sine, 1e-12)
    own, in_all = _normal_blocks(calibration, camera)
    images = [_degrees(a @ own @ a) for a in angles]
    total = [_degrees(a @ in_all @ a) for a in angles]
    return PaperTilt(
        azimuth_deg=math.degrees(azimuth),
        tilt_deg=math.degrees(math.atan2(sine, z)),
        azimuth_stddev_deg=images[0],
        tilt_stddev_deg=images[1],
        azimuth_stddev_in_all_deg=total[0],
        tilt_stddev_in_all_deg=total[1],
    )


_Stddevs = tuple[list[float | None], list[float | None]]
"""From the images, and in all."""


def slope_stddevs_deg(calibration: CalibrationResult, camera: int) -> _Stddevs:
    """Standard deviations of asin(n_x) and asin(n_y), degrees: from the images, and in
    all. Together they make the angle of `CameraCovariance.normal_stddev_deg`, of which
    each alone is about 1 / sqrt(2). None: held, or not determined.

    Args:
        calibration: with its covariance.
        camera: index of a camera behind a flat port.
    """
    port = calibration.scene.ports[camera]
    assert isinstance(port, PlanePort)
    level = np.sqrt(1.0 - np.square(port.normal[:2]))
    slopes = unit_vector.tangent_basis(port.normal)[:2] / level[:, None]
    return _stddevs(slopes, _normal_blocks(calibration, camera))


def turn_stddevs_deg(calibration: CalibrationResult, camera: int) -> _Stddevs:
    """Standard deviations of cam_from_rig's rotation vector, x, y, z, degrees: from the
    images, and in all. Together they make the angle of
    `CameraCovariance.rotation_stddev_deg`. None: held, or not determined.

    Args:
        calibration: with its covariance.
        camera: index of a camera.
    """
    angle = calibration.covariance.cameras[camera].rotation_stddev_deg
    blocks = _blocks(calibration, camera, border.ROTATION, angle)
    turn = rigid3.rotvec_from_quat(calibration.scene.cam_from_rig[camera, :4])
    return _stddevs(rigid3.rotvec_by_turn(turn), blocks)


def _stddevs(jacobian: Array, blocks: tuple[Array, Array]) -> _Stddevs:
    own, in_all = (
        [_degrees(row @ block @ row) for row in jacobian] for block in blocks
    )
    return own, in_all


def _normal_blocks(calibration: CalibrationResult, camera: int) -> tuple[Array, Array]:
    """(2, 2) of the normal's tangents, from the images and in all."""
    angle = calibration.covariance.cameras[camera].normal_stddev_deg
    return _blocks(calibration, camera, border.NORMAL, angle)


def _blocks(
    calibration: CalibrationResult, camera: int, slot: slice, angle_deg: float
) -> tuple[Array, Array]:
    """Covariances of an angle's tangents, from the images and in all.

    Args:
        calibration: with its covariance.
        camera: index of a camera.
        slot: of the tangents in the camera's row of the border.
        angle_deg: their root sum of squares as it is printed, from the images: errors
            that neighbours share make it larger than that of the border.
    """
    covariance = calibration.covariance
    columns = covariance.border_cols[camera, slot]
    own = np.zeros((len(columns), len(columns)))
    if columns[0] != HELD:
        own = covariance.border[np.ix_(columns, columns)].copy()
        own *= np.radians(angle_deg) ** 2 / np.trace(own)
    total = own
    if covariance.in_all is not None:
        rows = camera * border.BORDER_SIZE + np.r_[slot]
        total = own + covariance.in_all.given[np.ix_(rows, rows)]
    return own, total


def _degrees(variance: float) -> float | None:
    """None of what is held or not determined; an azimuth has half a turn at most."""
    if not variance > 0.0 or not math.isfinite(variance):
        return None
    return min(math.degrees(math.sqrt(variance)), 180.0)
