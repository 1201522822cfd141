"""Each mistake that people make, undone: a rig and observations to try.

Mistakes of the rig file alone are in `uwsfm.sfm.rig_checks.rig_mistakes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort, Port
from uwsfm.rig.rig import Rig, RigCamera
from uwsfm.scene import Scene
from uwsfm.sfm.correction import Correction, quoted, subsets
from uwsfm.sfm.rig_checks.lens_mistakes import distortion, num_pinhole
from uwsfm.sfm.rig_checks.rig_mistakes import (
    SHIFTS,
    corrected_pixels,
    corrections,
    shift_words,
)
from uwsfm.trust.trials import Fit, adjusted

RARER = {"dome_as_flat": 1.0, "water_index": 0.6}
"""Handicap of what looks like a lens calibrated in the water, and happens less; a dome,
whose centre is free, always fits better."""
MIN_FRAMES_LEFT = 2
"""On each side of a frame from which on something changed."""
UNITS = {
    1000.0: "millimetres",
    100.0: "centimetres",
    39.37: "inches",
    3.281: "feet",
}
"""A length in metres is so many of them; the factor of a board square is any."""
SAME_UNIT = 2.0
"""Ports tell a factor this well: the ruler is no better."""
MAX_DISTANCE_M = 0.15
"""Of a usual port."""
MAX_THICKNESS_M = 0.1
"""Glass of a usual port."""
RARE = 6.0
"""Handicap of a port that no usual housing has."""
PORT_FACTORS = (10.0, 0.1, 25.4, 1.0 / 25.4)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One explanation: a rig, observations, and what may move."""

    code: str
    what: str
    """The mistake, a clause."""
    remedy: str
    """What to change, an imperative clause."""
    rig: Rig
    seen: Callable[[Scene], Scene] = lambda scene: scene
    """The observations put right, and poses to start from."""
    options: dict[str, Any] = field(default_factory=dict)
    """Further fields of `CalibrateOptions`."""
    cameras: tuple[int, ...] = ()
    """The cameras that have the mistake; empty: the rig as a whole."""
    first: int = 0
    """The frame from which on something changed."""
    handicap: float = 0.0
    """What a trial that frees numbers must be better by: it always fits better."""
    estimate: Callable[[Fit], str] = lambda fit: ""
    """What the freed numbers came out as, in words."""

    def fit(self, scene: Scene, options: dict[str, Any]) -> Fit | None:
        """The rig adjusted to the observations; None where nothing fits."""
        return adjusted(self.seen(scene), self.rig, **{**options, **self.options})


def trials(rig: Rig, num_frames: int) -> Iterator[Trial]:
    """Every mistake, singly.

    Args:
        rig: As given.
        num_frames: Of the observations.
    """
    for correction in corrections(rig):
        yield _of_correction(correction)
    yield from _free_lenses(rig)
    yield from _free_distortions(rig)
    yield from _free_rotation(rig)
    yield from _free_ports(rig)
    yield from shifts(rig, num_frames)


def _of_correction(correction: Correction) -> Trial:
    return Trial(
        code=correction.code,
        what=correction.what,
        remedy=correction.remedy,
        rig=correction.rig,
        cameras=correction.cameras,
        seen=lambda scene: _corrected(scene, correction),
        handicap=RARER.get(correction.code, 0.0),
    )


def _corrected(scene: Scene, correction: Correction) -> Scene:
    if correction.exchanged is False and correction.flipped is None:
        return scene
    sizes = np.array([(c.width, c.height) for c in scene.cameras])
    camera, xy = corrected_pixels(correction, sizes, scene.camera_idx, scene.xy)
    poses = scene.rig_from_world
    if correction.exchanged:
        poses = rigid3.compose(scene.cam_from_rig[1], poses)
    if correction.flipped is not None:
        poses = _mirrored(poses, correction.flipped)
    return replace(scene, camera_idx=camera, xy=xy, rig_from_world=poses)


def _mirrored(poses: Array, axis: int) -> Array:
    """Poses (F, 7) in a world that is mirrored as the images are."""
    signs = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    signs[axis] = 1.0
    signs[4 + axis] = -1.0
    return poses * signs


FREE = 1.0
"""Handicap of two numbers that are set free for each camera."""
FOCAL = {"refine_focal": True, "focal_stddev": 0.5}
CENTER = {"refine_principal_point": True, "principal_point_stddev_px": 200.0}
DISTORTION_STDDEV = 0.5
"""Priors that hold nothing but what no image shows."""


def _free_lenses(rig: Rig) -> Iterator[Trial]:
    """Focal length and principal point of all cameras, then of each alone."""
    for which in subsets(rig, lambda _: True):
        names = quoted(rig, which)
        free = tuple(c in which for c in range(len(rig.cameras)))
        yield Trial(
            code="focal",
            what=f"the focal length of {names} is wrong",
            remedy="check fx and fy: zoom, focus, video mode and image size must be "
            "those of the calibration",
            rig=rig,
            options={**FOCAL, "refine_focal": free},
            cameras=which,
            handicap=FREE,
            estimate=partial(_lens_words, rig, which, slice(0, 2), "fx, fy"),
        )
        yield Trial(
            code="principal_point",
            what=f"the principal point of {names} is wrong",
            remedy="check cx and cy: crop, image size and pixel origin must be those "
            "of the calibration",
            rig=rig,
            options={**CENTER, "refine_principal_point": free},
            cameras=which,
            handicap=FREE,
            estimate=partial(_lens_words, rig, which, slice(2, 4), "cx, cy"),
        )


