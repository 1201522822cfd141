"""Mistakes that people make, each as a change of what the program is given.

A mistake has the code of the cause that should be named. Its magnitude is drawn from a
random generator, so that the same seed makes the same wrong input.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np
import pycolmap
from dives import Dive, renamed, with_frames_of, with_keypoints_moved
from scipy.optimize import least_squares

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort, FlatPort, NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig, RigCamera, camera_from_colmap
from uwsfm.simulate.rigs import known_cam_from_rig

BOTH, LEFT, RIGHT = (0, 1), (0,), (1,)
Change = Callable[[Dive, np.random.Generator], Dive]


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One kind of wrong input."""

    code: str
    """Of the cause to name; "" where no single cause could be named."""
    name: str
    """What was done, in words."""
    change: Change
    domes: bool = False
    """Made on a dive behind domes."""
    hidden: bool = False
    """No observation shows it, as with a baseline that is too short: all that can be
    asked for is a scale whose ± is that of the baseline."""
    also: frozenset[str] = field(default=frozenset())
    """Causes that no observation can tell from the right one: naming one is right."""

    def applied(self, dive: Dive, trial: int) -> Dive:
        """A dive with the mistake; ``trial`` draws its magnitude.

        Raises:
            InputError: the rig file could not hold such numbers.
        """
        return self.change(dive, self._rng(trial))

    def _rng(self, trial: int) -> np.random.Generator:
        return np.random.default_rng([crc32(self.name.encode()), trial])


# ---- Lenses --------------------------------------------------------------------------


def _with_lenses(
    dive: Dive, cameras: tuple[int, ...], change: Callable[[RigCamera], Array]
) -> Dive:
    """New parameters of some lenses, checked as a rig file's are."""
    items = list(dive.rig.cameras)
    for c in cameras:
        lens = items[c].camera
        params = change(items[c]).tolist()
        new = camera_from_colmap(lens.model_name, lens.width, lens.height, params)
        items[c] = replace(items[c], camera=new)
    return replace(dive, rig=replace(dive.rig, cameras=tuple(items)))


def _scaled_params(*slots: int) -> Callable[[tuple[int, ...], float, float], Change]:
    """Parameters by a factor between 1 + low and 1 + high, or below one as much."""

    def make(cameras: tuple[int, ...], low: float, high: float) -> Change:
        def change(dive: Dive, rng: np.random.Generator) -> Dive:
            factor = 1.0 + _signed(rng, low, high)

            def params(item: RigCamera) -> Array:
                values = item.camera.params.copy()
                values[list(slots)] *= factor
                return values

            return _with_lenses(dive, cameras, params)

        return change

    return make


def _moved_params(*slots: int) -> Callable[[tuple[int, ...], float, float], Change]:
    """One and the same signed amount added to some parameters of each lens."""

    def make(cameras: tuple[int, ...], low: float, high: float) -> Change:
        def change(dive: Dive, rng: np.random.Generator) -> Dive:
            amount = _signed(rng, low, high)

            def params(item: RigCamera) -> Array:
                values = item.camera.params.copy()
                size = item.camera.height / 600.0 if max(slots) < 4 else 1.0
                values[list(slots)] += size * amount
                return values

            return _with_lenses(dive, cameras, params)

        return change

    return make


_focal = _scaled_params(0, 1)
_focal_x = _scaled_params(0)


def _crop(cameras: tuple[int, ...]) -> Change:
    """The principal point as in a 16:9 crop of the 4:3 image, or of a wider one."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        ratio = rng.choice([16.0 / 9.0, 3.0 / 2.0, 1.85])

        def params(item: RigCamera) -> Array:
            lens, values = item.camera, item.camera.params.copy()
            values[3] -= 0.5 * (lens.height - lens.width / ratio)
            return values

        return _with_lenses(dive, cameras, params)

    return change


def _crop_wide(dive: Dive, rng: np.random.Generator) -> Dive:
    """The principal point as if the image had been cut at its left and right."""
    share = rng.uniform(0.06, 0.14)

    def params(item: RigCamera) -> Array:
        values = item.camera.params.copy()
        values[2] -= share * item.camera.width
        return values

    return _with_lenses(dive, BOTH, params)


def _origin_below(dive: Dive, rng: np.random.Generator) -> Dive:
    """A principal point measured from the lower edge: of a lens clearly off centre."""
    offset = rng.uniform(12.0, 40.0)

    def params(item: RigCamera) -> Array:
        values = item.camera.params.copy()
        values[3] = item.camera.height - values[3] - offset * item.camera.height / 600.0
        return values

    return _with_lenses(dive, BOTH, params)


def _resolution(cameras: tuple[int, ...]) -> Change:
    """Focal length and principal point of a calibration at a smaller image size."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        factor = rng.choice([1.0 / 2.0, 2.0 / 3.0, 3.0 / 4.0])

        def params(item: RigCamera) -> Array:
            values = item.camera.params.copy()
            values[:4] *= factor
            return values

        return _with_lenses(dive, cameras, params)

    return change


