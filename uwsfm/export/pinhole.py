"""A refractive model as a central one: what stock dense and rendering tools take.

Every camera becomes the pinhole that resembles it best at the distance of its scene
(`uwsfm.sfm.rig_checks.pinhole_fit`), poses move to the virtual centres and every
keypoint to where that pinhole would see it without refraction *at its own depth*.
Points stay as they are. A keypoint's depth is that of its point, else it is
interpolated between the points of its image (`ImageDepth`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.colmap.model import Model
from uwsfm.errors import InputError
from uwsfm.export.image_depth import ImageDepth
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.pinhole.mapping_database import virtual_rig
from uwsfm.sfm.rig_checks.pinhole_fit import (
    MAX_SLOPE,
    VirtualPinhole,
    fit_virtual_pinhole,
)

# Depth is a function of the virtual pixel, which depends on it: a contraction by what
# the pixel moves per change of depth, well below 0.1 even for a port at 0.1 m.
_ITERATIONS = 3
_FOLDS = 5


@dataclass(frozen=True, kw_only=True)
class ImageError:
    """How far off the pinhole a warped image is, at the points seen in it, pixels.

    A point's depth is interpolated from the image's other points: a fifth of them in
    turn is left out. The errors are of exact projections, without feature noise.
    """

    name: str
    num_points: int
    num_extrapolated: int
    """Points that the others do not surround; their errors count as well."""
    rms_px: float
    """NaN without points, as `max_px`."""
    max_px: float
    constant_rms_px: float
    """Of the same pinhole with one depth for all images of a camera."""
    constant_max_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeModel:
    """A central model, and what it takes to warp the images to it."""

    model: Model
    """Pinholes without ports; observations and keypoints are virtual pixels."""
    pinholes: tuple[VirtualPinhole, ...]
    """(C,)"""
    depths: tuple[tuple[ImageDepth, ...], ...]
    """[camera][frame], over virtual pixels, depth from the virtual centre."""
    errors: tuple[ImageError, ...]
    """Cameras first, then frames."""
    refractive_error_px: float
    """Mean reprojection error of the refractive model."""
    num_dropped_keypoints: int
    """Keypoints without a ray in the water, or too far from the axis."""
    num_dropped_observations: int
    """The same of observations, and those of points that do not project."""


def pinhole_model(model: Model, *, centered: bool = True) -> PinholeModel:
    """The central model that sees the points of a refractive one.

    Without noise the points project exactly onto their keypoints; with it they keep
    their residuals.

    Args:
        model: the refractive one.
        centered: the principal points are the middles of the images, which are some
            pixels wider for it: many trainers of radiance fields take it for granted.

    Raises:
        InputError: a camera has seen no point.
    """
    scene, counted = _usable(model)
    in_cam = scene.points_in_cam()
    pinholes = tuple(
        _fit(model, camera, in_cam[scene.camera_idx == index, 2], centered)
        for index, camera in enumerate(scene.cameras)
    )
    depths: list[tuple[ImageDepth, ...]] = []
    keypoints: list[tuple[Array, ...]] = []
    kept_idx = np.zeros(scene.num_observations, dtype=np.int64)
    errors, num_dropped = [], 0
    for c, (camera, pinhole) in enumerate(zip(scene.cameras, pinholes, strict=True)):
        of_camera, keypoints_of_camera = [], []
        for f in range(scene.num_frames):
            rows = np.flatnonzero((scene.camera_idx == c) & (scene.frame_idx == f))
            seen = _Seen(camera, pinhole, in_cam[rows])
            depth = seen.depth()
            all_xy = _moved(seen, depth, model.keypoints[c][f], counted.idx[rows])
            finite = np.isfinite(all_xy).all(axis=1)
            kept_idx[rows] = (np.cumsum(finite) - 1)[counted.idx[rows]]
            num_dropped += int(np.count_nonzero(~finite))
            of_camera.append(depth)
            keypoints_of_camera.append(all_xy[finite])
            if model.has_image(c, f):
                errors.append(_image_error(model.image_name(c, f), seen))
        depths.append(tuple(of_camera))
        keypoints.append(tuple(keypoints_of_camera))
    virtual = _virtual_scene(scene, pinholes, keypoints, kept_idx)
    return PinholeModel(
        model=replace(
            model,
            rig=_virtual_rig_of(model.rig, pinholes, virtual),
            scene=virtual,
            keypoints=tuple(keypoints),
            keypoint_idx=kept_idx,
            colors=model.colors[counted.points],
        ),
        pinholes=pinholes,
        depths=tuple(depths),
        errors=tuple(errors),
        refractive_error_px=float(np.mean(counted.errors_px)),
        num_dropped_keypoints=num_dropped,
        num_dropped_observations=counted.num_dropped,
    )


def virtual_from_img(
    camera: RefractiveCamera, pinhole: VirtualPinhole, xy: ArrayLike, depth: ImageDepth
) -> Array:
    """Virtual pixels (N, 2) of real ones (N, 2), at the depths of their image.

    NaN where there is no ray.
    """
    rays = _Rays(camera, pinhole, xy)
    found = rays.img_at(np.full(len(rays), 1.0 / _depth_of(pinhole)))
    for _ in range(_ITERATIONS):
        found = rays.img_at(depth.inverse(found))
    return found


def img_from_virtual(
    camera: RefractiveCamera, pinhole: VirtualPinhole, xy: ArrayLike, depth: ImageDepth
) -> tuple[Array, NDArray[np.bool_]]:
    """Real pixels (N, 2) of virtual ones (N, 2): exact projections of their points.

    Returns:
        Pixels, NaN where not ``valid``, and the mask ``valid`` (N,).
    """
    pixels = np.asarray(xy, dtype=np.float64)
    tangents = (pixels - pinhole.principal_point) / pinhole.focal_px
    points = np.column_stack([tangents, np.ones(len(pixels))])
    points /= depth.inverse(pixels)[:, None]
    return camera.img_from_point(points + pinhole.center_in_cam)


class _Rays:
    """Water rays of pixels in the frame of the virtual camera."""

    def __init__(
        self, camera: RefractiveCamera, pinhole: VirtualPinhole, xy: ArrayLike
    ) -> None:
        origins, self._dirs = camera.ray_from_img(xy)
        self._origins = origins - pinhole.center_in_cam
        self._pinhole = pinhole

    def __len__(self) -> int:
        return len(self._dirs)

    def img_at(self, inverse_depth: Array) -> Array:
        """Virtual pixels (N, 2) of the rays' points at inverse depths (N,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = (1.0 / inverse_depth - self._origins[:, 2]) / self._dirs[:, 2]
        return self._img_along(ranges)

    def img_beside(self, points: Array) -> Array:
        """Virtual pixels (N, 2) of the rays' points nearest to ``points`` (N, 3)."""
        ranges = np.sum((points - self._origins) * self._dirs, axis=1)
        return self._img_along(ranges)

    def _img_along(self, ranges: Array) -> Array:
        points = self._origins + ranges[:, None] * self._dirs
        return _project(self._pinhole, points)


