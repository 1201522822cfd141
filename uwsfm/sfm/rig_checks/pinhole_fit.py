"""The ideal pinhole camera that a refractive one resembles at the scene's distance.

COLMAP's mapper knows central cameras only. Instead of fitting distortion coefficients
to lens and port, every pixel is moved to where an ideal pinhole would see its water ray
at the median depth of the scene: exact there for every lens model, and wrong elsewhere
only by what one centre cannot explain, which `VirtualPinhole.rms_px` reports. (Measured
on a tank rig: OPENCV leaves 0.23-0.37 px RMS and up to 2.8 px at the best distance,
FULL_OPENCV 0.06 and 0.3 px, and its inverse fails near the corners.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

GRID_STEPS = 24
MAX_SLOPE = 3.73
"""Against the optical axis, 75 degrees: beyond it no pinhole image is of use."""


@dataclass(frozen=True, kw_only=True)
class VirtualPinhole:
    """A pinhole camera in water, with the axes of the real camera.

    Virtual pixels are about as large as true ones: the focal length is that in air,
    behind a flat port times the index of water.
    """

    center_in_cam: Array
    """(3,) the virtual centre in the frame of the real camera, metres."""
    depth: float
    """Where it is exact, metres along the optical axis; inf: for directions alone."""
    focal_px: float
    principal_point: tuple[float, float]
    width: int
    height: int
    """The virtual image holds all of the real one, whose borders bulge, up to 75
    degrees from the optical axis."""
    rms_px: float
    """Error at the 10th and 90th percentile of depth."""
    max_px: float

    @property
    def virtual_from_cam(self) -> Array:
        """Pose (7,), a pure translation."""
        return np.concatenate([[0.0, 0.0, 0.0, 1.0], -self.center_in_cam])

    def camera(self) -> pycolmap.Camera:
        """As a COLMAP camera (PINHOLE) that is never to be refined."""
        focal, (cx, cy) = self.focal_px, self.principal_point
        camera = pycolmap.Camera(
            model="PINHOLE",
            width=self.width,
            height=self.height,
            params=[focal, focal, cx, cy],
        )
        camera.has_prior_focal_length = True
        return camera

    def img_from_real_img(self, camera: RefractiveCamera, xy: ArrayLike) -> Array:
        """Virtual pixels (N, 2) of real ones (N, 2); NaN where there is no ray."""
        tangents = _tangents(camera, xy, self.center_in_cam, self.depth)
        return self.focal_px * tangents + self.principal_point


def fit_virtual_pinhole(
    camera: RefractiveCamera, depths: ArrayLike | None
) -> VirtualPinhole:
    """The pinhole for a scene at the given depths.

    Its centre is the point nearest to all water rays of the image (least squares),
    which is also where the same pixel sees the same direction at all depths.

    Args:
        camera: Lens and port.
        depths: (3,) 10th, 50th and 90th percentile, metres; None if unknown: then the
            directions of the rays are taken, as for a scene far away.
    """
    xy = _pixel_grid(camera)
    origins, dirs = camera.ray_from_img(xy)
    within = np.linalg.norm(dirs[:, :2], axis=1) < MAX_SLOPE * dirs[:, 2]
    xy, origins, dirs = xy[within], origins[within], dirs[within]
    center = triangulate_tracks(origins, dirs, np.zeros(len(xy), dtype=np.int64), 1)[0]
    near, depth, far = (np.inf,) * 3 if depths is None else np.asarray(depths, float)
    magnification = camera.port.n_water if camera.port.magnifies else 1.0
    focal = float(magnification * np.mean(_focal_lengths(camera)))
    image = focal * _tangents(camera, xy, center, depth)
    low, high = np.nanmin(image, axis=0), np.nanmax(image, axis=0)
    errors = [
        focal * _tangents(camera, xy, center, other) - image for other in (near, far)
    ]
    error_px = np.linalg.norm(np.concatenate(errors), axis=1)
    size = np.ceil(high - low)
    return VirtualPinhole(
        center_in_cam=center,
        depth=float(depth),
        focal_px=focal,
        principal_point=(float(-low[0]), float(-low[1])),
        width=int(size[0]),
        height=int(size[1]),
        rms_px=float(np.sqrt(np.nanmean(error_px**2))),
        max_px=float(np.nanmax(error_px)),
    )


def _pixel_grid(camera: RefractiveCamera) -> Array:
    """Pixels (N, 2) all over the image, its borders included."""
    x, y = np.meshgrid(
        np.linspace(0.0, camera.width, GRID_STEPS),
        np.linspace(0.0, camera.height, GRID_STEPS),
    )
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _tangents(
    camera: RefractiveCamera, xy: ArrayLike, center: Array, depth: float
) -> Array:
    """x/z, y/z (N, 2), seen from ``center``, of the water rays at a depth."""
    origins, dirs = camera.ray_from_img(xy)
    if np.isfinite(depth):
        ranges = (depth - origins[:, 2:]) / dirs[:, 2:]
        dirs = origins + ranges * dirs - center
    return dirs[:, :2] / dirs[:, 2:]


def _focal_lengths(camera: RefractiveCamera) -> Array:
    """Of the lens in air, pixels (1 or 2)."""
    params = np.asarray(camera.camera.params, dtype=np.float64)
    return params[camera.camera.focal_length_idxs()]  # type: ignore[attr-defined]
