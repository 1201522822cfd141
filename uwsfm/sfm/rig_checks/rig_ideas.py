"""Which mistake explains the matches of two cameras of a rig? Each is undone and tried.

What is compared is how far the second camera must turn until the rays of the same point
meet, and what they then miss by: tilted ports turn rays too, but not by much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.sfm.correction import Correction
from uwsfm.sfm.poses.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.rig_checks.lens_mistakes import FOCAL_FACTORS, focal_corrections
from uwsfm.sfm.rig_checks.moved_ports import moved_ports, typical_angle
from uwsfm.sfm.rig_checks.rig_mistakes import (
    SHIFTS,
    corrected_pixels,
    corrections,
    lenses_in_water,
    shift_words,
)
from uwsfm.sfm.rig_checks.rig_rotation import MIN_RIG_MATCHES, correct_rotations
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches

CLEARLY_IN_FRONT = 0.8
MAX_MISFIT = 0.05
"""Radians: about 3 degrees. A port tilted by 8 degrees bends the rays by 2."""
MAX_TURN_DEG = 5.0
"""A relative port tilt of 20 degrees; beyond it the rig itself is wrong."""
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
CLEAN_MISFIT = 1.5e-3
"""Radians: half a pixel of a small image. An explanation that leaves more, or needs a
turn, is compared with others once more, with ports that move."""
SHORTLIST = 24
"""So many of the best are: a dome off its centre comes as far down as the twentieth."""
RARER_ZOOM = 1.0
"""Strain of a zoom that changed: of many frames and factors one always fits a bit."""
MIN_FRAMES, MAX_SPLITS, ZOOM_MATCHES = 2, 5, 200
"""On each side of a change of zoom; places where it is looked for; matches for that."""
IDEA_MATCHES = 800
"""Of a pair of cameras are enough to compare explanations."""

Shifted = Callable[[int], Sequence[PairMatches]]
"""Matches between each frame of a camera and the frame of another so much later."""


@dataclass(frozen=True, kw_only=True)
class _Idea:
    """An explanation, and how well two cameras fit their matches with it."""

    correction: Correction
    pair: PairMatches
    """The matches, once they are put right."""
    strain: float
    """By how much more than usual cameras must turn, or ports move; inf if nothing
    makes them fit."""
    misfit: float
    """`typical_angle` between rays and their epipolar plane after that, radians."""

    @property
    def phrase(self) -> str:
        return f"{self.correction.what}: {self.correction.remedy}"

    def badness(self, best_misfit: float) -> float:
        """Strain and misfit together; an idea without a fit is infinitely bad."""
        if not math.isfinite(self.misfit):
            return math.inf
        return self.strain + math.log(
            max(self.misfit, LEAST_MISFIT) / max(best_misfit, LEAST_MISFIT)
        ) / math.log(SAME_MISFIT)


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
    posed = _posed(rig, cam_from_rig)
    given = Correction(code="", rig=posed, what="", remedy="")
    as_given = _turned(given, pair)
    ideas = _without_moving(posed, pair, shifted)
    found = _better([as_given], ideas)
    if any(_clean(idea) for idea in found):
        return likely(found)
    ideas += zoom_ideas(posed, pair)
    ideas.sort(key=lambda idea: idea.badness(LEAST_MISFIT))
    moved = [_moved(idea) for idea in ideas[:SHORTLIST]]
    moved = [  # where no ports fit, a turn may
        after if math.isfinite(after.misfit) else before
        for before, after in zip(ideas, moved, strict=False)
    ]
    moved = _better([_moved(as_given)], moved)
    if not likely(moved):
        moved = found
    phrases = likely(moved)
    least = min((idea.misfit for idea in moved), default=np.inf)
    turned = _turned(given, pair, max_misfit=np.inf)
    if phrases and turned.misfit <= SAME_MISFIT * max(least, LEAST_MISFIT):
        phrases["rotation"] = _turn_words(turned)
    return phrases


def clean_remedies(
    rig: Rig,
    cam_from_rig: Array,
    pair: PairMatches,
    shifted: Shifted | None = None,
) -> dict[str, str]:
    """As `remedies`, but only those that leave hardly any turn and no port to move:
    what a rig that is not refused may owe its turn to."""
    posed = _posed(rig, cam_from_rig)
    given = Correction(code="", rig=posed, what="", remedy="")
    ideas = _without_moving(posed, pair, shifted)
    better = _better([_turned(given, pair)], ideas)
    return likely([idea for idea in better if _clean(idea)])


def _posed(rig: Rig, cam_from_rig: Array) -> Rig:
    length = float(np.linalg.norm(cam_from_rig[1, 4:]))
    return replace(rig, cam_from_rig=cam_from_rig, baseline_m=length)


def _clean(idea: _Idea) -> bool:
    return idea.misfit <= CLEAN_MISFIT and idea.strain <= 1.0


def _without_moving(
    posed: Rig, pair: PairMatches, shifted: Shifted | None
) -> list[_Idea]:
    """Every mistake undone, with the ports as given."""
    assert posed.cam_from_rig is not None
    undone = [
        *lenses_in_water(posed),
        *corrections(posed),
        *focal_corrections(posed, range(len(posed.cameras))),
    ]
    ideas = [_turned(item, _corrected(item, pair)) for item in undone]
    return ideas + shift_ideas(posed, posed.cam_from_rig, pair, shifted)


def _turn_words(idea: _Idea) -> str:
    """The rotation itself as the mistake: a turn explains the matches as well as what
    moves the ports does, and nothing in them tells the two apart."""
    name = idea.correction.rig.cameras[idea.pair.camera_b].name
    return (
        f"the rotation of {name!r} is wrong by "
        f"{idea.strain * SAME_TURN_DEG:.0f} degrees: calibrate it anew, or give "
        "baseline_m in place of cam_from_rig"
    )


def _better(given: Sequence[_Idea], ideas: Sequence[_Idea]) -> list[_Idea]:
    """Those that are clearly better than the rig as given."""
    limit = min(idea.badness(LEAST_MISFIT) for idea in given) - CLEARLY_BETTER
    return [idea for idea in ideas if idea.badness(LEAST_MISFIT) <= limit]


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


def shift_ideas(
    rig: Rig, cam_from_rig: Array, pair: PairMatches, shifted: Shifted | None
) -> list[_Idea]:
    """One camera late or early: matches with neighbouring frames fit the rig."""
    if shifted is None:
        return []
    ideas = []
    posed = _posed(rig, cam_from_rig)
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
            ideas.append(_turned(late, other))
    return ideas


def zoom_ideas(rig: Rig, pair: PairMatches) -> list[_Idea]:
    """Another focal length of one camera from a frame on.

    That of both cameras hardly shows in single frames.
    """
    frames = np.unique(pair.frame_idx)
    last = len(frames) - MIN_FRAMES
    if last < MIN_FRAMES:
        return []
    places = np.linspace(MIN_FRAMES, last, min(last - MIN_FRAMES + 1, MAX_SPLITS))
    few = pair.thinned(ZOOM_MATCHES)
    ideas = []
    for split, c, factor in product(
        np.unique(places.round().astype(int)).tolist(),
        (pair.camera_a, pair.camera_b),
        FOCAL_FACTORS,
    ):
        first = int(frames[split])
        name = rig.cameras[c].name
        correction = Correction(
            code="zoom_changed",
            rig=rig,
            what=f"the focal length of {name!r} is another one after the first "
            f"{split} frames, about {1.0 / factor:.2f} times, or that of another "
            "camera",
            remedy="reconstruct the frames before and after it with a lens of their "
            "own, and hold zoom and focus in the next dive",
        )
        idea = _turned(correction, _zoomed(rig, few, c, first, factor))
        whole = _zoomed(rig, pair, c, first, factor)
        ideas.append(replace(idea, pair=whole, strain=idea.strain + RARER_ZOOM))
    return ideas


def _zoomed(
    rig: Rig, pair: PairMatches, camera: int, first: int, factor: float
) -> PairMatches:
    """Pixels of one camera as before its focal length changed by 1 / ``factor``."""
    lens = rig.cameras[camera].camera
    center = np.array([lens.principal_point_x, lens.principal_point_y])
    late = (pair.frame_idx >= first)[:, None]

    def put_right(xy: Array) -> Array:
        return np.where(late, center + factor * (xy - center), xy)

    if camera == pair.camera_a:
        return replace(pair, xy_a=put_right(pair.xy_a))
    return replace(pair, xy_b=put_right(pair.xy_b))


def likely(ideas: Sequence[_Idea]) -> dict[str, str]:
    """The explanations that tilted ports allow and that fit best, one of each kind."""
    most = MAX_TURN_DEG / SAME_TURN_DEG
    fitting = [i for i in ideas if i.strain <= most and i.misfit <= MAX_REST]
    if not fitting:
        return {}
    least = min(idea.misfit for idea in fitting)
    fitting.sort(key=lambda idea: idea.badness(least))
    limit = fitting[0].badness(least) + 1.0
    phrases: dict[str, str] = {}
    for idea in fitting:
        if idea.badness(least) <= limit:
            phrases.setdefault(idea.correction.code, idea.phrase)
    return dict(list(phrases.items())[:MAX_PHRASES])


def _turned(
    correction: Correction, pair: PairMatches, max_misfit: float = MAX_MISFIT
) -> _Idea:
    """By how much the second camera must turn to fit its matches, if before the turn
    rays of the same point miss by no more than ``max_misfit`` radians."""
    rig = correction.rig
    assert rig.cam_from_rig is not None
    few = pair.thinned(IDEA_MATCHES)
    both = rig.refractive_cameras()
    cameras = both[pair.camera_a], both[pair.camera_b]
    b_from_a = relative_pose(rig.cam_from_rig, pair.camera_a, pair.camera_b)
    in_front, misfit = fit_of(*cameras, b_from_a, few.xy_a, few.xy_b)
    idea = _Idea(correction=correction, pair=pair, strain=np.inf, misfit=np.inf)
    if in_front < CLEARLY_IN_FRONT or misfit > max_misfit:
        return idea
    poses = np.stack([rigid3.IDENTITY, b_from_a])
    alone = replace(few, camera_a=0, camera_b=1)
    rotation = correct_rotations(cameras, poses, [alone])
    turned = relative_pose(rotation.cam_from_rig, 0, 1)
    rays = ray_pairs(*cameras, turned, few.xy_a, few.xy_b)
    return replace(
        idea,
        strain=float(rotation.turn_deg[1]) / SAME_TURN_DEG,
        misfit=typical_angle(rays.epipolar_angles()),
    )


def _moved(idea: _Idea) -> _Idea:
    """By how much the ports must move to fit the matches, in place of a turn."""
    rig, rarer = idea.correction.rig, 0.0
    assert rig.cam_from_rig is not None
    if idea.correction.code == "zoom_changed":
        rarer = RARER_ZOOM
    moved = moved_ports(rig, rig.cam_from_rig, idea.pair)
    if moved is None:
        return replace(idea, strain=np.inf, misfit=np.inf)
    return replace(idea, strain=moved.strain + rarer, misfit=moved.typical)
