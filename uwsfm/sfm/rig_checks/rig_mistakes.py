"""What people get wrong in a rig file, and each mistake undone.

Nothing here looks at images: a `Correction` is a rig as it would be without one
mistake. Who has observations tries them: `rig_check` on matches of single frames,
`uwsfm.trust.diagnosis` on a whole dive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort, FlatPort, NoPort, Port
from uwsfm.rig.file import FRESH_WATER
from uwsfm.rig.rig import Rig, refine_flags
from uwsfm.scene import IndexArray
from uwsfm.sfm.correction import Correction, quoted, subsets
from uwsfm.sfm.rig_checks.lens_mistakes import (
    changed_lenses,
    lens_corrections,
    with_focal,
)

DOME_RADII_M = (0.05, 0.1)
"""Of domes on the market, about; any radius undoes the most of a wrong flat port."""
SHIFTS = (1, -1, 2, -2, 3, -3)
"""Frames that one camera may be late or early."""

MIRRORED = ("left to right", "top to bottom")
"""Along each axis of the image, in words."""
UNMIRROR = "turn off the mirroring where they were exported, or flip them back"


def corrections(rig: Rig) -> list[Correction]:
    """Every mistake undone, singly: of the lenses, the ports and the placement."""
    found = [*port_corrections(rig), *lens_corrections(rig), *pose_corrections(rig)]
    return [*found, *image_corrections(rig)]


def _with_ports(
    rig: Rig, which: tuple[int, ...], change: Callable[[Port], Port], free: bool = False
) -> Rig:
    cameras = list(rig.cameras)
    for c in which:
        port = change(cameras[c].port)
        cameras[c] = replace(
            cameras[c],
            port=port,
            **refine_flags(
                name
                for name in port.refinable
                if free or getattr(cameras[c], f"refine_{name}")
            ),
        )
    return replace(rig, cameras=tuple(cameras))


def port_corrections(rig: Rig) -> Iterator[Correction]:
    """The port itself: none, missing, of the other kind, in another water."""
    for which in subsets(rig, lambda c: c.port.refracts):
        yield _in_water(rig, which, _with_ports(rig, which, lambda _: NoPort()))
    yield from missing_ports(rig)
    yield from _other_kinds(rig)
    yield from _other_waters(rig)


def _in_water(rig: Rig, which: tuple[int, ...], other: Rig) -> Correction:
    names = quoted(rig, which)
    return Correction(
        code="port_none",
        rig=other,
        cameras=which,
        what=f"the lens of {names} was calibrated in the water, though the rig file "
        "has a port",
        remedy=f"write port: {{type: none}} for {names}, or give the lens as "
        "calibrated in air",
    )


def lenses_in_water(rig: Rig) -> Iterator[Correction]:
    """One lens calibrated in the water, with the most of it undone: its focal length.

    Closer than no port at all, where the distortion is that of the lens in air.
    """
    for c, item in enumerate(rig.cameras):
        if not item.port.refracts:
            continue
        factor = 1.0 / item.port.n_water
        other = changed_lenses(rig, (c,), partial(with_focal, factor=factor))
        if other is not None:
            found = _in_water(rig, (c,), other)
            zoomed = f"; else its focal length is {1.0 / factor - 1.0:.0%} too long"
            yield replace(found, remedy=found.remedy + zoomed)


def missing_ports(rig: Rig) -> Iterator[Correction]:
    """A lens that was calibrated in air, and whose port is not in the rig file.

    Any flat port will do for it: what it does to rays is mostly the water's.
    """
    for which in subsets(rig, lambda c: not c.port.refracts)[:1]:
        names = quoted(rig, which)
        yield Correction(
            code="port_missing",
            rig=_with_ports(rig, which, lambda _: FlatPort(), free=True),
            cameras=which,
            what=f"the port of {names} is missing in the rig file, where type none is "
            "for a lens that was calibrated in the water, not in air",
            remedy=f"describe the port of {names} there",
        )


def _other_kinds(rig: Rig) -> Iterator[Correction]:
    for which in subsets(rig, lambda c: isinstance(c.port, FlatPort)):
        names = quoted(rig, which)
        for radius in DOME_RADII_M:
            yield Correction(
                code="dome_as_flat",
                rig=_with_ports(rig, which, _as_dome(radius), free=True),
                cameras=which,
                what=f"the port of {names} is a dome, and not flat",
                remedy=f"describe the port of {names} as type: dome",
            )
    for which in subsets(rig, lambda c: isinstance(c.port, DomePort)):
        names = quoted(rig, which)
        yield Correction(
            code="flat_as_dome",
            rig=_with_ports(rig, which, _as_flat, free=True),
            cameras=which,
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
    behind = tuple(c for c, item in enumerate(rig.cameras) if item.port.refracts)
    if not behind:
        return
    given = rig.cameras[behind[0]].port.n_water
    for index in (FRESH_WATER, 1.0):
        if abs(index - given) < 0.02:
            continue
        medium = "air" if index == 1.0 else "water"

        def filled(port: Port, index: float = index) -> Port:
            return port.changed(n_water=index)

        yield Correction(
            code="water_index",
            rig=_with_ports(rig, behind, filled),
            what=f"the water index is {index:g}, that of {medium}, and not {given:g}",
            remedy=f"write water: {{refractive_index: {index:g}}}",
        )


def pose_corrections(rig: Rig) -> Iterator[Correction]:
    """The placement: `cam_from_rig` of every camera but the first, read otherwise."""
    poses = rig.cam_from_rig
    if poses is None or len(poses) < 2:
        return
    names = quoted(rig, tuple(range(1, len(poses))))
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
        "translation_m of {names} is the position of the camera, or has the wrong sign",
        "write -R times that position, R being the rotation, as translation_m of "
        "{names} (x_in_cam = R x_in_rig + translation_m)",
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
        remedy="exchange them in the rig file",
        exchanged=True,
    )
    for axis, text in enumerate(MIRRORED):
        yield Correction(
            code="mirrored",
            rig=rig,
            what=f"the images are mirrored, {text}",
            remedy=UNMIRROR,
            flipped=axis,
        )


def shift_words(name: str, shift: int, since: str = "") -> tuple[str, str]:
    """What is wrong, and what to do, if a camera's images belong ``shift`` frames
    later than their names say."""
    way, side = ("early", "after") if shift > 0 else ("late", "before")
    count = f"{abs(shift)} frame{'s' if abs(shift) > 1 else ''}"
    return (
        f"the images of {name!r} are {count} {way}{since} (each belongs {count} {side} "
        "the one of its name)",
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
