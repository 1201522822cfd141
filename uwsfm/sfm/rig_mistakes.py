"""What people get wrong in a rig file, and each mistake undone.

Nothing here looks at images: a `Correction` is a rig as it would be without one
mistake. Who has observations tries them: `rig_check` on matches of single frames,
`uwsfm.trust.diagnosis` on a whole dive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import DomePort, FlatPort, NoPort, Port
from uwsfm.rig import Rig, RigCamera, camera_from_colmap
from uwsfm.rig_file import FRESH_WATER
from uwsfm.scene import IndexArray

DOME_RADII_M = (0.05, 0.1)
"""Of domes on the market, about; any radius undoes the most of a wrong flat port."""
SHIFTS = (1, -1, 2, -2, 3, -3)
"""Frames that one camera may be late or early."""
SCALES = (2.0, 0.5, 1.5, 2.0 / 3.0, 4.0 / 3.0, 0.75, 4.0, 0.25)
"""Sizes of an image against that of its calibration: 4K, 1080p, 720p, binning."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A rig without one mistake."""

    code: str
    """Which mistake, one of `CODES`."""
    rig: Rig
    what: str
    """The mistake, a clause that names the cameras."""
    remedy: str
    """What to change in the rig file or the images: an imperative clause."""
    exchanged: bool = False
    """The images of the first two cameras change places."""
    flipped: int | None = None
    """Every image is mirrored along this axis: 0 left to right, 1 top to bottom."""


def corrections(rig: Rig) -> list[Correction]:
    """Every mistake undone, singly: of the lenses, the ports and the placement."""
    found = [*port_corrections(rig), *lens_corrections(rig), *pose_corrections(rig)]
    return [*found, *image_corrections(rig)]


def _quoted(rig: Rig, which: tuple[int, ...]) -> str:
    return " and ".join(repr(rig.cameras[c].name) for c in which)


def _subsets(rig: Rig, applies: Callable[[RigCamera], bool]) -> list[tuple[int, ...]]:
    """All cameras that a mistake may concern, then each of them alone."""
    every = tuple(c for c, camera in enumerate(rig.cameras) if applies(camera))
    if len(every) < 2:
        return [every] if every else []
    return [every, *((c,) for c in every)]


def _with_ports(
    rig: Rig, which: tuple[int, ...], change: Callable[[Port], Port], free: bool = False
) -> Rig:
    cameras = list(rig.cameras)
    for c in which:
        port = change(cameras[c].port)
        cameras[c] = replace(
            cameras[c],
            port=port,
            refine_normal=isinstance(port, FlatPort)
            and (free or cameras[c].refine_normal),
            refine_distance=isinstance(port, FlatPort)
            and (free or cameras[c].refine_distance),
            refine_center=isinstance(port, DomePort)
            and (free or cameras[c].refine_center),
        )
    return replace(rig, cameras=tuple(cameras))


def port_corrections(rig: Rig) -> Iterator[Correction]:
    """The port itself: none, missing, of the other kind, in another water."""
    for which in _subsets(rig, lambda c: not isinstance(c.port, NoPort)):
        names = _quoted(rig, which)
        yield Correction(
            code="port_none",
            rig=_with_ports(rig, which, lambda _: NoPort()),
            what=f"the lens of {names} was calibrated in the water, though the rig "
            "file has a port",
            remedy=f"write port: {{type: none}} for {names}, or give the lens as "
            "calibrated in air",
        )
    yield from missing_ports(rig)
    yield from _other_kinds(rig)
    yield from _other_waters(rig)


def missing_ports(rig: Rig) -> Iterator[Correction]:
    """A lens that was calibrated in air, and whose port is not in the rig file.

    Any flat port will do for it: what it does to rays is mostly the water's.
    """
    for which in _subsets(rig, lambda c: isinstance(c.port, NoPort))[:1]:
        names = _quoted(rig, which)
        yield Correction(
            code="port_missing",
            rig=_with_ports(rig, which, lambda _: FlatPort(), free=True),
            what=f"the port of {names} is missing in the rig file, where type none is "
            "for a lens that was calibrated in the water, not in air",
            remedy=f"describe the port of {names} there",
        )


def _other_kinds(rig: Rig) -> Iterator[Correction]:
    for which in _subsets(rig, lambda c: isinstance(c.port, FlatPort)):
        names = _quoted(rig, which)
        for radius in DOME_RADII_M:
            yield Correction(
                code="dome_as_flat",
                rig=_with_ports(rig, which, _as_dome(radius), free=True),
                what=f"the port of {names} is a dome, and not flat",
                remedy=f"describe the port of {names} as type: dome",
            )
    for which in _subsets(rig, lambda c: isinstance(c.port, DomePort)):
        names = _quoted(rig, which)
        yield Correction(
            code="flat_as_dome",
            rig=_with_ports(rig, which, _as_flat, free=True),
            what=f"the port of {names} is flat, and no dome",
            remedy=f"describe the port of {names} as type: flat",
        )


