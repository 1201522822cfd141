"""Is the rig the one that took the images? Wrong signs and swapped folders are quiet.

An inverted ``cam_from_rig`` or swapped folders still let COLMAP register every image,
with a plausible error: only the points that both cameras see in one frame tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwsfm.errors import ExplainedInputError, InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig import Rig
from uwsfm.sfm.correction import Correction
from uwsfm.sfm.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.lens_mistakes import focal_corrections
from uwsfm.sfm.moved_ports import ports_explain
from uwsfm.sfm.rig_mistakes import (
    SHIFTS,
    corrected_pixels,
    corrections,
    shift_words,
)
from uwsfm.sfm.rig_rotation import MIN_RIG_MATCHES, RigRotation, correct_rotations
from uwsfm.sfm.same_frame import PairMatches

MIN_IN_FRONT = 0.5
CLEARLY_IN_FRONT = 0.8
MAX_MISFIT = 0.05
"""Radians: about 3 degrees. A port tilted by 8 degrees bends the rays by 2."""
MAX_TURN_DEG = 5.0
"""A relative port tilt of 20 degrees; beyond it the rig itself is wrong."""
MOST_OF_PORTS, MOST_OF_PORTS_DEG = 0.08, 9.5
"""Misfit, radians, and turn of two ports tilted by 15 degrees in opposite directions:
beyond them ports are no explanation."""
MAX_REST = 5e-3
"""Radians that no turn explains, median: a wrong direction of the baseline."""
SAME_TURN_DEG = 0.75
"""Tilted ports turn rays by so much: explanations closer than that are both named."""
SAME_MISFIT = 1.5
"""So is an explanation whose rays miss by so many times the best one's."""
LEAST_MISFIT = 2e-4
"""Radians: a fifth of a pixel, noise."""
CLEARLY_BETTER = 3.0
"""So many of these an explanation must gain against the rig as given."""
MAX_PHRASES = 3
IDEA_MATCHES = 800
"""Of a pair of cameras are enough to compare explanations."""
POSE_HINT = (
    "check its rotation (order x, y, z, w; x_in_cam = R x_in_rig + translation_m) and "
    "the axes of translation_m, and that images of equal names were taken together"
)


Shifted = Callable[[int], Sequence[PairMatches]]
"""Matches between each frame of a camera and the frame of another so much later."""


def check_rig(
    rig: Rig,
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
    shifted: Shifted | None = None,
) -> None:
    """Refuse a rig that contradicts its images, and say what to change.

    Args:
        rig: Cameras and initial ports.
        cam_from_rig: Poses (C, 7) to check.
        pairs: Matches of the same frame.
        shifted: Gives those of neighbouring frames; None: there are none.

    Raises:
        InputError: too few matches to tell, or a pose that does not fit; names the
            mistake in the rig file or in the images that explains it.
    """
    _check_counts(rig, cam_from_rig, pairs, shifted)
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
        found = remedies(rig, cam_from_rig, pair, shifted)
        turned = in_front >= MIN_IN_FRONT and misfit <= MOST_OF_PORTS
        if turned and _may_be_ports(rig, cam_from_rig, pair, found):
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
    found = remedies(rig, cam_from_rig, pair, shifted)
    if turn <= MOST_OF_PORTS_DEG and _may_be_ports(rig, cam_from_rig, pair, found):
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


def _may_be_ports(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, found: Mapping[str, str]
) -> bool:
    """Whether the ports explain it as well as what was ``found``: a focal length looks
    like a port distance, and a frame's motion like a tilt."""
    similar = set(found) <= {"focal", "frames_shifted"}
    return similar and ports_explain(rig, cam_from_rig, pair)


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


def _check_counts(
    rig: Rig,
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
    shifted: Shifted | None,
) -> None:
    best = max(pairs, key=len)
    if len(best) >= MIN_RIG_MATCHES:
        return
    a, b = rig.cameras[best.camera_a].name, rig.cameras[best.camera_b].name
    few = (
        f"cameras {a!r} and {b!r} share only {len(best)} matches in all frames, at "
        f"least {MIN_RIG_MATCHES} are needed: "
    )
    found = _likely(_shift_ideas(rig, cam_from_rig, best, shifted))
    if found:
        raise ExplainedInputError(f"{few}probably {_words(found)}", tuple(found))
    raise InputError(
        f"{few}do their images overlap, were images of equal names taken at the same "
        "time, is one camera mirrored, is the water clear enough?"
    )


@dataclass(frozen=True)
class _Idea:
    """An explanation, and how well two cameras fit their matches with it."""

    code: str
    phrase: str
    turn_deg: float
    misfit: float
    """Median angle between rays and their epipolar plane after the turn, radians."""

    def badness(self, best_misfit: float) -> float:
        return self.turn_deg / SAME_TURN_DEG + math.log(
            max(self.misfit, LEAST_MISFIT) / max(best_misfit, LEAST_MISFIT)
        ) / math.log(SAME_MISFIT)


