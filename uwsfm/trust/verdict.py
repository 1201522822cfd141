"""The verdict on a result: *fits*, *doubtful* or *does not fit*, with its reasons.

A standard deviation is worth something only where the model is right. So the verdict
comes first, and words such as "determined" or "metric" are for results that fit.

The thresholds below were set from what correct inputs give (simulated dives of random
rigs, the rendered sample) and what mistakes give; `pipelines/trust` has the tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

from uwsfm._base.indices import distinct
from uwsfm.sfm.noise_floor import NoiseFloor, noise_floor
from uwsfm.trust.departed import departed_reasons
from uwsfm.trust.freed import Freed
from uwsfm.trust.goodness import Goodness, Used, goodness_of
from uwsfm.trust.reason import DOES_NOT_FIT, DOUBTFUL, Reason, Severity, reason

if TYPE_CHECKING:
    from uwsfm.calibration.result import CalibrationResult
    from uwsfm.rig.rig import Rig
    from uwsfm.sfm.refine import Refined

Word = Literal["fits", "doubtful", "does not fit"]

FITS: Word = "fits"

LEVEL = 1e-3
"""Chance at which a systematic part is significant. The test errs on the safe side: of
200 correct simulated dives, with eight parts each, none came below 0.005."""
FREED_LEVEL = 1e-5
"""The same of numbers set free, where errors are taken as independent: of 260 correct
dives with outliers one had 3e-4; focal lengths 1 % too long have 1e-8 and less."""
FREED_EVENNESS = 4.5
"""Single outliers that were kept make 2.8 to 3.9 of it, wrong lenses 5.8 to 11."""
NOTICEABLE_PX, NOTICEABLE_SHARE = 0.03, 0.15
"""A significant part below both is no concern: what a detector sees of slanted surfaces
leaves 0.003 px of rendered and 0.01 px of real images, and a part of a seventh of the
noise adds 1 % to the RMS. A real lens that is known to fit badly leaves 0.1 px."""
LARGE_PX, LARGE_SHARE = 0.3, 0.5
"""A systematic part beyond both is a quarter of the squared residuals that are left,
after ports, poses and points have taken up what they can of it."""
LENS_SHARE = 0.5
"""If less of a systematic part is left with a free lens, it was the lens. Wrong lenses
leave 0 to 0.35 of it, a rotation of the rig that is wrong 0.5 to 0.6."""
ABOVE_FLOOR, FAR_ABOVE_FLOOR = 1.15, 2.0
"""Model over noise floor, both of the same matches. 200 correct simulated dives end at
0.8 to 1.01, the sample at 1.0, a video of a real reef at 1.01, a real rig in a tank
whose lens fits badly at 1.1; wrong lenses and rotations of the sample at 2.8 to 8."""
BELOW_ZERO = 4.0
"""Of `pull_below_zero`: of 38 simulated ports of 0.5 to 4 mm that ran into zero, the
largest had 2.5; a lens of another crop has 19, one with its coefficients in another
order 50."""
FEW_KEPT, FEWEST_KEPT = 0.3, 0.15
"""Share of the map's observations that agree. Tracks of two views with 15 % outliers,
some of too small an angle, keep 0.4 to 0.6; usual maps 0.8 and more."""
FEW_OBSERVATIONS = "few_observations"
"""The reason's code."""
FEW_FRAMES = 0.5
"""Share of frames that are registered."""
KNOWN_LENGTH, SCATTERED, LEFT_OUT = 4.0, 3.0, 0.4
"""Standard deviations of a missed length; how many times positions scatter more than
stated; share of the positions that are left out."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether the model, with what was given, explains the images."""

    verdict: Word
    reasons: tuple[Reason, ...]
    """The severe ones first; empty: it fits."""
    goodness: Goodness

    @property
    def codes(self) -> tuple[str, ...]:
        """Of the reasons."""
        return tuple(one.code for one in self.reasons)


def judge(
    rig: Rig,
    calibration: CalibrationResult,
    floor: NoiseFloor | None = None,
    used: Used | None = None,
) -> Verdict:
    """Measure how well a result fits, and judge it.

    Args:
        rig: As given, before anything was refined.
        calibration: The result.
        floor: What the two-view geometry of the same matches leaves.
        used: How much of the input the result has.
    """
    count = calibration.scene.num_frames
    used = used or Used(num_frames=count, num_registered=count)
    return verdict_on(goodness_of(rig, calibration, floor, used))


def judged(rig: Rig, calibration: CalibrationResult, used: Used) -> Verdict:
    """`judge`, with the noise floor of the result's own tracks."""
    scene, _ = calibration.scene.select(calibration.inliers)
    return judge(rig, calibration, noise_floor(scene), used)


def used_of(refined: Refined, num_frames: int) -> Used:
    """How much of the input a refined scene has.

    Args:
        refined: The result.
        num_frames: That there were, registered or not.
    """
    return Used(
        num_frames=num_frames,
        num_registered=len(distinct(refined.scene.frame_idx)),
        num_tested=refined.num_tested,
        num_kept=len(refined.kept),
    )