def _as_dome(radius: float) -> Callable[[Port], Port]:
    def dome(port: Port) -> Port:
        assert isinstance(port, FlatPort)
        thick = min(port.thickness, 0.2 * radius)
        return DomePort((0.0, 0.0, 0.0), radius, thick, port.n_glass, port.n_water)

    return dome


def _as_flat(port: Port) -> Port:
    assert isinstance(port, DomePort)
    return FlatPort((0.0, 0.0, 1.0), 0.02, port.thickness, port.n_glass, port.n_water)


def _other_waters(rig: Rig) -> Iterator[Correction]:
    behind = tuple(
        c for c, item in enumerate(rig.cameras) if not isinstance(item.port, NoPort)
    )
    if not behind:
        return
    given = rig.cameras[behind[0]].port.n_water
    for index in (FRESH_WATER, 1.0):
        if abs(index - given) < 0.02:
            continue
        medium = "air" if index == 1.0 else "water"

        def filled(port: Port, index: float = index) -> Port:
            assert not isinstance(port, NoPort)
            return replace(port, n_water=index)

        yield Correction(
            code="water_index",
            rig=_with_ports(rig, behind, filled),
            what=f"the water index is {index:g}, that of {medium}, and not {given:g}",
            remedy=f"write water: {{refractive_index: {index:g}}}",
        )


def with_lens(camera: RigCamera, model: str, params: Array) -> RigCamera | None:
    """The camera with another lens; None if no lens can have such parameters."""
    old = camera.camera
    try:
        lens = camera_from_colmap(model, old.width, old.height, params.tolist())
    except InputError:
        return None
    return replace(camera, camera=lens)


_Change = Callable[[RigCamera], RigCamera | None]


def _changed(rig: Rig, which: tuple[int, ...], change: _Change) -> Rig | None:
    cameras = list(rig.cameras)
    for c in which:
        other = change(cameras[c])
        if other is None:
            return None
        cameras[c] = other
    return replace(rig, cameras=tuple(cameras))


def num_pinhole(camera: RigCamera) -> int:
    """How many of a lens's parameters come before its distortion: 3 or 4."""
    lens = camera.camera
    return len(lens.focal_length_idxs()) + len(lens.principal_point_idxs())


def distortion(camera: RigCamera) -> Array:
    """The distortion parameters of a lens, in the order of its model."""
    return np.array(camera.camera.params[num_pinhole(camera) :])


def _distorts(camera: RigCamera) -> bool:
    return bool(np.any(distortion(camera) != 0.0))


def lens_corrections(rig: Rig) -> Iterator[Correction]:
    """The lens: its size, its centre, its distortion."""
    kinds = (
        ("undistorted", _undistortions),
        ("distortion_sign", _signs),
        ("distortion_order", _orders),
        ("fisheye", _fisheyes),
        ("resolution", _resolutions),
        ("principal_point", _centers),
    )
    for code, variants in kinds:
        applies = _distorts if code in _OF_DISTORTION else lambda _: True
        for which in _subsets(rig, applies):
            if code == "resolution" and len(which) < len(rig.cameras):
                continue  # cameras of one rig are calibrated in one way
            for what, remedy, change in variants(rig.cameras[which[0]]):
                other = _changed(rig, which, change)
                if other is None:
                    continue
                names = _quoted(rig, which)
                yield Correction(
                    code=code,
                    rig=other,
                    what=what.format(names=names),
                    remedy=remedy.format(names=names),
                )


_OF_DISTORTION = ("undistorted", "distortion_sign", "distortion_order", "fisheye")
_Variant = tuple[str, str, _Change]


def _with_distortion(change: Callable[[Array], Array]) -> _Change:
    def changed(camera: RigCamera) -> RigCamera | None:
        params = np.array(camera.camera.params)
        first = num_pinhole(camera)
        params[first:] = change(params[first:])
        return with_lens(camera, camera.camera.model_name, params)

    return changed


def _undistortions(_: RigCamera) -> Iterator[_Variant]:
    yield (
        "the images of {names} are undistorted already",
        "give the images as the camera took them, or a lens without distortion "
        "(model PINHOLE) for {names}",
        _with_distortion(np.zeros_like),
    )