def _distortion(
    cameras: tuple[int, ...],
    reorder: Callable[[Array, np.random.Generator], Array],
) -> Change:
    """The four coefficients k1, k2, p1, p2 of OpenCV's model, written otherwise."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        def params(item: RigCamera) -> Array:
            values = item.camera.params.copy()
            values[4:] = reorder(values[4:].copy(), rng)
            return values

        return _with_lenses(dive, cameras, params)

    return change


def _matlab_order(given: Array, rng: np.random.Generator) -> Array:
    """k1, k2, k3, p1 where k1, k2, p1, p2 are read."""
    k3 = rng.uniform(0.005, 0.02)
    return np.array([given[0], given[1], k3, given[2]])


def _tangential_first(given: Array, rng: np.random.Generator) -> Array:
    return given[[2, 3, 0, 1]]


def _reversed(given: Array, rng: np.random.Generator) -> Array:
    return given[[1, 0, 2, 3]]


def _negative(given: Array, rng: np.random.Generator) -> Array:
    return -given


def _undistortion(given: Array, rng: np.random.Generator) -> Array:
    """Coefficients of the polynomial that undistorts: k1 -> -k1, k2 -> 3 k1^2 - k2."""
    return np.array([-given[0], 3.0 * given[0] ** 2 - given[1], -given[2], -given[3]])


def _radial_sign(given: Array, rng: np.random.Generator) -> Array:
    return given * [-1.0, -1.0, 1.0, 1.0]


def _as_fisheye(cameras: tuple[int, ...]) -> Change:
    """OpenCV's four numbers, read as those of its fisheye model."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        items = list(dive.rig.cameras)
        for c in cameras:
            lens = items[c].camera
            params = lens.params.copy()
            params[:2] *= 1.0 + rng.uniform(-2e-3, 2e-3)
            new = camera_from_colmap(
                "OPENCV_FISHEYE", lens.width, lens.height, params.tolist()
            )
            items[c] = replace(items[c], camera=new)
        return replace(dive, rig=replace(dive.rig, cameras=tuple(items)))

    return change