class _Seen:
    """The points seen in one image, in the frame of the virtual camera."""

    def __init__(
        self, camera: RefractiveCamera, pinhole: VirtualPinhole, points_in_cam: Array
    ) -> None:
        self.camera, self.pinhole = camera, pinhole
        self.points_in_cam = points_in_cam
        self.points = points_in_cam - pinhole.center_in_cam
        self.xy = _project(pinhole, self.points)

    def depth(self, keep: NDArray[np.bool_] | None = None) -> ImageDepth:
        """Interpolation between the points, or some of them."""
        rows = slice(None) if keep is None else keep
        pinhole = self.pinhole
        return ImageDepth(
            self.xy[rows],
            1.0 / self.points[rows, 2],
            (pinhole.width, pinhole.height),
            1.0 / _depth_of(pinhole),
        )


def _project(pinhole: VirtualPinhole, points: Array) -> Array:
    """Virtual pixels (N, 2) of points (N, 3) in the virtual frame; NaN if outside."""
    slope = np.max(np.abs(points[:, :2]), axis=1, keepdims=True)
    # Observations keep some distance to this limit: their residuals must not cross it.
    z = np.where(points[:, 2:] * MAX_SLOPE > 0.9 * slope, points[:, 2:], np.nan)
    return pinhole.focal_px * points[:, :2] / z + pinhole.principal_point


def _depth_of(pinhole: VirtualPinhole) -> float:
    """Where a virtual pinhole is exact, from its own centre, metres."""
    return pinhole.depth - float(pinhole.center_in_cam[2])


def _fit(
    model: Model, camera: RefractiveCamera, depths: Array, centered: bool
) -> VirtualPinhole:
    if not len(depths):
        index = model.scene.cameras.index(camera)
        name = model.rig.cameras[index].name
        raise InputError(f"camera {name} sees no point: its distance is unknown")
    found = fit_virtual_pinhole(camera, np.percentile(depths, [10, 50, 90]))
    return _centered(found) if centered else found


def _centered(pinhole: VirtualPinhole) -> VirtualPinhole:
    """The same pinhole with an image that reaches equally far on opposite sides."""
    size = (pinhole.width, pinhole.height)
    half = [
        int(np.ceil(max(x, length - x)))
        for x, length in zip(pinhole.principal_point, size, strict=True)
    ]
    return replace(
        pinhole,
        principal_point=(float(half[0]), float(half[1])),
        width=2 * half[0],
        height=2 * half[1],
    )