def verdict_on(goodness: Goodness) -> Verdict:
    """The verdict that some numbers lead to."""
    reasons = [
        *_floor(goodness),
        *_systematic(goodness),
        *departed_reasons(goodness.departures),
        *_below_zero(goodness),
        *_used(goodness.used),
        *_too_little(goodness),
        *_outside(goodness),
    ]
    if not goodness.converged:
        text = (
            "The refractive adjustment stopped before it converged, so its numbers are "
            "those of no optimum."
        )
        reasons.append(reason("not_converged", text, DOUBTFUL))
    return _verdict(goodness, reasons)


def with_reasons(verdict: Verdict, more: Sequence[Reason]) -> Verdict:
    """A verdict with further reasons, and the word that they all lead to."""
    return _verdict(verdict.goodness, [*verdict.reasons, *more])


def _verdict(goodness: Goodness, reasons: Sequence[Reason]) -> Verdict:
    # A stable order: the severe ones first, otherwise as they were found.
    ordered = sorted(reasons, key=lambda reason: reason.severity != DOES_NOT_FIT)
    word: Word = ordered[0].severity if ordered else FITS
    return Verdict(verdict=word, reasons=tuple(ordered), goodness=goodness)


def _floor(goodness: Goodness) -> list[Reason]:
    floor = goodness.floor
    if floor is None or floor.ratio < ABOVE_FLOOR:
        return []
    text = (
        f"The model leaves {floor.model_px:.2g} px RMS (per coordinate, of "
        f"{floor.num_matches} matches between pairs of images), {floor.ratio:.1f} "
        f"times the {floor.floor_px:.2g} px that the best geometry of each pair leaves "
        "of the same matches: the images agree with each other, not with this model."
    )
    severity = DOES_NOT_FIT if floor.ratio >= FAR_ABOVE_FLOOR else DOUBTFUL
    return [
        reason(
            "above_noise_floor",
            text,
            severity,
            model_px=floor.model_px,
            floor_px=floor.floor_px,
            ratio=floor.ratio,
        )
    ]


_BY = {
    "place": "at the same place in the image",
    "depth": "at the same depth",
    "row": "in the same rows of the image, as a rolling shutter makes them",
    "camera": "in all images of a camera",
    "time": "in the same part of the dive, as a lens that changes makes them",
    "image": "in whole images, as cameras that are not synchronous make them",
}


def _systematic(goodness: Goodness) -> list[Reason]:
    reasons = [*_lenses(goodness)]
    blamed = bool(reasons)
    for part in goodness.parts:
        if part.by in ("place", "depth", "row") and blamed:
            continue  # what a wrong lens leaves is seen by all three
        severity = _severity(part.px, part.p_value, goodness.sigma_px)
        if severity is None:
            continue
        blamed = blamed or part.by in ("place", "depth", "row")
        text = (
            f"The residuals of the result's observations repeat {_BY[part.by]}: "
            f"{part.px:.2g} px RMS are systematic, beside a noise of "
            f"{goodness.sigma_px:.2g} px per coordinate ({_chance(part.p_value)})."
        )
        numbers = {"px": part.px, "p_value": part.p_value}
        reasons.append(reason(f"systematic_by_{part.by}", text, severity, **numbers))
    return reasons


def _lenses(goodness: Goodness) -> list[Reason]:
    """Cameras whose residuals a free lens would remove, or what is held of the rig."""
    together = _held_numbers(goodness)
    if together is not None and together.code == PLACEMENT:
        return [together]  # which leaves in the images what a lens does, too
    reasons = []
    for camera in goodness.cameras:
        px, freed = camera.systematic_px, camera.freed_px
        severity = _severity(px, camera.p_value, goodness.sigma_px)
        if severity is None or freed is None or freed > LENS_SHARE * px:
            continue
        text = (
            f"Camera {camera.name}: it is the lens, as given, that does not fit. "
            f"{px:.2g} px RMS of its residuals are systematic by place in the image "
            f"({_chance(camera.p_value)}), and {freed:.2g} px if the lens is free: "
            "check its calibration, or refine it."
        )
        numbers = {"px": px, "p_value": camera.p_value, "freed_px": freed}
        reasons.append(reason("lens_does_not_fit", text, severity, **numbers))
    if together is not None and not reasons:
        return [together]
    return reasons


class FreedWords(NamedTuple):
    """What is said of numbers that the images would rather have free."""

    name: str
    alone: str
    """After "more than the", where something else may be wrong as well."""
    verdict: str


LENSES, PLACEMENT = "lenses_do_not_fit", "placement_does_not_fit"
FREED_WORDS = {
    LENSES: FreedWords(
        "lenses",
        "lenses",
        "the lenses, as given, do not fit, or something that a lens can stand for; "
        "check their calibration.",
    ),
    PLACEMENT: FreedWords(
        "placement of the cameras",
        "placement",
        "cam_from_rig, as held, does not fit, or something that it can stand for; "
        "check it, or write refine_cam_from_rig: true.",
    ),
}