def _free_distortions(rig: Rig) -> Iterator[Trial]:
    """The distortion of all cameras, then of each alone: the numbers are wrong, by no
    order or sign that has a name."""
    for which in subsets(rig, lambda _: True):
        yield Trial(
            code="distortion",
            what=f"the distortion of {quoted(rig, which)}, as given, does not fit",
            remedy="check these coefficients, their order and their sign, or calibrate "
            "the lens anew",
            rig=rig,
            options={
                "refine_distortion": tuple(c in which for c in range(len(rig.cameras))),
                "distortion_stddev": DISTORTION_STDDEV,
            },
            cameras=which,
            handicap=FREE * len(which),
            estimate=partial(_distortion_words, rig, which),
        )


def _free_rotation(rig: Rig) -> Iterator[Trial]:
    """The rotation between the cameras, where the rig file holds it."""
    if rig.cam_from_rig is None or len(rig.cameras) < 2 or rig.refine_cam_from_rig:
        return
    names = " and ".join(repr(camera.name) for camera in rig.cameras[1:])
    yield Trial(
        code="rotation",
        what=f"cam_from_rig of {names}, which is held, is wrong",
        remedy="write refine_cam_from_rig: true, or calibrate the placement anew",
        rig=replace(rig, refine_cam_from_rig=True),
        handicap=FREE,
        estimate=lambda fit: f" (it turns by {fit.turn_deg:.2f} degrees)",
    )


PORT_PARTS = (("distance",), ("normal",), ("distance", "normal"), ("center",))
"""What a rig file may hold of a port, and what may be wrong at once."""


def _free_ports(rig: Rig) -> Iterator[Trial]:
    """What the rig file holds of the ports, of all cameras and of each alone."""
    for parts in PORT_PARTS:
        for which in subsets(rig, partial(_holds, parts=parts)):
            flags: dict[str, Any] = {f"refine_{part}": True for part in parts}
            names, held = quoted(rig, which), " and ".join(parts)
            yield Trial(
                code="held_port",
                what=f"the port {held} of {names}, as held, "
                f"{'are' if len(parts) > 1 else 'is'} wrong",
                remedy=f"add {held} to refine of the port of {names}, or measure the "
                "port again",
                rig=replace(
                    rig,
                    cameras=tuple(
                        replace(item, **flags) if c in which else item
                        for c, item in enumerate(rig.cameras)
                    ),
                ),
                cameras=which,
                handicap=FREE * len(parts),
                estimate=partial(_port_words, rig, which, parts),
            )


def _holds(item: RigCamera, parts: tuple[str, ...]) -> bool:
    held = not any(getattr(item, f"refine_{part}") for part in parts)
    return held and all(part in item.port.refinable for part in parts)


def _port_words(
    rig: Rig, which: tuple[int, ...], parts: tuple[str, ...], fit: Fit
) -> str:
    """The freed numbers of some ports, and what the rig file has."""
    pairs = [(rig.cameras[c].port, fit.scene.ports[c]) for c in which]
    words = [_port_change(*pair, part) for part in parts for pair in pairs]
    return f" ({'; '.join(words)})"


def _port_change(old: Port, new: Port, part: str) -> str:
    """A changed distance or dome centre in millimetres, or the turn of a normal."""
    before, after = (np.atleast_1d(getattr(port, part)) for port in (old, new))
    if part == "normal":
        turn = np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after)
        return f"it turns by {np.degrees(turn):.1f} degrees"
    was, to = (", ".join(f"{1e3 * v:.0f}" for v in value) for value in (before, after))
    return f"{to} mm for {was} mm"


def _lens_words(
    rig: Rig, which: tuple[int, ...], part: slice, names: str, fit: Fit
) -> str:
    """What two numbers of some lenses came out as, and what they were."""
    given = rig.refractive_cameras()
    words = [
        f"{', '.join(f'{value:.1f}' for value in fit.scene.cameras[c].lens[part])} for "
        f"{', '.join(f'{value:.1f}' for value in given[c].lens[part])}"
        for c in which
    ]
    return f" ({names}: {'; '.join(words)})"


def _distortion_words(rig: Rig, which: tuple[int, ...], fit: Fit) -> str:
    """Which coefficients of some lenses came out as what, and what they were."""
    words = []
    for c in which:
        item = rig.cameras[c]
        first = num_pinhole(item)
        names = item.camera.params_info.split(", ")[first:]
        new = fit.scene.cameras[c].camera.params[first:]
        pairs = zip(names, new, distortion(item), strict=True)
        words.append(", ".join(f"{n} {to:.4f} for {was:.4f}" for n, to, was in pairs))
    return f" ({'; '.join(words)})"


