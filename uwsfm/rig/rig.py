"""The camera rig that a reconstruction works on: lenses in air, ports, placement."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY, Array
from uwsfm.rig.values import IMPLAUSIBLE_ALLOWED, UNIT_TOLERANCE

if TYPE_CHECKING:  # heavy: importing a rig must not load pycolmap or numba
    import pycolmap

    from uwsfm.calibration.given_accuracy import GivenAccuracy, GivenCamera
    from uwsfm.models.ports.port import Port
    from uwsfm.models.radial_undistortion import LensConversion
    from uwsfm.models.refractive import RefractiveCamera

# A rectilinear lens this short would see 157 degrees: a length in millimetres.
_MIN_FOCAL_PER_SIDE = 0.1


def refine_flags(names: Iterable[str]) -> dict[str, Any]:
    """The fields of a `RigCamera` that say what the images refine of its port.

    Args:
        names: of its port's ``refinable`` numbers; all others are held.
    """
    chosen = set(names)
    return {
        f"refine_{name}": name in chosen for name in ("normal", "distance", "center")
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class RigCamera:
    """One camera of a rig, behind its own port."""

    name: str
    images: str
    """Sub-folder of the image directory, with forward slashes."""
    camera: pycolmap.Camera
    """Intrinsics in air, with width and height; pixel origin as COLMAP."""
    port: Port
    """In the camera frame; the initial value of whatever is refined."""
    refine_normal: bool = False
    """Of a plane; so the next."""
    refine_distance: bool = False
    refine_center: bool = False
    """Of a dome."""
    valid_radius_px: float | None = None
    """How far from the principal point the calibration in air reached; features beyond
    it do not take part. None: the whole image."""
    conversion_max_px: float | None = None
    """Greatest error of ``camera`` as a stand-in for a lens that COLMAP has no model
    of. None: nothing was converted."""
    conversion_rms_px: float | None = None
    accuracy: CameraAccuracy = CameraAccuracy()
    """How well the numbers above are known."""

    def covers(self, xy: Array) -> NDArray[np.bool_]:
        """Mask (N,) of the pixels (N, 2) that the calibration in air reached."""
        if self.valid_radius_px is None:
            return np.ones(len(xy), dtype=bool)
        center = (self.camera.principal_point_x, self.camera.principal_point_y)
        radius = np.linalg.norm(np.asarray(xy) - center, axis=1)
        return radius <= self.valid_radius_px


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras fixed to each other; the first one is the reference.

    Raises:
        InputError: no camera, a name or folder used twice, or poses and baseline that
            contradict each other.
    """

    cameras: tuple[RigCamera, ...]
    cam_from_rig: Array | None
    """(C, 7) poses, row 0 the identity; None if only the baseline length is known."""
    baseline_m: float | None
    """Length of the second camera's translation, which gives the scale; None: there is
    one camera only."""
    baseline_stddev_m: float = 0.0
    """Standard deviation of the baseline; 0 holds it exactly."""
    refine_cam_from_rig: bool = True
    """Whether the images may turn the cameras against each other; False trusts the
    placement given, which must then be known."""
    accuracy: RigAccuracy = field(default_factory=RigAccuracy)
    """How well the shared numbers are known."""
    verdict: str = "fits"
    """On the result that it is the estimate of; see `uwsfm.trust.verdict`."""

    def __post_init__(self) -> None:
        self._check_cameras()
        self._check_baseline()
        if len(self.cameras) == 1:
            object.__setattr__(self, "cam_from_rig", IDENTITY[None])
        elif self.cam_from_rig is not None:
            object.__setattr__(self, "cam_from_rig", self._checked_poses())
        elif len(self.cameras) != 2:
            raise InputError(
                "cameras: a baseline length alone describes a rig of two cameras, "
                f"this one has {len(self.cameras)}"
            )
        elif not self.refine_cam_from_rig:
            raise InputError(
                "refine_cam_from_rig: a baseline length alone has to be refined; give "
                "cam_from_rig to hold it"
            )

    def _check_baseline(self) -> None:
        baseline, stddev = self.baseline_m, self.baseline_stddev_m
        if len(self.cameras) == 1:
            if baseline is not None or stddev != 0.0:
                raise InputError(
                    "baseline_m and baseline_stddev_m are of rigs of two cameras or "
                    "more, this one has a single camera"
                )
            return
        if baseline is None or not 0.0 < baseline < np.inf:
            raise InputError(f"baseline_m: {baseline} m gives no scale")
        if not 0.0 <= stddev <= baseline:
            raise InputError(
                f"baseline_stddev_m: {stddev:g} m should lie between 0 "
                f"and the baseline, {baseline:g} m"
            )
        accuracy = self.accuracy.baseline_m
        if accuracy is not None and stddev > 0.0:
            raise InputError(
                "baseline_stddev_m and accuracy.baseline_m are both given: use "
                "baseline_stddev_m for a baseline that the images may correct, "
                "accuracy.baseline_m for one that is held, and leave the other out"
            )
        if accuracy is not None and not accuracy < baseline:
            raise InputError(
                f"accuracy.baseline_m: {accuracy:g} m should be less than the "
                f"baseline, {baseline:g} m"
            )

    def _check_cameras(self) -> None:
        if not self.cameras:
            raise InputError("cameras: at least one is needed, got none")
        for j, camera in enumerate(self.cameras):
            for i, other in enumerate(self.cameras[:j]):
                if camera.name == other.name:
                    raise InputError(
                        f"cameras[{j}].name: {camera.name!r} is also the name of "
                        f"cameras[{i}]"
                    )
                # COLMAP tells cameras apart by the beginning of the image path.
                mine, theirs = f"{camera.images}/", f"{other.images}/"
                if mine.startswith(theirs) or theirs.startswith(mine):
                    raise InputError(
                        f"cameras[{j}].images: {camera.images!r} and the folder of "
                        f"cameras[{i}], {other.images!r}, hold the same images"
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
        if not np.all(np.any(poses[1:, 4:], axis=1)):
            raise InputError("cam_from_rig: a translation of length zero")
        baseline = float(np.linalg.norm(poses[1, 4:]))
        given = self.baseline_m or 0.0
        # A guard against a silent change of scale, not against rounding.
        if abs(baseline - given) > UNIT_TOLERANCE * given:
            raise InputError(
                f"rig baseline_m is {given}, but the second camera's "
                f"cam_from_rig has a translation of {baseline} m"
            )
        poses.setflags(write=False)
        return poses

    def refractive_cameras(self) -> tuple[RefractiveCamera, ...]:
        """Each camera with its port, in the order of `cameras`."""
        from uwsfm.models.refractive import RefractiveCamera

        return tuple(RefractiveCamera(c.camera, c.port) for c in self.cameras)

    def given_accuracy(self) -> GivenAccuracy:
        """The covariance of everything that this rig gives.

        Raises:
            InputError: an accuracy is of something that the rig does not have.
        """
        from uwsfm.calibration.given_accuracy import given_accuracy

        return given_accuracy(self.cameras_as_given(), self.accuracy, self.baseline_m)

    def cameras_as_given(self) -> tuple[GivenCamera, ...]:
        """What the accuracies of each camera's numbers depend on."""
        from uwsfm.calibration.assumed import camera_as_given

        poses = self.cam_from_rig
        return tuple(
            camera_as_given(
                item.name,
                refractive,
                np.zeros(3) if poses is None else poses[c, 4:],
                item.accuracy,
            )
            for c, (item, refractive) in enumerate(
                zip(self.cameras, self.refractive_cameras(), strict=True)
            )
        )

    def with_geometry(self, cam_from_rig: ArrayLike, ports: Sequence[Port]) -> Rig:
        """This rig with new poses (C, 7) and ports (C); the baseline follows."""
        poses = np.asarray(cam_from_rig, dtype=np.float64)
        pairs = zip(self.cameras, ports, strict=True)
        lengths = [float(np.linalg.norm(pose[4:])) for pose in poses]
        return replace(
            self,
            cameras=tuple(replace(camera, port=port) for camera, port in pairs),
            cam_from_rig=poses,
            baseline_m=lengths[1] if len(lengths) > 1 else None,
        )


def lens_models() -> list[str]:
    """COLMAP camera models that can look through a port, by name."""
    import pycolmap

    names = pycolmap.CameraModelId.__members__
    return [n for n in names if n not in ("INVALID", "EQUIRECTANGULAR")]


def camera_from_colmap(
    model: str, width: int, height: int, params: Sequence[float]
) -> pycolmap.Camera:
    """Intrinsics in air by COLMAP model name and parameters (COLMAP pixel origin).

    Raises:
        InputError: an unknown model, a wrong number of parameters, a focal length or
            principal point that cannot belong to an image of this size.
    """
    import pycolmap

    from uwsfm.models.lens import SUPPORTED_MODELS, lens_row

    if model not in lens_models():
        raise InputError(
            f"model {model!r} is not one of COLMAP's for a port; choose from "
            f"{', '.join(SUPPORTED_MODELS)}"
        )
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    names = camera.params_info.split(", ")
    if len(params) != len(names):
        raise InputError(
            f"{model} has {len(names)} params ({camera.params_info}), got {len(params)}"
        )
    for k in camera.focal_length_idxs():
        if params[k] <= 0:
            raise InputError(f"{names[k]} = {params[k]:g}; a focal length is positive")
        if IMPLAUSIBLE_ALLOWED.get():
            continue
        if params[k] < _MIN_FOCAL_PER_SIDE * max(width, height):
            raise InputError(
                f"{names[k]} = {params[k]:g} is not the focal length in pixels of an "
                f"image of {width} x {height}; is it in millimetres?"
            )
    for k, side in zip(camera.principal_point_idxs(), (width, height), strict=True):
        if not 0 <= params[k] <= side and not IMPLAUSIBLE_ALLOWED.get():
            raise InputError(
                f"{names[k]} = {params[k]:g} puts the principal point outside the "
                f"image of {width} x {height}"
            )
    if model in SUPPORTED_MODELS:
        lens_row(model, params)  # distortion that no such lens has is refused
    camera.has_prior_focal_length = True
    return camera


def camera_from_opencv(
    width: int,
    height: int,
    camera_matrix: ArrayLike,
    distortion: ArrayLike,
    *,
    fisheye: bool,
    pixel_origin: Literal["opencv", "colmap"],
) -> pycolmap.Camera:
    """Intrinsics in air from OpenCV's calibrateCamera or fisheye.calibrate.

    Args:
        width: Of the image, pixels.
        height: Of the image, pixels.
        camera_matrix: (3, 3), pixels.
        distortion: 0, 4, 5 or 8 values k1, k2, p1, p2, k3, k4, k5, k6; if ``fisheye``,
            4 values k1, k2, k3, k4.
        fisheye: The calibration is one of ``cv2.fisheye``.
        pixel_origin: Where the centre of the first pixel lies: "opencv" at (0, 0),
            "colmap" at (0.5, 0.5).

    Raises:
        InputError: not a camera matrix, skew, a wrong number of distortion values, or
            as `camera_from_colmap`.
    """
    pinhole = _pinhole_params(camera_matrix, pixel_origin)
    allowed = (4,) if fisheye else (0, 4, 5, 8)
    values = np.ravel(distortion).tolist()
    if len(values) not in allowed:
        raise InputError(
            f"distortion of {'a fisheye' if fisheye else 'an OpenCV'} calibration has "
            f"{'4' if fisheye else '0, 4, 5 or 8'} values, got {len(values)}"
        )
    if fisheye:
        model = "OPENCV_FISHEYE"
    elif not values:
        model = "PINHOLE"
    elif any(values[4:]):
        model, values = "FULL_OPENCV", [*values, 0.0, 0.0, 0.0][:8]
    else:
        model, values = "OPENCV", values[:4]
    return camera_from_colmap(model, width, height, [*pinhole, *values])


def camera_from_radial_undistortion(
    width: int,
    height: int,
    camera_matrix: ArrayLike,
    undistortion: Sequence[float],
    *,
    pixel_origin: Literal["opencv", "colmap"],
) -> tuple[pycolmap.Camera, LensConversion]:
    """Intrinsics in air from a polynomial that undistorts, and the conversion's error.

    Args:
        width: Of the image, pixels.
        height: Of the image, pixels.
        camera_matrix: (3, 3), pixels.
        undistortion: 1 to 3 values, see `uwsfm.models.radial_undistortion`.
        pixel_origin: As of `camera_from_opencv`.

    Raises:
        InputError: not a camera matrix, skew, or as the functions used here.
    """
    from uwsfm.models.radial_undistortion import convert_radial_undistortion

    pinhole = _pinhole_params(camera_matrix, pixel_origin)
    camera_from_colmap("PINHOLE", width, height, pinhole)  # refuses implausible ones
    found = convert_radial_undistortion(width, height, pinhole, undistortion)
    return camera_from_colmap(found.model, width, height, found.params), found


def _pinhole_params(camera_matrix: ArrayLike, pixel_origin: str) -> list[float]:
    """fx, fy, cx, cy with COLMAP's pixel origin."""
    (fx, skew, cx), (zero, fy, cy), last = np.asarray(camera_matrix, float).tolist()
    if skew != 0:
        raise InputError(
            f"camera_matrix has a skew of {skew:g}, which COLMAP's lens models lack; "
            "calibrate without skew"
        )
    if zero != 0 or last != [0, 0, 1]:
        raise InputError("camera_matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    shift = 0.5 if pixel_origin == "opencv" else 0.0  # OpenCV -> COLMAP pixel origin
    return [fx, fy, cx + shift, cy + shift]
