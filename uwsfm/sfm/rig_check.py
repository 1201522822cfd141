"""Is the rig the one that took the images? Wrong signs and swapped folders are quiet.

An inverted ``cam_from_rig`` or swapped folders still let COLMAP register every image,
with a plausible error: only the points that both cameras see in one frame tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig import Rig
from uwsfm.sfm.same_frame import PairMatches, ray_pairs, relative_pose

MIN_RIG_MATCHES = 30
"""Over all frames; a pair of cameras with fewer is not judged."""
MIN_IN_FRONT = 0.5
CLEARLY_IN_FRONT = 0.8
SAME_MISFIT = 1.5
"""Two explanations whose misfits differ by less than this factor are not told apart."""
MAX_MISFIT = 0.05
"""Radians: about 3 degrees. A port tilted by 8 degrees bends the rays by 2."""

POSE_HINT = (
    "check its rotation (order x, y, z, w; x_in_cam = R x_in_rig + translation_m) and "
    "the axes of translation_m"
)


@dataclass(frozen=True, kw_only=True)
class PairFit:
    """How well matches fit two cameras at a relative pose."""

    in_front: float
    """Fraction of the points in front of both cameras."""
    misfit: float
    """Median angle by which rays miss their epipolar plane, radians."""

    @property
    def explains(self) -> bool:
        return self.in_front >= CLEARLY_IN_FRONT and self.misfit <= MAX_MISFIT


def fit_of(
    camera_a: RefractiveCamera,
    camera_b: RefractiveCamera,
    b_from_a: Array,
    xy_a: Array,
    xy_b: Array,
) -> PairFit:
    """Cheirality and epipolar misfit of matched pixels (N, 2); no ray counts as bad."""
    rays = ray_pairs(camera_a, camera_b, b_from_a, xy_a, xy_b)
    _, in_front = rays.triangulate()
    angles = np.abs(np.nan_to_num(rays.epipolar_angles(), nan=np.pi / 2))
    return PairFit(in_front=float(np.mean(in_front)), misfit=float(np.median(angles)))


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
        given = fit_of(cameras[a], cameras[b], b_from_a, pair.xy_a, pair.xy_b)
        if given.in_front >= MIN_IN_FRONT and given.misfit <= MAX_MISFIT:
            continue
        names = rig.cameras[a].name, rig.cameras[b].name
        folders = rig.cameras[a].images, rig.cameras[b].images
        remedies = _remedies(cameras[a], cameras[b], b_from_a, pair, names, folders)
        if remedies:
            raise InputError(
                f"cameras {names[0]!r} and {names[1]!r} contradict their images: as "
                f"described, only {given.in_front:.0%} of the points that both see lie "
                f"in front of them; probably {' or '.join(remedies)}"
            )
        if given.in_front < MIN_IN_FRONT:
            raise InputError(
                f"only {given.in_front:.0%} of the points that cameras {names[0]!r} "
                f"and {names[1]!r} both see lie in front of them: check cam_from_rig of"
                f" {names[1]!r} (x_in_cam = R x_in_rig + translation_m)"
            )
        raise misfit_error(names[0], names[1], given.misfit)


def misfit_error(name_a: str, name_b: str, misfit: float) -> InputError:
    """A rotation, or a direction of the baseline, that is grossly wrong."""
    return InputError(
        f"cam_from_rig of camera {name_b!r} is wrong by several degrees: rays of the "
        f"same point in {name_a!r} and {name_b!r} miss each other by "
        f"{np.degrees(misfit):.1f} degrees; {POSE_HINT}"
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


def _remedies(
    camera_a: RefractiveCamera,
    camera_b: RefractiveCamera,
    b_from_a: Array,
    pair: PairMatches,
    names: tuple[str, str],
    folders: tuple[str, str],
) -> list[str]:
    """What to change, one phrase each: every change that fits about as well as any."""
    inverse = rigid3.inverse(b_from_a)
    as_position = b_from_a.copy()
    as_position[4:] = -rigid3.rotate(b_from_a, b_from_a[4:])
    xy_a, xy_b = pair.xy_a, pair.xy_b
    fits = {
        f"the image folders {folders[0]!r} and {folders[1]!r} are swapped: exchange "
        "them in rig.yaml": fit_of(camera_a, camera_b, b_from_a, xy_b, xy_a)
    }
    if pair.camera_a == 0:  # the pose of a camera in the rig, not a relative one
        fits[
            f"cam_from_rig of {names[1]!r} is inverted: it must map from the rig to "
            "the camera (x_in_cam = R x_in_rig + translation_m)"
        ] = fit_of(camera_a, camera_b, inverse, xy_a, xy_b)
        fits[
            f"translation_m of {names[1]!r} is the position of the camera: it must be "
            "-R times that"
        ] = fit_of(camera_a, camera_b, as_position, xy_a, xy_b)
    good = {phrase: fit for phrase, fit in fits.items() if fit.explains}
    if not good:
        return []
    limit = SAME_MISFIT * min(fit.misfit for fit in good.values())
    likely = sorted(good, key=lambda phrase: good[phrase].misfit)
    return [phrase for phrase in likely if good[phrase].misfit <= limit]
