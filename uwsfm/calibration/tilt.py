"""Port tilts as Sedlazeck & Koch print them: azimuth and tilt of the normal.

n = (sin theta cos phi, sin theta sin phi, cos theta) in the camera frame.
"""

import math
from dataclasses import dataclass

import numpy as np

from uwsfm.calibration.problem import CalibrationResult
from uwsfm.geometry import unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import FlatPort
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
    assert isinstance(port, FlatPort)
    x, y, z = port.normal
    sine = math.hypot(x, y)
    azimuth = math.atan2(y, x)
    outwards = np.array([z * math.cos(azimuth), z * math.sin(azimuth), -sine])
    around = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    basis = unit_vector.tangent_basis(port.normal)
    angles = np.stack([around, outwards]) @ basis  # (2, 2) by the normal's tangents
    angles[0] /= max(sine, 1e-12)
    own, in_all = _blocks(calibration, camera)
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


def slope_stddevs_deg(
    calibration: CalibrationResult, camera: int
) -> tuple[list[float | None], list[float | None]]:
    """Standard deviations of asin(n_x) and asin(n_y), degrees: from the images, and in
    all. Together they make the angle of `CameraCovariance.normal_stddev_deg`, of which
    each alone is about 1 / sqrt(2). None: held, or not determined.

    Args:
        calibration: with its covariance.
        camera: index of a camera behind a flat port.
    """
    port = calibration.scene.ports[camera]
    assert isinstance(port, FlatPort)
    level = np.sqrt(1.0 - np.square(port.normal[:2]))
    slopes = unit_vector.tangent_basis(port.normal)[:2] / level[:, None]
    own, in_all = (
        [_degrees(slope @ block @ slope) for slope in slopes]
        for block in _blocks(calibration, camera)
    )
    return own, in_all


def _blocks(calibration: CalibrationResult, camera: int) -> tuple[Array, Array]:
    """(2, 2) of the normal's tangents, from the images and in all."""
    covariance = calibration.covariance
    columns = covariance.border_cols[camera, border.NORMAL]
    own = np.zeros((2, 2))
    if columns[0] != HELD:
        own = covariance.border[np.ix_(columns, columns)].copy()
        # Errors that neighbours share make the angle's deviation larger than these.
        angle = np.radians(covariance.cameras[camera].normal_stddev_deg)
        own *= angle**2 / np.trace(own)
    total = own
    if covariance.in_all is not None:
        rows = camera * border.BORDER_SIZE + np.r_[border.NORMAL]
        total = own + covariance.in_all.given[np.ix_(rows, rows)]
    return own, total


def _degrees(variance: float) -> float | None:
    """None of what is held or not determined; an azimuth has half a turn at most."""
    if not variance > 0.0 or not math.isfinite(variance):
        return None
    return min(math.degrees(math.sqrt(variance)), 180.0)