def _signs(camera: RigCamera) -> Iterator[_Variant]:
    what = "the distortion of {names} has the wrong sign"
    remedy = (
        "change the sign of the distortion coefficients of {names}: they must map from "
        "the undistorted to the distorted image"
    )
    yield what, remedy, _with_distortion(np.negative)
    if camera.camera.model_name == "OPENCV":
        yield (
            f"{what}: that of k1 and k2 alone",
            remedy,
            _with_distortion(lambda v: v * [-1.0, -1.0, 1.0, 1.0]),
        )
        yield (
            f"{what}: they undistort",
            "give the coefficients of {names} that distort, not those that undistort",
            _with_distortion(_inverse_polynomial),
        )


def _inverse_polynomial(undistortion: Array) -> Array:
    """OPENCV's coefficients that undo others, to fifth order in the radius."""
    k1, k2, p1, p2 = undistortion
    return np.array([-k1, 3.0 * k1**2 - k2, -p1, -p2])


def _orders(camera: RigCamera) -> Iterator[_Variant]:
    remedy = (
        "put the distortion coefficients of {names} in the order of the model: "
        f"{camera.camera.params_info}"
    )
    model = camera.camera.model_name
    if model == "FULL_OPENCV":
        yield (
            "the distortion coefficients of {names} are in the order "
            "k1, k2, k3, p1, p2",
            remedy,
            _with_distortion(_in_order((0, 1, 3, 4, 2, 5, 6, 7))),
        )
    if model != "OPENCV":
        return

    def radial_three(item: RigCamera) -> RigCamera | None:
        k1, k2, k3, p1 = distortion(item)
        params = [*item.camera.params[:4], k1, k2, p1, 0.0, k3, 0.0, 0.0, 0.0]
        return with_lens(item, "FULL_OPENCV", np.array(params))

    yield (
        "the distortion coefficients of {names} are in the order k1, k2, k3, p1 "
        "(MATLAB, Metashape)",
        remedy,
        radial_three,
    )
    yield (
        "the distortion coefficients of {names} are in the order k1, k2, k3, p1 "
        "(MATLAB, Metashape), and k3 is no part of the lens",
        remedy,
        _with_distortion(lambda v: np.array([v[0], v[1], v[3], 0.0])),
    )
    for order in _OPENCV_ORDERS:
        read = np.argsort(order).tolist()
        yield (
            "the distortion coefficients of {names} are in the order "
            f"{', '.join(_OPENCV_NAMES[k] for k in read)}",
            remedy,
            _with_distortion(_in_order(order)),
        )


def _in_order(order: tuple[int, ...]) -> Callable[[Array], Array]:
    return lambda values: values[list(order)]


_OPENCV_NAMES = ("k1", "k2", "p1", "p2")
_OPENCV_ORDERS = ((2, 3, 0, 1), (1, 0, 2, 3), (0, 1, 3, 2), (0, 2, 1, 3), (3, 2, 1, 0))
"""Where k1, k2, p1 and p2 may stand in a file instead."""


def _fisheyes(camera: RigCamera) -> Iterator[_Variant]:
    fisheye = camera.camera.model_name == "OPENCV_FISHEYE"
    if not fisheye and camera.camera.model_name not in ("OPENCV", "FULL_OPENCV"):
        return
    other = "OPENCV" if fisheye else "OPENCV_FISHEYE"
    is_no = "is no fisheye" if fisheye else "is a fisheye"

    def exchanged(item: RigCamera) -> RigCamera | None:
        return with_lens(item, other, np.array(item.camera.params[:8]))

    yield (
        f"the lens of {{names}} {is_no}",
        f"write model: {other} for {{names}}, with the same numbers",
        exchanged,
    )


def scaled_lens(camera: RigCamera, scale: float) -> RigCamera | None:
    """The lens of an image ``scale`` times as large."""
    params = np.array(camera.camera.params)
    params[: num_pinhole(camera)] *= scale
    return with_lens(camera, camera.camera.model_name, params)


def _resolutions(camera: RigCamera) -> Iterator[_Variant]:
    lens = camera.camera
    centred = 0.5 * lens.width / lens.principal_point_x
    scales = [s for s in SCALES if abs(s / centred - 1.0) > 0.1]
    if abs(centred - 1.0) > 0.1:
        scales.insert(0, centred)
    for scale in scales:
        yield (
            f"the lens of {{names}} was calibrated at another resolution, of images "
            f"{1.0 / scale:.3g} times as large",
            "give the lens of {names} for the image size that is in the file: multiply "
            f"fx, fy, cx and cy by {scale:.3g}",
            partial(scaled_lens, scale=scale),
        )


def _centers(camera: RigCamera) -> Iterator[_Variant]:
    def centred(item: RigCamera) -> RigCamera | None:
        params = np.array(item.camera.params)
        middle = 0.5 * item.camera.width, 0.5 * item.camera.height
        params[list(item.camera.principal_point_idxs())] = middle
        return with_lens(item, item.camera.model_name, params)

    yield (
        "the principal point of {names} is in the middle of the image",
        "give cx and cy of {names} in pixels of these images: crop, image size and "
        "pixel origin must be those of the calibration",
        centred,
    )