def shifts(
    rig: Rig, num_frames: int, first: int = 0, first_name: str = ""
) -> Iterator[Trial]:
    """One camera late or early by some frames, from frame ``first`` on."""
    since = f" from frame {first_name} on" if first else ""
    for camera in range(1, len(rig.cameras)):
        name = rig.cameras[camera].name
        for shift in SHIFTS:
            if num_frames - first - abs(shift) < MIN_FRAMES_LEFT:
                continue
            what, remedy = shift_words(name, shift, since)
            yield Trial(
                code="frames_shifted",
                what=what,
                remedy=f"{remedy}; one may be missing",
                rig=rig,
                seen=partial(shifted, camera=camera, shift=shift, first=first),
            )


def shifted(scene: Scene, camera: int, shift: int, first: int) -> Scene:
    """A scene in which the images of one camera belong to other frames."""
    late = (scene.camera_idx == camera) & (scene.frame_idx >= first)
    frame = np.where(late, scene.frame_idx + shift, scene.frame_idx)
    inside = (frame >= 0) & (frame < scene.num_frames)
    moved = replace(scene, frame_idx=np.clip(frame, 0, scene.num_frames - 1))
    return moved.select(inside)[0]


def length_trials(rig: Rig, distances_m: list[float]) -> Iterator[Trial]:
    """The baseline or the ports in another unit: points and ports grow with the one.

    Scale is a gauge: no image shows it, and only ports far from the ruler's do.

    Args:
        rig: As given.
        distances_m: (C,) where the flat ports of the rig came out.
    """
    flat = [c.port for c in rig.cameras if isinstance(c.port, PlanePort)]
    if rig.cam_from_rig is None or len(rig.cameras) < 2 or not flat or not distances_m:
        return
    glass = float(np.mean([port.thickness / port.n_glass for port in flat]))
    given = float(np.mean([port.distance for port in flat]))
    # Behind thick glass a port looks as far away as it and its glass are.
    factor = (float(np.mean(distances_m)) + glass) / (given + glass + 1e-4)
    assert rig.baseline_m is not None
    if factor > SAME_UNIT or factor < 1.0 / SAME_UNIT:
        code, words = _unit_of(factor)
        yield Trial(
            code=code,
            what=f"the baseline is roughly {rig.baseline_m / factor:.1g} m, by what "
            f"the rig file says of the ports, and not {rig.baseline_m:.3g} m",
            remedy=f"check the unit of translation_m: {words}",
            rig=_shorter(rig, factor),
            handicap=0.0 if given < MAX_DISTANCE_M else RARE,
        )
    for times in PORT_FACTORS:
        yield Trial(
            code="length_unit",
            what=f"the port distances are {times:.3g} times those of the rig file",
            remedy="check the unit of distance_m, which is metres",
            rig=_with_port_length(rig, "distance", times),
            handicap=_rarity([times * p.distance for p in flat], MAX_DISTANCE_M),
        )
        glass_m = [times * p.thickness for p in flat if p.has("thickness")]
        if not glass_m:
            continue
        yield Trial(
            code="length_unit",
            what=f"the glass is {times:.3g} times as thick as in the rig file",
            remedy="check the unit of thickness_m, which is metres",
            rig=_with_port_length(rig, "thickness", times),
            handicap=_rarity(glass_m, MAX_THICKNESS_M),
        )


def _rarity(lengths_m: list[float], most_m: float) -> float:
    """Handicap of such ports."""
    usual = min(lengths_m) > 1e-3 and max(lengths_m) < most_m
    return FREE if usual else RARE


def _unit_of(factor: float) -> tuple[str, str]:
    """The kind of mistake of a length that is ``factor`` times too long, in words."""
    if 1.0 / 4.0 < factor < 4.0:
        return "baseline", f"it is about {factor:.2g} times as long as the ports allow"
    units = [
        name
        for times, name in UNITS.items()
        if 1.0 / SAME_UNIT < factor / times < SAME_UNIT
    ]
    near = f", as in {' or '.join(units)}" if units else ", as in squares of a board"
    if factor < 1.0:
        near = ""
    return "length_unit", (
        f"by the ports it is about {factor:.2g} times too long{near}"
        if factor > 1.0
        else f"by the ports it is about {1.0 / factor:.2g} times too short"
    )


def _shorter(rig: Rig, factor: float) -> Rig:
    assert rig.cam_from_rig is not None and rig.baseline_m is not None
    poses = rig.cam_from_rig.copy()
    poses[:, 4:] /= factor
    return replace(
        rig, cam_from_rig=poses, baseline_m=float(np.linalg.norm(poses[1, 4:]))
    )


def _with_port_length(rig: Rig, name: str, times: float) -> Rig:
    def longer(port: Port) -> Port:
        if not port.has(name):
            return port
        return port.changed(**{name: times * getattr(port, name)})

    cameras = [replace(item, port=longer(item.port)) for item in rig.cameras]
    return replace(rig, cameras=tuple(cameras))