def _held_numbers(goodness: Goodness) -> Reason | None:
    """All lenses together or the placement of the cameras, whichever as held costs
    more: each can stand for a part of the other."""
    tried = {LENSES: goodness.freed_lenses, PLACEMENT: goodness.freed_placement}
    found = []
    for code, freed in tried.items():
        if freed is None or not _seen_by_all(freed):
            continue
        severity = _severity(freed.px, freed.p_value, goodness.sigma_px)
        if severity is not None:
            text = _freed_text(freed, FREED_WORDS[code], goodness.floor)
            numbers = {"px": freed.px, "p_value": freed.p_value, "gain": freed.gain}
            found.append(reason(code, text, severity, **numbers))
    return max(found, key=lambda one: one.numbers["px"], default=None)


def _freed_text(freed: Freed, words: FreedWords, floor: NoiseFloor | None) -> str:
    text = (
        f"With the {words.name} free, {freed.px:.2g} px of the residuals vanish "
        f"({_chance(freed.p_value)}): "
    )
    if floor is None or freed.sigma_px < ABOVE_FLOOR * floor.floor_px:
        return text + words.verdict
    return text + (
        f"but a noise of {freed.sigma_px:.2g} px is left, where matches of pairs of "
        f"images alone have {floor.floor_px:.2g} px: more than the {words.alone} may "
        "be wrong, or the way back from there is too long for this test."
    )


def _seen_by_all(freed: Freed) -> bool:
    return freed.p_value < FREED_LEVEL and freed.evenness > FREED_EVENNESS


def _severity(px: float, p_value: float, sigma_px: float) -> Severity | None:
    """What a systematic part means; None: nothing. NaN compares false."""
    if not p_value < LEVEL or px < max(NOTICEABLE_PX, NOTICEABLE_SHARE * sigma_px):
        return None
    large = px > max(LARGE_PX, LARGE_SHARE * sigma_px)
    return DOES_NOT_FIT if large else DOUBTFUL


def _chance(p_value: float) -> str:
    """Far below what anyone counts, the digits mean nothing."""
    if p_value < 1e-9:
        return "chance explains less than 1 in 10^9"
    times = float(f"{1.0 / p_value:.1g}")
    return f"chance explains it 1 in {times:,.0f} times"


def _below_zero(goodness: Goodness) -> list[Reason]:
    """A distance at its bound, where the images want it far beyond."""
    z = goodness.below_zero_z
    if z is None or z < BELOW_ZERO:
        return []
    text = (
        "The images put a port behind its camera, where none is, and its distance "
        f"was held at zero; that costs {z:.0f} standard deviations, so the images "
        "contradict the lens calibrated in air, the water index or the kind of port."
    )
    return [reason("distance_at_zero", text, DOUBTFUL, z=z)]


def _used(used: Used) -> list[Reason]:
    reasons = []
    if used.num_registered < FEW_FRAMES * used.num_frames:
        text = (
            f"Only {used.num_registered} of {used.num_frames} frames are registered: "
            "the rest of the images do not agree with them, or show something else."
        )
        numbers = {"registered": used.num_registered, "frames": used.num_frames}
        reasons.append(reason("few_frames", text, DOUBTFUL, **numbers))
    if used.num_tested and used.num_kept is not None:
        share = used.num_kept / used.num_tested
        if share < FEW_KEPT:
            text = (
                f"Only {1e2 * share:.0f} % of the map's {used.num_tested} observations "
                "agree with the refractive model; the others were left out."
            )
            severity = DOES_NOT_FIT if share < FEWEST_KEPT else DOUBTFUL
            reasons.append(reason(FEW_OBSERVATIONS, text, severity, share=share))
    return reasons


def _too_little(goodness: Goodness) -> list[Reason]:
    """A wrong lens could not have shown: no part of the picture is seen often enough.

    The noise floor is no condition: matches of small sets are often too few for it, and
    what repeats in the image finds the same mistakes.
    """
    if not all(math.isnan(p.p_value) for p in goodness.parts if p.by == "place"):
        return []
    frames = goodness.used.num_registered
    text = (
        "There is too little data to tell whether the model fits: in "
        f"{frames} frames, too few images see points in the same part of the picture "
        "for errors that repeat there to show. Give more frames."
    )
    return [reason("too_little_data", text, DOUBTFUL, frames=frames)]


def _outside(goodness: Goodness) -> list[Reason]:
    """Lengths and positions that contradict the images."""
    reasons = []
    z = goodness.known_length_z
    if z is not None and z > KNOWN_LENGTH:
        text = (
            f"A known length is missed by {z:.1f} of its standard deviations: it "
            "contradicts the images, the baseline or the other lengths."
        )
        reasons.append(reason("known_length", text, DOUBTFUL, z=z))
    scatter, out = goodness.positions_scatter, goodness.positions_left_out
    if scatter is None or out is None:
        return reasons
    if scatter > SCATTERED or out > LEFT_OUT:
        text = (
            f"The positions scatter {scatter:.1f} times as much as stated, and "
            f"{1e2 * out:.0f} % of them were left out: they contradict the images."
        )
        numbers = {"scatter": scatter, "left_out": out}
        reasons.append(reason("positions", text, DOUBTFUL, **numbers))
    return reasons
