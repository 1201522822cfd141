"""Cameras with a free lens, fitted to the same observations, frames and points held."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import param_slots
from uwsfm.models.lens_row import CENTER, DISTORTION, FOCAL
from uwsfm.models.ports.port import NoPort, PlanePort, Port
from uwsfm.models.refractive import RefractiveCamera

_LEAST_MODEL = "OPENCV"
"""Two focal lengths, principal point, two radial and two tangential coefficients."""
_LARGER_MODELS = {
    "FULL_OPENCV": "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
    "THIN_PRISM_FISHEYE": "THIN_PRISM_FISHEYE",
    "FOV": "FOV",
    "EUCM": "EUCM",
}
"""Models whose parameters mean something else, or are more."""
_WITHOUT_ZERO = ("FOV", "EUCM")
"""Without distortion they are no lens, or none of the kind."""
_MAX_FITTED = 8_000
"""Observations that the fit takes: 14 to 18 numbers need no more."""


@dataclass(frozen=True, kw_only=True)
class FittedCamera:
    """A camera fitted to the observations of another, points and frames held."""

    camera: RefractiveCamera
    fitted_from_cam: Array
    """Pose (7,) of the fitted camera in the frame of the other."""

    def residuals(self, points_in_cam: Array, xy: Array) -> Array:
        """Projection minus observation (N, 2) px; NaN where there is none."""
        in_fitted = rigid3.transform(self.fitted_from_cam, points_in_cam)
        return self.camera.img_from_point(in_fitted)[0] - xy


def fit_central(
    camera: RefractiveCamera, points_in_cam: Array, xy: Array
) -> FittedCamera | None:
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
    if not camera.port.refracts:
        return None
    lens, model = camera.lens.copy(), camera.camera.model_name
    if isinstance(camera.port, PlanePort):
        lens[FOCAL] *= camera.port.n_water
        lens[DISTORTION] = 0.0  # of other angles: what it is in water is fitted
        model = _LEAST_MODEL if model in _WITHOUT_ZERO else model
    base = _with_distortion(camera, lens, NoPort(), model)
    return _fitted(base, points_in_cam, xy)


def fit_lens(
    camera: RefractiveCamera, points_in_cam: Array, xy: Array
) -> FittedCamera | None:
    """The same with the port as it is: as free as `fit_central`, rays that bend."""
    model = camera.camera.model_name
    base = _with_distortion(camera, camera.lens, camera.port, model)
    return _fitted(base, points_in_cam, xy)


def _fitted(
    base: RefractiveCamera, points_in_cam: Array, xy: Array
) -> FittedCamera | None:
    from scipy.optimize import least_squares  # heavy

    slots = list(param_slots(base.camera.model_name))
    rows = np.linspace(0, len(xy) - 1, min(len(xy), _MAX_FITTED)).astype(np.int64)
    if 2 * len(rows) <= len(slots) + 6:
        return None
    points, pixels = points_in_cam[rows], xy[rows]
    depth = float(np.median(points[:, 2]))
    scale = np.array([1.0, 1.0, 1.0, depth, depth, depth])

    def fit_at(unknowns: Array) -> FittedCamera:
        row, unknown = base.lens.copy(), unknowns[6:]
        row[FOCAL] *= np.exp(unknown[:2])
        row[CENTER] += row[FOCAL] * unknown[2:4]
        row[slots[4:]] += unknown[4:]
        pose = rigid3.perturb(rigid3.IDENTITY, scale * unknowns[:6])
        return FittedCamera(camera=base.with_lens(row), fitted_from_cam=pose)

    def residuals(unknowns: Array) -> Array:
        found = fit_at(unknowns).residuals(points, pixels)
        # Beyond a lens's limit nothing projects: far worse than any error that does.
        return np.nan_to_num(found, nan=1e3).ravel()

    # MINPACK: the SVDs of "trf" take five times as long.
    found = least_squares(residuals, np.zeros(6 + len(slots)), method="lm")
    return fit_at(found.x)


def _with_distortion(
    camera: RefractiveCamera, lens: Array, port: Port, model: str
) -> RefractiveCamera:
    """A lens row of a model behind a port, as one that has all usual distortion."""
    model = _LARGER_MODELS.get(model, _LEAST_MODEL)
    larger = pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=lens[list(param_slots(model))],
    )
    return RefractiveCamera(larger, port)
