"""Is the rig the one that took the images? Wrong signs and swapped folders are quiet.

An inverted ``cam_from_rig`` or swapped folders still let COLMAP register every image,
with a plausible error: only the points that both cameras see in one frame tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from uwsfm.errors import ExplainedInputError, InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.sfm.poses.epipolar import relative_pose
from uwsfm.sfm.poses.relative_pose import estimate_relative_pose
from uwsfm.sfm.rig_checks.lens_mistakes import focal_corrections
from uwsfm.sfm.rig_checks.mirrored_camera import mirrored_camera
from uwsfm.sfm.rig_checks.moved_ports import moved_ports
from uwsfm.sfm.rig_checks.rig_ideas import (
    MAX_MISFIT,
    MAX_REST,
    MAX_TURN_DEG,
    Shifted,
    clean_remedies,
    fit_of,
    likely,
    remedies,
    shift_ideas,
)
from uwsfm.sfm.rig_checks.rig_rotation import (
    MIN_RIG_MATCHES,
    NOTABLE_TURN_DEG,
    RigRotation,
)
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches

MIN_IN_FRONT = 0.5
MOST_OF_PORTS, MOST_OF_PORTS_DEG = 0.08, 9.5
"""Misfit, radians, and turn of two ports tilted by 15 degrees in opposite directions:
beyond them ports are no explanation."""
SAME_PLACEMENT = 0.9
"""Share of the matches of same frames, each frame's of which agree with each other,
that one placement of two cameras explains: 0.99 where the rig file's is wrong, 0.6 to
0.8 where images of equal names were not taken together."""
CLEARLY_ONE_PLACEMENT = 0.15
"""By so much the share of single frames, median, must be larger than that of all."""
LENS_MATCHES = 400
"""Are enough to see whether another focal length makes one placement fit."""
POSE_HINT = (
    "check its rotation (order x, y, z, w; x_in_cam = R x_in_rig + translation_m) and "
    "the axes of translation_m, and that images of equal names were taken together"
)

Successive = Callable[[], Sequence[PairMatches]]
"""Matches of each camera's images with its next ones."""


def check_rig(
    rig: Rig,
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
    shifted: Shifted | None = None,
    successive: Successive | None = None,
) -> None:
    """Refuse a rig that contradicts its images, and say what to change.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) to check.
        pairs: Matches of the same frame.
        shifted: Gives those of neighbouring frames; None: there are none.
        successive: Gives those of each camera with itself, which alone are left where
            the images of one camera are mirrored; None: there are none.

    Raises:
        InputError: too few matches to tell, or a pose that does not fit; names the
            mistake in the rig file or in the images that explains it.
    """
    _check_counts(rig, cam_from_rig, pairs, shifted, successive)
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
        found = remedies(rig, cam_from_rig, pair, shifted) or _apart(rig, pair)
        turned = in_front >= MIN_IN_FRONT and misfit <= MOST_OF_PORTS
        if _may_be_ports(rig, cam_from_rig, pair, found if turned else None):
            continue
        if found:
            evidence = (
                f"only {in_front:.0%} of the points that both see lie in front of them"
                if in_front < MIN_IN_FRONT
                else f"rays of the same point miss by {np.degrees(misfit):.1f} degrees"
            )
            raise ExplainedInputError(
                f"cameras {names[0]!r} and {names[1]!r} contradict their images: as "
                f"described, {evidence}; probably {_words(found)}",
                tuple(found),
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
    shifted: Shifted | None = None,
) -> None:
    """Refuse a rig that needs more than tilted ports could explain.

    A dome off its centre scales the image, which turns make up for badly and by much:
    where a centre is to be refined, nothing is refused.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) before any turn.
        rotation: The turns that fit them best.
        pairs: Matches of the same frame.
        shifted: As of `check_rig`.

    Raises:
        InputError: names the mistake that explains the matches, or the camera.
    """
    if any(item.refine_center for item in rig.cameras):
        return
    worst = int(rotation.turn_deg.argmax())
    turn = float(rotation.turn_deg[worst])
    if turn <= MAX_TURN_DEG and rotation.misfit_after <= MAX_REST:
        return
    pair = max(pairs, key=len)
    if turn > MAX_TURN_DEG:
        seen = [p for p in pairs if worst in (p.camera_a, p.camera_b)]
        pair = max(seen, key=len)
    a, b = rig.cameras[pair.camera_a].name, rig.cameras[pair.camera_b].name
    found = remedies(rig, cam_from_rig, pair, shifted) or _apart(rig, pair)
    by_ports = found if turn <= MOST_OF_PORTS_DEG else None
    if _may_be_ports(rig, cam_from_rig, pair, by_ports):
        return
    if found:
        raise ExplainedInputError(
            f"cameras {a!r} and {b!r} contradict their images: probably "
            f"{_words(found)}; else cam_from_rig of {b!r} is wrong",
            tuple(found),
        )
    if turn > MAX_TURN_DEG:
        raise InputError(
            f"cam_from_rig of camera {rig.cameras[worst].name!r} does not fit the "
            f"images: it would have to turn by {turn:.0f} degrees or more, which no "
            f"tilted port explains; {POSE_HINT}"
        )
    raise _misfit_error(a, b, rotation.misfit_after)


