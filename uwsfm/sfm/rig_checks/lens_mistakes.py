"""What people get wrong about a lens, and each mistake undone.

A lens comes from another program, of another image size, order or sign: what is named
here is how the numbers of calibrations differ from those that a rig file takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import Port
from uwsfm.rig.rig import Rig, RigCamera, camera_from_colmap
from uwsfm.sfm.correction import Correction, quoted, subsets

FOCAL_FACTORS = (0.75, 0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.3)
"""What a wrong zoom or video mode makes of a focal length, in steps."""
SAME_INDEX = 0.02
"""A focal length that is too long by the water index within this was calibrated in the
water: no zoom is that by chance as often."""
SAME_SCALE = 0.08
"""How far off the middle a principal point may be, relative."""
SCALES = tuple(
    scale
    for ratio in (1.25, 4.0 / 3.0, 1.4, 1.5, 2.0, 3.0, 4.0)
    for scale in (ratio, 1.0 / ratio)
)
"""Sizes of an image against that of its calibration: 4K, 2.7K, 1080p, 720p, binning."""


def with_lens(camera: RigCamera, model: str, params: Array) -> RigCamera | None:
    """The camera with another lens; None if no lens can have such parameters."""
    old = camera.camera
    try:
        lens = camera_from_colmap(model, old.width, old.height, params.tolist())
    except InputError:
        return None
    return replace(camera, camera=lens)


_Change = Callable[[RigCamera], RigCamera | None]


def changed_lenses(rig: Rig, which: tuple[int, ...], change: _Change) -> Rig | None:
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
    models = dict.fromkeys(item.camera.model_name for item in rig.cameras)
    for model, (code, variants) in product(models, kinds):

        def concerns(item: RigCamera, model: str = model, code: str = code) -> bool:
            named = item.camera.model_name == model  # its numbers mean the same
            return named and (code not in OF_DISTORTION or _distorts(item))

        for which in subsets(rig, concerns):
            for what, remedy, change in variants(rig.cameras[which[0]]):
                other = changed_lenses(rig, which, change)
                if other is None:
                    continue
                names = quoted(rig, which)
                yield Correction(
                    code=code,
                    rig=other,
                    cameras=which,
                    what=what.format(names=names),
                    remedy=remedy.format(names=names),
                )


OF_DISTORTION = ("undistorted", "distortion_sign", "distortion_order", "fisheye")
"""Mistakes that concern lenses with distortion only."""
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


def focal_corrections(rig: Rig, which: Sequence[int]) -> Iterator[Correction]:
    """The focal length of one of some cameras by a factor, for who cannot set it free.

    That of the water index is left to `rig_mistakes.lenses_in_water`.
    """
    for c in which:
        item = rig.cameras[c]
        for factor in FOCAL_FACTORS:
            if _is_of_water(item.port, factor):
                continue
            other = changed_lenses(rig, (c,), partial(with_focal, factor=factor))
            if other is None:
                continue
            way, other_way = ("long", "short")[:: 1 if factor < 1.0 else -1]
            yield Correction(
                code="focal",
                rig=other,
                what=f"the focal length of {item.name!r} is about "
                f"{abs(1.0 / factor - 1.0):.0%} too {way}, or another camera's too "
                f"{other_way}",
                remedy="check fx and fy: zoom, focus, video mode and image size must "
                "be those of the calibration",
            )


def _is_of_water(port: Port, factor: float) -> bool:
    """Whether a focal length by ``factor`` is that of the lens in air, from one that
    was calibrated in the water."""
    if not port.refracts:
        return False
    return abs(factor * port.n_water - 1.0) <= SAME_INDEX


def with_focal(camera: RigCamera, factor: float) -> RigCamera | None:
    params = np.array(camera.camera.params)
    params[list(camera.camera.focal_length_idxs())] *= factor
    return with_lens(camera, camera.camera.model_name, params)


def scaled_lens(camera: RigCamera, scale: float) -> RigCamera | None:
    """The lens of an image ``scale`` times as large."""
    params = np.array(camera.camera.params)
    params[: num_pinhole(camera)] *= scale
    return with_lens(camera, camera.camera.model_name, params)


def _resolutions(camera: RigCamera) -> Iterator[_Variant]:
    """The sizes for which the principal point is about in the middle, if not this one.

    Usual ones lie closer to each other than a principal point to the middle: all that
    it allows are given. Where only one of its coordinates allows a size, the image was
    cropped to another shape, and the other coordinate is in the middle.
    """
    lens = camera.camera
    both = (
        0.5 * lens.width / lens.principal_point_x,
        0.5 * lens.height / lens.principal_point_y,
    )
    if abs(math.log(both[0] / both[1])) > 2.0 * SAME_SCALE:
        yield from _crops(sorted({s for near in both for s in _usual_scales(near)}))
        return
    for scale in _usual_scales(both[0]):
        yield (
            f"the lens of {{names}} was calibrated at another resolution, of images "
            f"{1.0 / scale:.3g} times as large",
            "give the lens of {names} for the image size that is in the file: multiply "
            f"fx, fy, cx and cy by {scale:.3g}",
            partial(scaled_lens, scale=scale),
        )


def _usual_scales(near: float) -> list[float]:
    """The usual scales about ``near``, itself if there are none; empty if it is 1."""
    usual = min((1.0, *SCALES), key=lambda known: abs(math.log(known / near)))
    if usual == 1.0 and abs(math.log(near)) < SAME_SCALE:
        return []
    close = [known for known in SCALES if abs(math.log(known / near)) < SAME_SCALE]
    return close or [near]


def _crops(scales: Sequence[float]) -> Iterator[_Variant]:
    for scale in scales:

        def cropped(item: RigCamera, scale: float = scale) -> RigCamera | None:
            other = scaled_lens(item, scale)
            return None if other is None else _centred(other)

        yield (
            "the lens of {names} was calibrated at another resolution and shape of "
            f"image, {1.0 / scale:.3g} times as large and cropped otherwise",
            "give the lens of {names} for the image size that is in the file: multiply "
            f"fx, fy, cx and cy by {scale:.3g}, then subtract from cx and cy what was "
            "cropped at the left and the top",
            cropped,
        )


def _centred(item: RigCamera) -> RigCamera | None:
    params = np.array(item.camera.params)
    middle = 0.5 * item.camera.width, 0.5 * item.camera.height
    params[list(item.camera.principal_point_idxs())] = middle
    return with_lens(item, item.camera.model_name, params)


def _centers(_: RigCamera) -> Iterator[_Variant]:
    yield (
        "the principal point of {names} is in the middle of the image",
        "give cx and cy of {names} in pixels of these images: crop, image size and "
        "pixel origin must be those of the calibration",
        _centred,
    )
