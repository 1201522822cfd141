"""Is the rig the one that took the images? Wrong signs and swapped folders are quiet.

An inverted ``cam_from_rig`` or swapped folders still let COLMAP register every image,
with a plausible error: only the points that both cameras see in one frame tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import FlatPort, NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig import Rig
from uwsfm.sfm.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.rig_rotation import MIN_RIG_MATCHES, RigRotation, correct_rotations
from uwsfm.sfm.same_frame import PairMatches

MIN_IN_FRONT = 0.5
CLEARLY_IN_FRONT = 0.8
MAX_MISFIT = 0.05
"""Radians: about 3 degrees. A port tilted by 8 degrees bends the rays by 2."""
MAX_TURN_DEG = 5.0
"""A relative port tilt of 20 degrees; beyond it the rig itself is wrong."""
MAX_REST = 5e-3
"""Radians that no turn explains, median: a wrong direction of the baseline."""
SAME_TURN_DEG = 0.75
"""Tilted ports turn rays by so much: explanations closer than that are both named."""
POSE_HINT = (
    "check its rotation (order x, y, z, w; x_in_cam = R x_in_rig + translation_m) and "
    "the axes of translation_m, and that images of equal names were taken together"
)


def check_rig(rig: Rig, cam_from_rig: Array, pairs: Sequence[PairMatches]) -> None:
    """Refuse a rig that contradicts its images, and say what to change.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) to check.
        pairs: Matches of the same frame.

    Raises:
        InputError: too few matches to tell, swapped image folders, an inverted
            ``cam_from_rig``, a translation that is a camera position, or a pose that
            fits in no way.
    """
    _check_counts(rig, pairs)
    cameras = rig.refractive_cameras()
    for pair in pairs:
        if len(pair) < MIN_RIG_MATCHES:
            continue
        a, b = pair.camera_a, pair.camera_b
        b_from_a = relative_pose(cam_from_rig, a, b)
        in_front, misfit = fit_of(
            cameras[a], cameras[b], b_from_a, pair.xy_a, pair.xy_b
        )
        if in_front >= MIN_IN_FRONT and misfit <= MAX_MISFIT:
            continue
        names = rig.cameras[a].name, rig.cameras[b].name
        remedies = _remedies(rig, pair, b_from_a)
        if remedies:
            raise InputError(
                f"cameras {names[0]!r} and {names[1]!r} contradict their images: as "
                f"described, only {in_front:.0%} of the points that both see lie in "
                f"front of them; probably {' or '.join(remedies)}"
            )
        if in_front < MIN_IN_FRONT:
            raise InputError(
                f"only {in_front:.0%} of the points that cameras {names[0]!r} and "
                f"{names[1]!r} both see lie in front of them: check cam_from_rig of "
                f"{names[1]!r} (x_in_cam = R x_in_rig + translation_m)"
            )
        raise _misfit_error(*names, misfit)


def check_rotation(
    rig: Rig,
    cam_from_rig: Array,
    rotation: RigRotation,
    pairs: Sequence[PairMatches],
) -> None:
    """Refuse a rig that needs more than tilted ports could explain.

    A dome off its centre scales the image, which turns make up for badly and by much:
    where a centre is to be refined, nothing is refused.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) before any turn.
        rotation: The turns that fit them best.
        pairs: Matches of the same frame.

    Raises:
        InputError: names the camera, or ports that are missing.
    """
    if any(item.refine_center for item in rig.cameras):
        return
    worst = int(rotation.turn_deg.argmax())
    if rotation.turn_deg[worst] > MAX_TURN_DEG:
        seen = [p for p in pairs if worst in (p.camera_a, p.camera_b)]
        _check_ports(rig, cam_from_rig, max(seen, key=len))
        raise InputError(
            f"cam_from_rig of camera {rig.cameras[worst].name!r} does not fit the "
            f"images: it would have to turn by {rotation.turn_deg[worst]:.0f} degrees "
            f"or more, which no tilted port explains; {POSE_HINT}"
        )
    if rotation.misfit_after > MAX_REST:
        pair = max(pairs, key=len)
        _check_ports(rig, cam_from_rig, pair)
        names = rig.cameras[pair.camera_a].name, rig.cameras[pair.camera_b].name
        raise _misfit_error(*names, rotation.misfit_after)


def fit_of(
    camera_a: RefractiveCamera,
    camera_b: RefractiveCamera,
    b_from_a: Array,
    xy_a: Array,
    xy_b: Array,
) -> tuple[float, float]:
    """How well matched pixels (N, 2) fit two cameras at a relative pose (7,).

    Returns:
        The fraction of the points in front of both cameras, and the median angle by
        which rays miss their epipolar plane, radians. A pixel without a ray fits badly.
    """
    rays = ray_pairs(camera_a, camera_b, b_from_a, xy_a, xy_b)
    _, in_front = rays.triangulate()
    angles = np.abs(np.nan_to_num(rays.epipolar_angles(), nan=np.pi / 2))
    return float(np.mean(in_front)), float(np.median(angles))


def _misfit_error(name_a: str, name_b: str, misfit: float) -> InputError:
    """A rotation, or a direction of the baseline, that is grossly wrong."""
    return InputError(
        f"cam_from_rig of camera {name_b!r} is wrong by several degrees: rays of the "
        f"same point in {name_a!r} and {name_b!r} miss each other by "
        f"{np.degrees(misfit):.1f} degrees; {POSE_HINT}"
    )


def _check_ports(rig: Rig, cam_from_rig: Array, pair: PairMatches) -> None:
    """Refuse cameras without a port, where ports would make them fit."""
    a, b = pair.camera_a, pair.camera_b
    ideas = _missing_ports(rig, pair, relative_pose(cam_from_rig, a, b))
    for phrase, idea in ideas.items():
        if _turn_needed(*idea) <= MAX_TURN_DEG:
            raise InputError(
                f"cameras {rig.cameras[a].name!r} and {rig.cameras[b].name!r} "
                f"contradict their images: probably {phrase}; else cam_from_rig of "
                f"{rig.cameras[b].name!r} is wrong"
            )


def _check_counts(rig: Rig, pairs: Sequence[PairMatches]) -> None:
    best = max(pairs, key=len)
    if len(best) < MIN_RIG_MATCHES:
        a, b = rig.cameras[best.camera_a].name, rig.cameras[best.camera_b].name
        raise InputError(
            f"cameras {a!r} and {b!r} share only {len(best)} matches in all frames, at "
            f"least {MIN_RIG_MATCHES} are needed: do their images overlap, were images "
            "of equal names taken at the same time, is the water clear enough?"
        )


_Idea = tuple[tuple[RefractiveCamera, RefractiveCamera], Array, tuple[Array, Array]]
"""Two cameras, the second from the first (7,), and matched pixels (N, 2) of both."""


def _remedies(rig: Rig, pair: PairMatches, b_from_a: Array) -> list[str]:
    """What to change, one phrase each: the explanations that tilted ports allow."""
    a, b = rig.cameras[pair.camera_a], rig.cameras[pair.camera_b]
    given = pair.xy_a, pair.xy_b
    cameras = rig.refractive_cameras()
    both = cameras[pair.camera_a], cameras[pair.camera_b]
    ideas: dict[str, _Idea] = {
        f"the image folders {a.images!r} and {b.images!r} are swapped: exchange them "
        "in rig.yaml": (both, b_from_a, given[::-1])
    }
    if pair.camera_a == 0:  # the pose of a camera in the rig, not a relative one
        ideas[
            f"cam_from_rig of {b.name!r} is inverted: it must map from the rig to the "
            "camera (x_in_cam = R x_in_rig + translation_m)"
        ] = (both, rigid3.inverse(b_from_a), given)
        as_position = b_from_a.copy()
        as_position[4:] = -rigid3.rotate(b_from_a, b_from_a[4:])
        ideas[
            f"translation_m of {b.name!r} is the position of the camera: it must be "
            "-R times that"
        ] = (both, as_position, given)
    ideas |= _missing_ports(rig, pair, b_from_a)
    turns = {phrase: _turn_needed(*idea) for phrase, idea in ideas.items()}
    likely = sorted(turns, key=lambda phrase: turns[phrase])
    limit = min(MAX_TURN_DEG, turns[likely[0]] + SAME_TURN_DEG)
    return [phrase for phrase in likely if turns[phrase] <= limit]


def _missing_ports(rig: Rig, pair: PairMatches, b_from_a: Array) -> dict[str, _Idea]:
    """A lens that was calibrated in air, and that nobody said is behind a port.

    Any flat port will do for it: what it does to rays is mostly the water's.
    """
    sides = pair.camera_a, pair.camera_b
    bare = [c for c in sides if isinstance(rig.cameras[c].port, NoPort)]
    if not bare:
        return {}
    cameras = list(rig.refractive_cameras())
    for c in bare:
        cameras[c] = cameras[c].with_port(FlatPort())
    phrase = (
        f"the port of {' and '.join(repr(rig.cameras[c].name) for c in bare)} is "
        "missing in the rig file, where type none is for a lens that was calibrated in "
        "the water, not in air"
    )
    both = cameras[sides[0]], cameras[sides[1]]
    return {phrase: (both, b_from_a, (pair.xy_a, pair.xy_b))}


def _turn_needed(
    cameras: tuple[RefractiveCamera, RefractiveCamera],
    b_from_a: Array,
    pixels: tuple[Array, Array],
) -> float:
    """By how many degrees the second camera must turn to fit; inf if it never does."""
    in_front, misfit = fit_of(*cameras, b_from_a, *pixels)
    if in_front < CLEARLY_IN_FRONT or misfit > MAX_MISFIT:
        return np.inf
    pair = PairMatches(
        camera_a=0,
        camera_b=1,
        frame_idx=np.zeros(len(pixels[0]), dtype=np.int64),
        xy_a=pixels[0],
        xy_b=pixels[1],
    )
    poses = np.stack([rigid3.IDENTITY, b_from_a])
    rotation = correct_rotations(cameras, poses, [pair])
    return float(rotation.turn_deg[1]) if rotation.misfit_after <= MAX_REST else np.inf