def turn_causes(
    rig: Rig,
    cam_from_rig: Array,
    rotation: RigRotation,
    pairs: Sequence[PairMatches],
    shifted: Shifted | None = None,
) -> dict[int, str]:
    """Mistakes that a turn may have healed, though nothing was refused.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) before any turn.
        rotation: The turns that fit them best.
        pairs: Matches of the same frame.
        shifted: As of `check_rig`.

    Returns:
        Clauses by the numbers of the cameras whose turn is notable: only mistakes
        without which hardly any turn is left. None where a dome's centre is refined.
    """
    if any(item.refine_center for item in rig.cameras):
        return {}
    causes = {}
    for c in np.flatnonzero(rotation.turn_deg > NOTABLE_TURN_DEG).tolist():
        seen = [pair for pair in pairs if c in (pair.camera_a, pair.camera_b)]
        found = clean_remedies(rig, cam_from_rig, max(seen, key=len), shifted)
        if found:
            causes[c] = _words(found)
    return causes


def _apart(rig: Rig, pair: PairMatches) -> dict[str, str]:
    """Images that were not taken together: no placement of two cameras fits them all,
    though in each frame one does. As of `remedies`.

    A wrong lens is like that, too, as a frame's own placement takes up a part of it;
    but then one placement fits all frames with another focal length.
    """
    share = _placed(rig, pair)
    if share >= SAME_PLACEMENT:
        return {}
    frames = [
        pair.selected(pair.frame_idx == frame) for frame in np.unique(pair.frame_idx)
    ]
    alone = [_placed(rig, one) for one in frames if len(one) >= MIN_RIG_MATCHES]
    if len(alone) < 2 or np.median(alone) < share + CLEARLY_ONE_PLACEMENT:
        return {}
    few = pair.thinned(LENS_MATCHES)
    first, second = (rig.cameras[c].name for c in (pair.camera_a, pair.camera_b))
    for lens in focal_corrections(rig, [pair.camera_b]):
        if _placed(lens.rig, few) >= SAME_PLACEMENT:
            phrase = (
                f"the lens of {second!r} or {first!r}, for with another focal length "
                "one placement fits all frames: check fx, fy, cx, cy and the image "
                "size they were calibrated for"
            )
            return {"focal": phrase}
    phrase = (
        f"images of {first!r} and {second!r} with equal names were not taken together, "
        f"for no single placement fits more than {share:.0%} of the matches: pair the "
        "images anew, one camera may be late by many frames"
    )
    return {"frames_shifted": phrase}


def _placed(rig: Rig, pair: PairMatches) -> float:
    """Share of the matches of two cameras that their best placement fits."""
    cameras = rig.refractive_cameras()
    a, b = cameras[pair.camera_a], cameras[pair.camera_b]
    found = estimate_relative_pose(a, b, pair.xy_a, pair.xy_b)
    return 0.0 if found is None else found.num_inliers / len(pair)


def _may_be_ports(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, found: Mapping[str, str] | None
) -> bool:
    """Whether the ports explain it as well as what was ``found``: a focal length looks
    like a port distance, and a turn of a camera or a frame's motion like a tilt. Ports
    that are likely and leave noise alone go before anything else.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras.
        pair: Matches of two of them.
        found: As of `remedies`; None: the cameras turn more than most ports can turn
            them, so that only likely ones count.
    """
    moved = moved_ports(rig, cam_from_rig, pair, leaning=True)
    if moved is None or not moved.explain:
        return False
    similar = found is not None and set(found) <= {
        "focal",
        "frames_shifted",
        "rotation",
    }
    return similar or moved.are_likely


def _misfit_error(name_a: str, name_b: str, misfit: float) -> InputError:
    """A rotation, or a direction of the baseline, that is grossly wrong."""
    return InputError(
        f"cam_from_rig of camera {name_b!r} is wrong by several degrees: rays of the "
        f"same point in {name_a!r} and {name_b!r} miss each other by "
        f"{np.degrees(misfit):.1f} degrees; {POSE_HINT}"
    )


def _check_counts(
    rig: Rig,
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
    shifted: Shifted | None,
    successive: Successive | None,
) -> None:
    best = max(pairs, key=len)
    if len(best) >= MIN_RIG_MATCHES:
        return
    a, b = rig.cameras[best.camera_a].name, rig.cameras[best.camera_b].name
    few = (
        f"cameras {a!r} and {b!r} share only {len(best)} matches in all frames, at "
        f"least {MIN_RIG_MATCHES} are needed: "
    )
    found = likely(shift_ideas(rig, cam_from_rig, best, shifted))
    if found:
        raise ExplainedInputError(f"{few}probably {_words(found)}", tuple(found))
    if successive is not None:
        flipped = mirrored_camera(rig, cam_from_rig, successive())
        if flipped is not None:
            raise ExplainedInputError(
                f"{few}probably {flipped.what}, as their motions show: "
                f"{flipped.remedy}",
                (flipped.code,),
            )
    raise InputError(
        f"{few}do their images overlap, were images of equal names taken at the same "
        "time, is one camera mirrored, is the water clear enough?"
    )


def _words(found: Mapping[str, str]) -> str:
    return "; or ".join(found.values())