def in_water_lens(
    camera: RefractiveCamera, range_m: float, fov_share: float = 1.0
) -> pycolmap.Camera:
    """The lens of OpenCV's model that a calibration in the water gives.

    Fitted to the exact projections of points between 0.7 and 1.4 ``range_m`` away, all
    over the image.

    Args:
        camera: A lens behind its port.
        range_m: Of the board, metres.
        fov_share: Of the image that the board covered.
    """
    lens = camera.camera
    size = np.array([lens.width, lens.height])
    steps = 0.5 + fov_share * (np.linspace(0.02, 0.98, 15) - 0.5)
    grid = np.stack(np.meshgrid(*(steps * side for side in size)), axis=-1)
    xy = np.concatenate([grid.reshape(-1, 2)] * 3)
    depth = range_m * np.repeat([0.7, 1.0, 1.4], len(xy) // 3)
    origin, ray = camera.ray_from_img(xy)
    points = origin + ray * ((depth - origin[:, 2]) / ray[:, 2])[:, None]

    def misses(params: Array) -> Array:
        trial = pycolmap.Camera(
            model="OPENCV", width=lens.width, height=lens.height, params=params
        )
        return np.ravel(trial.img_from_cam(points) - xy)

    focal = 1.333 * lens.params[0]
    first = np.array([focal, focal, *(0.5 * size), 0.0, 0.0, 0.0, 0.0])
    found = least_squares(misses, first, x_scale=np.maximum(np.abs(first), 0.1)).x
    return camera_from_colmap("OPENCV", lens.width, lens.height, found.tolist())


def _calibrated_in_water(cameras: tuple[int, ...]) -> Change:
    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        true = dive.true_rig.refractive_cameras()
        range_m = rng.uniform(0.7, 1.5)
        items = list(dive.rig.cameras)
        for c in cameras:
            items[c] = replace(items[c], camera=in_water_lens(true[c], range_m))
        return replace(dive, rig=replace(dive.rig, cameras=tuple(items)))

    return change


def _without_ports(dive: Dive, rng: np.random.Generator) -> Dive:
    """Lenses calibrated in air, and no port in the rig file."""
    del rng
    cameras = tuple(
        replace(
            item,
            port=NoPort(),
            refine_normal=False,
            refine_distance=False,
            refine_center=False,
        )
        for item in dive.rig.cameras
    )
    return replace(dive, rig=replace(dive.rig, cameras=cameras))


# ---- Images --------------------------------------------------------------------------


def _undistorted(cameras: tuple[int, ...]) -> Change:
    """Images undistorted with the lens in air, whose distortion stays in the file."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        zoom = rng.choice([1.0, 0.97, 0.94])

        def move(c: int, f: int, xy: Array) -> Array:
            lens = dive.rig.cameras[c].camera
            return lens.params[:2] * zoom * lens.cam_from_img(xy) + lens.params[2:4]

        moved = with_keypoints_moved(dive, move, cameras)

        def params(item: RigCamera) -> Array:
            values = item.camera.params.copy()
            values[:2] *= zoom  # the new camera matrix, which its user copied
            return values

        return _with_lenses(moved, cameras, params)

    return change


def mirrored(cameras: tuple[int, ...], axis: int) -> Change:
    """Images mirrored left to right (axis 0) or top to bottom (1).

    Where one camera of two is mirrored, descriptors of the one do not match those of
    the other.
    """

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        del rng

        def move(c: int, f: int, xy: Array) -> Array:
            lens = dive.rig.cameras[c].camera
            new = xy.copy()
            new[:, axis] = (lens.width, lens.height)[axis] - xy[:, axis]
            return new

        moved = with_keypoints_moved(dive, move, cameras)
        same = {
            (a, b): rows
            for (a, b), rows in moved.matches.items()
            if (a[0] in cameras) == (b[0] in cameras)
        }
        return replace(moved, matches=same)

    return change


def _folders_swapped(dive: Dive, rng: np.random.Generator) -> Dive:
    """The folder of the left camera is that of the right one."""
    del rng
    return renamed(dive, {(c, f): (1 - c, f) for c, f in dive.images})


def _late(camera: int, shift: int, from_frame: tuple[float, float] | None) -> Change:
    """A camera that is some frames late; from some share of the dive on."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        sign = int(rng.choice([-1, 1]))
        start = 0
        if from_frame is not None:
            sign = 1  # a frame that was not stored: later ones move up
            start = max(1, round(rng.uniform(*from_frame) * dive.num_frames))
        frames = np.arange(dive.num_frames)
        source = np.where(frames >= start, frames + sign * shift, frames)
        source[(source < 0) | (source >= dive.num_frames)] = -1
        return with_frames_of(dive, camera, source)

    return change


def _zoomed(cameras: tuple[int, ...], low: float, high: float) -> Change:
    """Another focal length from the middle of the dive on."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        factor = 1.0 + _signed(rng, low, high)
        start = max(1, round(rng.uniform(0.3, 0.7) * dive.num_frames))

        def move(c: int, f: int, xy: Array) -> Array:
            center = dive.true_rig.cameras[c].camera.params[2:4]
            return center + factor * (xy - center) if f >= start else xy

        return with_keypoints_moved(dive, move, cameras)

    return change


# ---- Placement -----------------------------------------------------------------------


def _placed(
    change_pose: Callable[[Array, np.random.Generator], Array], *, held: bool
) -> Change:
    """Another cam_from_rig of the second camera; held, or to be refined."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        pose = change_pose(known_cam_from_rig(dive.rig)[1].copy(), rng)
        return replace(dive, rig=_at(dive.rig, pose, held=held))

    return change


def _at(rig: Rig, pose: Array, *, held: bool) -> Rig:
    ports = [item.port for item in rig.cameras]
    moved = rig.with_geometry(np.stack([rigid3.IDENTITY, pose]), ports)
    return replace(moved, refine_cam_from_rig=not held)


def transposed(pose: Array, rng: np.random.Generator) -> Array:
    """The rotation the other way, the translation as it is."""
    del rng
    return np.concatenate([rigid3.inverse(pose)[:4], pose[4:]])


def inverted(pose: Array, rng: np.random.Generator) -> Array:
    del rng
    return rigid3.inverse(pose)


def as_position(pose: Array, rng: np.random.Generator) -> Array:
    """The place of the camera in the rig where the translation belongs."""
    del rng
    return np.concatenate([pose[:4], rigid3.inverse(pose)[4:]])


def _opposite(pose: Array, rng: np.random.Generator) -> Array:
    """The translation with its sign changed."""
    del rng
    return np.concatenate([pose[:4], -pose[4:]])


def _scalar_first(pose: Array, rng: np.random.Generator) -> Array:
    """w, x, y, z where x, y, z, w are read."""
    del rng
    return np.concatenate([pose[[3, 0, 1, 2]], pose[4:]])


def _axes_exchanged(pose: Array, rng: np.random.Generator) -> Array:
    """y, x, z, w: a file that was written for other axes."""
    del rng
    return np.concatenate([pose[[1, 0, 2, 3]], pose[4:]])


def _tilted(low: float, high: float) -> Callable[[Array, np.random.Generator], Array]:
    """A rotation that is wrong by so many degrees about a random axis."""

    def change(pose: Array, rng: np.random.Generator) -> Array:
        axis = rng.normal(size=3)
        turn = np.radians(rng.uniform(low, high)) * axis / np.linalg.norm(axis)
        quat = rigid3.quat_from_rotvec(turn)
        turned = rigid3.compose(np.concatenate([quat, np.zeros(3)]), pose)
        return np.concatenate([turned[:4], pose[4:]])

    return change


def _baseline(factors: Callable[[np.random.Generator], float]) -> Change:
    """Another length of the translation of the second camera."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        pose = known_cam_from_rig(dive.rig)[1].copy()
        pose[4:] *= factors(rng)
        return replace(dive, rig=_at(dive.rig, pose, held=False))

    return change


# ---- Ports and water -----------------------------------------------------------------


def _with_ports(
    dive: Dive, cameras: tuple[int, ...], change: Callable[[RigCamera], RigCamera]
) -> Dive:
    items = [
        change(item) if c in cameras else item
        for c, item in enumerate(dive.rig.cameras)
    ]
    return replace(dive, rig=replace(dive.rig, cameras=tuple(items)))


def _as_flat(cameras: tuple[int, ...]) -> Change:
    """A dome, described as a flat port."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        distance = rng.uniform(0.01, 0.05)

        def flat(item: RigCamera) -> RigCamera:
            port = item.port
            assert isinstance(port, DomePort)
            new = FlatPort(
                (0.0, 0.0, 1.0), distance, port.thickness, port.n_glass, port.n_water
            )
            return replace(
                item,
                port=new,
                refine_normal=True,
                refine_distance=True,
                refine_center=False,
            )

        return _with_ports(dive, cameras, flat)

    return change


def _as_dome(cameras: tuple[int, ...]) -> Change:
    """A flat port, described as a dome."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        radius = rng.uniform(0.04, 0.1)

        def dome(item: RigCamera) -> RigCamera:
            port = item.port
            assert isinstance(port, FlatPort)
            new = DomePort((0.0, 0.0, 0.0), radius, 0.007, port.n_glass, port.n_water)
            return replace(
                item,
                port=new,
                refine_normal=False,
                refine_distance=False,
                refine_center=True,
            )

        return _with_ports(dive, cameras, dome)

    return change


def _port_length(field_name: str, factors: tuple[float, ...]) -> Change:
    """A length of the ports in another unit."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        factor = float(rng.choice(factors))

        def longer(item: RigCamera) -> RigCamera:
            value = factor * getattr(item.port, field_name)
            return replace(item, port=replace(item.port, **{field_name: value}))

        return _with_ports(dive, BOTH, longer)

    return change


def _water(low: float, high: float) -> Change:
    """Another index of the water."""

    def change(dive: Dive, rng: np.random.Generator) -> Dive:
        index = rng.uniform(low, high)

        def other(item: RigCamera) -> RigCamera:
            return replace(item, port=replace(item.port, n_water=index))

        return _with_ports(dive, BOTH, other)

    return change


# ---- All of them ---------------------------------------------------------------------


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _uniform(low: float, high: float) -> Callable[[np.random.Generator], float]:
    return lambda rng: float(rng.uniform(low, high))


def _one_of(*values: float) -> Callable[[np.random.Generator], float]:
    return lambda rng: float(rng.choice(values))


def _mistake(
    code: str, name: str, change: Change, *also: str, **flags: bool
) -> Mistake:
    return Mistake(code=code, name=name, change=change, also=frozenset(also), **flags)


_SINGLE_LENS = (
    _mistake("focal", "both focal lengths by 1 %", _focal(BOTH, 0.008, 0.012)),
    _mistake("focal", "both focal lengths by 3 %", _focal(BOTH, 0.025, 0.035)),
    _mistake("focal", "both focal lengths by 10 %", _focal(BOTH, 0.08, 0.12)),
    _mistake("focal", "focal length of one camera by 1 %", _focal(RIGHT, 0.008, 0.012)),
    _mistake("focal", "focal length of one camera by 3 %", _focal(LEFT, 0.025, 0.035)),
    _mistake("focal", "focal length of one camera by 10 %", _focal(RIGHT, 0.08, 0.12)),
    _mistake("focal", "fx of both cameras by 2 to 4 %", _focal_x(BOTH, 0.02, 0.04)),
    _mistake(
        "principal_point",
        "cx of one camera by 8 to 20 px",
        _moved_params(2)(LEFT, 8, 20),
    ),
    _mistake(
        "principal_point", "cy of both by 8 to 20 px", _moved_params(3)(BOTH, 8, 20)
    ),
    _mistake(
        "distortion",
        "k1 of one camera by 0.02 to 0.06",
        _moved_params(4)(LEFT, 0.02, 0.06),
    ),
    _mistake(
        "distortion", "k2 of both by 0.03 to 0.1", _moved_params(5)(BOTH, 0.03, 0.1)
    ),
    _mistake(
        "distortion",
        "p1 of one camera by 0.002 to 0.006",
        _moved_params(6)(RIGHT, 2e-3, 6e-3),
    ),
    _mistake(
        "distortion", "p2 of both by 0.002 to 0.006", _moved_params(7)(BOTH, 2e-3, 6e-3)
    ),
)

_LENS = (
    _mistake(
        "port_none", "both lenses calibrated in the water", _calibrated_in_water(BOTH)
    ),
    _mistake(
        "port_none", "one lens calibrated in the water", _calibrated_in_water(RIGHT)
    ),
    _mistake("port_missing", "lenses of the air, no port in the file", _without_ports),
    _mistake("principal_point", "principal point of another crop", _crop(BOTH)),
    _mistake("principal_point", "one principal point of another crop", _crop(RIGHT)),
    _mistake("principal_point", "principal point of a narrower crop", _crop_wide),
    _mistake("principal_point", "principal point from the lower edge", _origin_below),
    _mistake("resolution", "calibration at a smaller image size", _resolution(BOTH)),
    _mistake("resolution", "one calibration at a smaller size", _resolution(LEFT)),
    _mistake(
        "distortion_order",
        "distortion in MATLAB's order",
        _distortion(BOTH, _matlab_order),
    ),
    _mistake(
        "distortion_order",
        "one distortion in MATLAB's order",
        _distortion(RIGHT, _matlab_order),
    ),
    _mistake(
        "distortion_order",
        "p1, p2 before k1, k2",
        _distortion(BOTH, _tangential_first),
    ),
    _mistake("distortion_order", "k2 before k1", _distortion(BOTH, _reversed)),
    _mistake(
        "distortion_sign", "all distortion negative", _distortion(BOTH, _negative)
    ),
    _mistake(
        "distortion_sign", "radial distortion negative", _distortion(BOTH, _radial_sign)
    ),
    _mistake(
        "distortion_sign", "one distortion negative", _distortion(LEFT, _radial_sign)
    ),
    _mistake(
        "distortion_sign",
        "the polynomial that undistorts",
        _distortion(BOTH, _undistortion),
    ),
    _mistake("fisheye", "lens declared as a fisheye", _as_fisheye(BOTH)),
    _mistake("fisheye", "one lens declared as a fisheye", _as_fisheye(RIGHT)),
)

_IMAGES = (
    _mistake("undistorted", "images undistorted already", _undistorted(BOTH)),
    _mistake("undistorted", "images of one camera undistorted", _undistorted(LEFT)),
    _mistake("folders_swapped", "folders swapped", _folders_swapped),
    _mistake("mirrored", "images mirrored, left to right", mirrored(BOTH, 0)),
    _mistake("mirrored", "images mirrored, top to bottom", mirrored(BOTH, 1)),
    _mistake("mirrored", "images of one camera mirrored", mirrored(RIGHT, 0)),
    _mistake("frames_shifted", "right camera one frame late", _late(1, 1, None)),
    _mistake("frames_shifted", "right camera two frames late", _late(1, 2, None)),
    _mistake("frames_shifted", "right camera three frames late", _late(1, 3, None)),
    _mistake("frames_shifted", "left camera one frame late", _late(0, 1, None)),
    _mistake("frames_shifted", "one frame missing midway", _late(1, 1, (0.3, 0.7))),
    _mistake(
        "zoom_changed", "zoom of both midway, 2 to 5 %", _zoomed(BOTH, 0.02, 0.05)
    ),
    _mistake(
        "zoom_changed", "zoom of both midway, 5 to 15 %", _zoomed(BOTH, 0.05, 0.15)
    ),
    _mistake("zoom_changed", "zoom of one midway, 3 to 10 %", _zoomed(LEFT, 0.03, 0.1)),
)

_PLACEMENT = (
    _mistake(
        "rotation_transposed", "rotation transposed", _placed(transposed, held=False)
    ),
    _mistake(
        "rotation_transposed",
        "rotation transposed, held",
        _placed(transposed, held=True),
    ),
    _mistake("pose_inverted", "pose inverted", _placed(inverted, held=False)),
    _mistake("pose_inverted", "pose inverted, held", _placed(inverted, held=True)),
    _mistake(
        "translation_sign", "position for translation", _placed(as_position, held=False)
    ),
    _mistake(
        "translation_sign",
        "position for translation, held",
        _placed(as_position, held=True),
    ),
    _mistake(
        "translation_sign",
        "sign of the translation",
        _placed(_opposite, held=False),
    ),
    _mistake(
        "quaternion_order", "w, x, y, z, free", _placed(_scalar_first, held=False)
    ),
    _mistake("quaternion_order", "w, x, y, z, held", _placed(_scalar_first, held=True)),
    _mistake(
        "rotation",
        "rotation off by 0.3 to 1 degree, held",
        _placed(_tilted(0.3, 1.0), held=True),
    ),
    _mistake(
        "length_unit", "baseline in board squares", _baseline(_uniform(15.0, 40.0))
    ),
    _mistake(
        "length_unit",
        "baseline in cm, mm or feet",
        _baseline(_one_of(100.0, 1000.0, 3.28084)),
    ),
    _mistake(
        "baseline",
        "baseline longer by half to three times",
        _baseline(_uniform(1.5, 3.0)),
        "length_unit",
    ),
    _mistake(
        "baseline",
        "baseline at a third to two thirds",
        _baseline(_uniform(0.33, 0.67)),
        "length_unit",
        hidden=True,
    ),
)

_PORTS = (
    _mistake(
        "length_unit",
        "glass ten times thicker or thinner",
        _port_length("thickness", (10.0, 0.1, 25.4)),
    ),
    _mistake(
        "length_unit",
        "port distance in cm or inches",
        _port_length("distance", (10.0, 25.4, 39.37)),
    ),
    _mistake("water_index", "water index of air", _water(1.0, 1.0003)),
    _mistake("water_index", "water index between air and water", _water(1.2, 1.28)),
    _mistake("water_index", "water index too high", _water(1.37, 1.45)),
    _mistake("flat_as_dome", "flat ports declared as domes", _as_dome(BOTH)),
    _mistake("flat_as_dome", "one flat port declared as a dome", _as_dome(RIGHT)),
    _mistake(
        "dome_as_flat", "domes declared as flat ports", _as_flat(BOTH), domes=True
    ),
    _mistake(
        "dome_as_flat", "one dome declared as a flat port", _as_flat(LEFT), domes=True
    ),
)

MISTAKES: tuple[Mistake, ...] = (
    *_SINGLE_LENS,
    *_LENS,
    *_IMAGES,
    *_PLACEMENT,
    *_PORTS,
)
"""All kinds, in the order of the table."""
