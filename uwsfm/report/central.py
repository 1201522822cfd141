"""What the best pinhole leaves of the same observations, poses and points."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import NUM_PARAMS, param_slots
from uwsfm.models.port import FlatPort, NoPort
from uwsfm.models.refractive import RefractiveCamera

_LEAST_MODEL = "OPENCV"
"""Two focal lengths, principal point, two radial and two tangential coefficients."""
_LARGER_MODELS = frozenset({"FULL_OPENCV", "OPENCV_FISHEYE"})
_MAX_FITTED = 8_000
"""Observations that the fit takes: 14 to 18 numbers need no more."""


@dataclass(frozen=True, kw_only=True)
class CentralFit:
    """A camera without a port, fitted to what one behind its port has observed."""

    camera: RefractiveCamera
    pinhole_from_cam: Array
    """Pose (7,): where the one centre of all rays came to lie."""

    def residuals(self, points_in_cam: Array, xy: Array) -> Array:
        """Projection minus observation (N, 2) px; NaN where there is none."""
        in_pinhole = rigid3.transform(self.pinhole_from_cam, points_in_cam)
        return self.camera.img_from_point(in_pinhole)[0] - xy


def fit_central(
    camera: RefractiveCamera, points_in_cam: Array, xy: Array
) -> CentralFit | None:
    """The pinhole with distortion that fits best, in least squares.

    Free are its position and rotation, both focal lengths, the principal point and the
    distortion: all that a program which knows no port can calibrate in the water. The
    points are held.

    Args:
        camera: Lens and port.
        points_in_cam: (N, 3) the observed points in its frame, metres.
        xy: (N, 2) the observations.

    Returns:
        None: there is no port, or not enough to fit to.
    """
    from scipy.optimize import least_squares  # heavy

    base = _start(camera)
    slots = list(param_slots(base.camera.model_name))
    rows = np.linspace(0, len(xy) - 1, min(len(xy), _MAX_FITTED)).astype(np.int64)
    if isinstance(camera.port, NoPort) or 2 * len(rows) <= len(slots) + 6:
        return None
    points, pixels = points_in_cam[rows], xy[rows]
    depth = float(np.median(points[:, 2]))
    scale = np.array([1.0, 1.0, 1.0, depth, depth, depth])

    def fit_at(unknowns: Array) -> CentralFit:
        row, lens = base.lens.copy(), unknowns[6:]
        row[:2] *= np.exp(lens[:2])
        row[2:4] += row[:2] * lens[2:4]
        row[slots[4:]] += lens[4:]
        pose = rigid3.perturb(rigid3.IDENTITY, scale * unknowns[:6])
        return CentralFit(camera=base.with_lens(row), pinhole_from_cam=pose)

    def residuals(unknowns: Array) -> Array:
        found = fit_at(unknowns).residuals(points, pixels)
        # Beyond a lens's limit nothing projects: far worse than any error that does.
        return np.nan_to_num(found, nan=1e3).ravel()

    # MINPACK: the SVDs of "trf" take five times as long.
    found = least_squares(residuals, np.zeros(6 + len(slots)), method="lm")
    return fit_at(found.x)


def _start(camera: RefractiveCamera) -> RefractiveCamera:
    """The lens without its port, magnified as the water does, with all distortion."""
    model = camera.camera.model_name
    if model not in _LARGER_MODELS:
        model = _LEAST_MODEL
    row = camera.lens.copy()
    if isinstance(camera.port, FlatPort):
        row[:2] *= camera.port.n_water
        row[4:NUM_PARAMS] = 0.0  # of other angles: what it is in water is fitted
    lens = pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=row[list(param_slots(model))],
    )
    return RefractiveCamera(lens, NoPort())