def pose_corrections(rig: Rig) -> Iterator[Correction]:
    """The placement: `cam_from_rig` of every camera but the first, read otherwise."""
    poses = rig.cam_from_rig
    if poses is None or len(poses) < 2:
        return
    names = _quoted(rig, tuple(range(1, len(poses))))
    for code, what, remedy, change in _POSES:
        other = poses.copy()
        other[1:] = change(poses[1:])
        if np.allclose(other, poses, atol=1e-9):
            continue
        lengths = np.linalg.norm(other[:, 4:], axis=1)
        yield Correction(
            code=code,
            rig=replace(rig, cam_from_rig=other, baseline_m=float(lengths[1])),
            what=what.format(names=names),
            remedy=remedy.format(names=names),
        )


def _transposed(poses: Array) -> Array:
    other = poses.copy()
    other[:, :3] *= -1.0
    return other


def _scalar_first(poses: Array) -> Array:
    return np.hstack([poses[:, 1:4], poses[:, :1], poses[:, 4:]])


def _as_position(poses: Array) -> Array:
    other = poses.copy()
    other[:, 4:] = -rigid3.rotate(poses, poses[:, 4:])
    return other


_POSES: tuple[tuple[str, str, str, Callable[[Array], Array]], ...] = (
    (
        "pose_inverted",
        "cam_from_rig of {names} is inverted",
        "cam_from_rig of {names} must map from the rig to the camera "
        "(x_in_cam = R x_in_rig + translation_m)",
        rigid3.inverse,
    ),
    (
        "rotation_transposed",
        "the rotation of {names} is transposed",
        "transpose the rotation matrix of {names} (x_in_cam = R x_in_rig + "
        "translation_m; MATLAB's is the transpose)",
        _transposed,
    ),
    (
        "translation_sign",
        "translation_m of {names} is the position of the camera",
        "translation_m of {names} must be -R times that position",
        _as_position,
    ),
    (
        "quaternion_order",
        "the quaternion of {names} is in the order w, x, y, z",
        "write rotation_xyzw of {names} in the order x, y, z, w",
        _scalar_first,
    ),
)


def image_corrections(rig: Rig) -> Iterator[Correction]:
    """The images: folders that are swapped, pictures that are mirrored."""
    if len(rig.cameras) < 2:
        return
    a, b = rig.cameras[:2]
    yield Correction(
        code="folders_swapped",
        rig=rig,
        what=f"the image folders {a.images!r} and {b.images!r} are swapped",
        remedy="exchange them in rig.yaml",
        exchanged=True,
    )
    for axis, text in enumerate(("left to right", "top to bottom")):
        yield Correction(
            code="mirrored",
            rig=rig,
            what=f"the images are mirrored, {text}",
            remedy="turn off the mirroring where they were exported, or flip them back",
            flipped=axis,
        )


def shift_words(name: str, shift: int, since: str = "") -> tuple[str, str]:
    """What is wrong, and what to do, if a camera's images belong ``shift`` frames
    later than their names say."""
    way = "early" if shift > 0 else "late"
    count = f"{abs(shift)} frame{'s' if abs(shift) > 1 else ''}"
    return (
        f"the images of {name!r} are {count} {way}{since}",
        "pair the images anew, for images of equal names must be taken together",
    )


def corrected_pixels(
    correction: Correction, sizes: Array, camera_idx: IndexArray, xy: Array
) -> tuple[IndexArray, Array]:
    """Cameras (N,) and pixels (N, 2) of observations once the images are put right.

    Args:
        correction: Which mistake is undone.
        sizes: (C, 2) width and height of the images.
        camera_idx: (N,) camera in whose folder an image is.
        xy: (N, 2) pixels there.
    """
    camera, pixels = np.array(camera_idx), np.array(xy, dtype=np.float64)
    if correction.flipped is not None:
        axis = correction.flipped
        pixels[:, axis] = sizes[camera, axis] - pixels[:, axis]
    if correction.exchanged:
        camera = np.where(camera < 2, 1 - camera, camera)
    return camera, pixels


CODES = (
    "port_none",
    "port_missing",
    "undistorted",
    "rotation_transposed",
    "pose_inverted",
    "quaternion_order",
    "principal_point",
    "focal",
    "resolution",
    "distortion_order",
    "distortion_sign",
    "fisheye",
    "dome_as_flat",
    "flat_as_dome",
    "folders_swapped",
    "mirrored",
    "frames_shifted",
    "zoom_changed",
    "length_unit",
    "baseline",
    "water_index",
    "translation_sign",
)
"""Names of the mistakes, as in reports."""