def remedies(
    rig: Rig,
    cam_from_rig: Array,
    pair: PairMatches,
    shifted: Shifted | None = None,
) -> dict[str, str]:
    """The mistakes that explain the matches of two cameras, and what to change.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras.
        pair: Matches of two of them.
        shifted: As of `check_rig`.

    Returns:
        Clauses by the names of the mistakes, likeliest first; empty if none explains.
    """
    posed = replace(
        rig,
        cam_from_rig=cam_from_rig,
        baseline_m=float(np.linalg.norm(cam_from_rig[1, 4:])),
    )
    undone = [*corrections(posed), *focal_corrections(posed)]
    ideas = [_idea(item, _corrected(item, pair)) for item in undone]
    ideas += _shift_ideas(rig, cam_from_rig, pair, shifted)
    given = _idea(Correction(code="", rig=posed, what="", remedy=""), pair)
    least = min([LEAST_MISFIT, *(idea.misfit for idea in ideas)])
    limit = given.badness(least) - CLEARLY_BETTER
    return _likely([idea for idea in ideas if idea.badness(least) <= limit])


def _corrected(correction: Correction, pair: PairMatches) -> PairMatches:
    """Two cameras' matches once the images are put right."""
    sizes = np.array(
        [(c.camera.width, c.camera.height) for c in correction.rig.cameras]
    )
    sides = (pair.camera_a, pair.xy_a), (pair.camera_b, pair.xy_b)
    (a, xy_a), (b, xy_b) = (
        corrected_pixels(correction, sizes, np.full(len(xy), camera), xy)
        for camera, xy in sides
    )
    if a[0] > b[0]:
        a, xy_a, b, xy_b = b, xy_b, a, xy_a
    return replace(pair, camera_a=int(a[0]), camera_b=int(b[0]), xy_a=xy_a, xy_b=xy_b)


def _shift_ideas(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, shifted: Shifted | None
) -> list[_Idea]:
    """One camera late or early: matches with neighbouring frames fit the rig."""
    if shifted is None:
        return []
    ideas = []
    posed = replace(
        rig,
        cam_from_rig=cam_from_rig,
        baseline_m=float(np.linalg.norm(cam_from_rig[1, 4:])),
    )
    sides = pair.camera_a, pair.camera_b
    for shift in SHIFTS:
        for other in shifted(shift):
            if (other.camera_a, other.camera_b) != sides:
                continue
            if len(other) < max(MIN_RIG_MATCHES, len(pair) // 4):
                continue
            what, remedy = shift_words(rig.cameras[sides[1]].name, -shift)
            late = Correction(
                code="frames_shifted", rig=posed, what=what, remedy=remedy
            )
            ideas.append(_idea(late, other))
    return ideas


def _words(found: Mapping[str, str]) -> str:
    return " or ".join(found.values())


def _likely(ideas: Sequence[_Idea]) -> dict[str, str]:
    """The explanations that tilted ports allow and that fit best, one of each kind."""
    fitting = [i for i in ideas if i.turn_deg <= MAX_TURN_DEG and i.misfit <= MAX_REST]
    if not fitting:
        return {}
    least = min(idea.misfit for idea in fitting)
    fitting.sort(key=lambda idea: idea.badness(least))
    limit = fitting[0].badness(least) + 1.0
    phrases: dict[str, str] = {}
    for idea in fitting:
        if idea.badness(least) <= limit:
            phrases.setdefault(idea.code, idea.phrase)
    return dict(list(phrases.items())[:MAX_PHRASES])


def _idea(correction: Correction, pair: PairMatches) -> _Idea:
    """By how many degrees the second camera must turn to fit; inf if it never does."""
    rig = correction.rig
    assert rig.cam_from_rig is not None
    phrase = f"{correction.what}: {correction.remedy}"
    step = -(-len(pair) // IDEA_MATCHES)
    xy_a, xy_b = pair.xy_a[::step], pair.xy_b[::step]
    both = rig.refractive_cameras()
    cameras = both[pair.camera_a], both[pair.camera_b]
    b_from_a = relative_pose(rig.cam_from_rig, pair.camera_a, pair.camera_b)
    in_front, misfit = fit_of(*cameras, b_from_a, xy_a, xy_b)
    if in_front < CLEARLY_IN_FRONT or misfit > MAX_MISFIT:
        return _Idea(correction.code, phrase, np.inf, np.inf)
    thinned = PairMatches(
        camera_a=0,
        camera_b=1,
        frame_idx=np.zeros(len(xy_a), dtype=np.int64),
        xy_a=xy_a,
        xy_b=xy_b,
    )
    poses = np.stack([rigid3.IDENTITY, b_from_a])
    rotation = correct_rotations(cameras, poses, [thinned])
    turn = float(rotation.turn_deg[1])
    return _Idea(correction.code, phrase, turn, rotation.misfit_after)