def _moved(seen: _Seen, depth: ImageDepth, xy: Array, observed: IndexArray) -> Array:
    """All keypoints of an image (n, 2) as virtual pixels."""
    moved = virtual_from_img(seen.camera, seen.pinhole, xy, depth)
    moved[observed] = _Rays(seen.camera, seen.pinhole, xy[observed]).img_beside(
        seen.points
    )
    return moved


def _image_error(name: str, seen: _Seen) -> ImageError:
    count = len(seen.points)
    real, _ = seen.camera.img_from_point(seen.points_in_cam)
    errors = np.full(count, np.nan)
    outside = np.zeros(count, dtype=bool)
    # Features come in twins: what shares a pixel is left out together.
    _, pixel = np.unique(np.floor(seen.xy), axis=0, return_inverse=True)
    for fold in range(_FOLDS):
        left_out = np.ravel(pixel) % _FOLDS == fold
        if not left_out.any():
            continue
        depth = seen.depth(~left_out)
        shown = virtual_from_img(seen.camera, seen.pinhole, real[left_out], depth)
        errors[left_out] = np.linalg.norm(shown - seen.xy[left_out], axis=1)
        outside[left_out] = ~depth.is_between_points(seen.xy[left_out])
    constant = ImageDepth([], [], (0, 0), 1.0 / _depth_of(seen.pinhole))
    alike = virtual_from_img(seen.camera, seen.pinhole, real, constant)
    alike_px = np.linalg.norm(alike - seen.xy, axis=1)
    return ImageError(
        name=name,
        num_points=count,
        num_extrapolated=int(np.count_nonzero(outside)),
        rms_px=rms(errors),
        max_px=float(np.max(errors)) if count else np.nan,
        constant_rms_px=rms(alike_px),
        constant_max_px=float(np.max(alike_px)) if count else np.nan,
    )


def rms(errors: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else np.nan


@dataclass(frozen=True, kw_only=True)
class _Counted:
    """What the usable observations of a model are."""

    idx: IndexArray
    """(N,) keypoints."""
    errors_px: Array
    """(N,)"""
    points: IndexArray
    """(P,) old index of each point."""
    num_dropped: int


def _usable(model: Model) -> tuple[Scene, _Counted]:
    """The observations with an error, which only points in the water have."""
    errors = model.errors_px()
    in_cam = model.scene.points_in_cam()
    slope = np.linalg.norm(in_cam[:, :2], axis=1)
    keep = np.isfinite(errors) & (in_cam[:, 2] * MAX_SLOPE > slope)
    # A ray of a keypoint can be missing where its point still projects.
    for index, camera in enumerate(model.scene.cameras):
        rows = np.flatnonzero(model.scene.camera_idx == index)
        keep[rows] &= np.isfinite(camera.ray_from_img(model.scene.xy[rows])[0][:, 0])
    scene, points = model.scene.select(keep)
    return scene, _Counted(
        idx=model.keypoint_idx[keep],
        errors_px=errors[keep],
        points=points,
        num_dropped=int(np.count_nonzero(~keep)),
    )


def _virtual_scene(
    scene: Scene,
    pinholes: tuple[VirtualPinhole, ...],
    keypoints: list[tuple[Array, ...]],
    keypoint_idx: IndexArray,
) -> Scene:
    places = zip(scene.camera_idx, scene.frame_idx, keypoint_idx, strict=True)
    return Scene.from_arrays(
        cameras=[RefractiveCamera(p.camera(), NoPort()) for p in pinholes],
        cam_from_rig=virtual_rig(scene.cam_from_rig, pinholes),
        rig_from_world=rigid3.compose(
            pinholes[0].virtual_from_cam, scene.rig_from_world
        ),
        points=scene.points,
        camera_idx=scene.camera_idx,
        frame_idx=scene.frame_idx,
        point_idx=scene.point_idx,
        xy=np.array([keypoints[c][f][k] for c, f, k in places]).reshape(-1, 2),
    )


def _virtual_rig_of(
    rig: Rig, pinholes: tuple[VirtualPinhole, ...], scene: Scene
) -> Rig:
    cameras = tuple(
        replace(
            camera,
            camera=pinhole.camera(),
            port=NoPort(),
            refine_normal=False,
            refine_distance=False,
            refine_center=False,
            valid_radius_px=None,
        )
        for camera, pinhole in zip(rig.cameras, pinholes, strict=True)
    )
    return replace(rig, cameras=cameras).with_geometry(scene.cam_from_rig, scene.ports)
