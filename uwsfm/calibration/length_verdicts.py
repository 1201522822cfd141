"""What is known of scale and place, in words."""

import math

import numpy as np

from uwsfm.calibration.lengths import LengthFit, PositionFit
from uwsfm.calibration.result import CalibrationResult

ARBITRARY = "arbitrary"
ASK_FOR_LENGTH = (
    "give a scale bar, a known distance between two frames, or positions of the frames"
)
# A scale better than this is worth printing lengths for.
DETERMINED_SCALE, OPEN_SCALE = 0.05, 0.5
WEAK_TURN_DEG, OPEN_TURN_DEG = 2.0, 20.0
# Standard deviations that a known length may be missed by.
CONTRADICTION = 4.0
# Standard deviations given for positions are wrong by more than chance and optimism.
SCATTERED = 2.0
MANY_OUTLIERS = 0.4
# Fewer positions than this agree with a mirrored frame, but for one or two of them.
FEW_POSITIONS = 10


def scale_verdict(scale_stddev: float | None) -> str:
    """Whether anything determines the scale: a word for people."""
    if scale_stddev is None:
        return ARBITRARY
    if not scale_stddev < OPEN_SCALE:
        return "not determined"
    return "determined" if scale_stddev < DETERMINED_SCALE else "weakly determined"


def small_unit(scale_stddev: float | None) -> str:
    """What 1e-3 of a length is called."""
    return "1e-3, scale arbitrary" if scale_stddev is None else "mm"


def small_length(value: float, scale_stddev: float | None) -> str:
    """A length in a sentence."""
    if scale_stddev is None:
        return f"{value:.2g} (scale arbitrary)"
    return f"{1e3 * value:.1f} mm"


def length_verdicts(result: CalibrationResult) -> tuple[str, ...]:
    """One sentence for everything that is doubtful about scale and place."""
    sentences = []
    stddev = result.covariance.judged_scale_stddev
    word = scale_verdict(stddev)
    if word == ARBITRARY:
        sentences.append(
            "scale arbitrary: nothing determines it, so every length, port distances "
            f"included, is in an arbitrary unit; {ASK_FOR_LENGTH}"
        )
    if word == "weakly determined":
        assert stddev is not None
        sentences.append(
            "the scale is weakly determined, with a standard deviation of "
            f"{1e2 * stddev:.0f} % that all lengths share; {ASK_FOR_LENGTH}"
        )
    given = result.lengths is not None or result.positions is not None
    if stddev is not None and len(result.scene.cameras) == 1 and not given:
        sentences.append(
            "the scale comes from refraction alone, with the port taken as given: if "
            "its distance from the lens is 1 % wrong, all lengths are, about, and a "
            "tilt of a degree or two that was not given can make them several per "
            "cent longer; the standard deviation in all holds what the rig file says "
            f"of the port's accuracy, or what is assumed; {ASK_FOR_LENGTH} to do "
            "without it"
        )
    if result.lengths is not None:
        sentences += _contradicted(result.lengths)
    if result.positions is not None:
        sentences += _positions(result.positions)
    return tuple(sentences)


def _contradicted(fit: LengthFit) -> list[str]:
    return [
        f"known length {row + 1} came out as {found:.4g} m, given as {given:.4g} ± "
        f"{stddev:.2g} m: it contradicts the images, or the other lengths"
        for row, (given, stddev, found) in enumerate(
            zip(fit.given_m, fit.stddevs_m, fit.found_m, strict=True)
        )
        if abs(found - given) > CONTRADICTION * stddev
    ]


def _positions(fit: PositionFit) -> list[str]:
    sentences = []
    count, wrong = len(fit.inliers), fit.num_outliers
    check = (
        "check the lever arm and its signs, the axes (right-handed, metres) and which "
        "frame each position belongs to"
    )
    if not fit.measured.all():
        check = (
            "check the lever arm and its signs, the unit (metres) and the sign of the "
            "depths, and which frame each belongs to"
        )
        sentences.append(
            "depths level the model and give its height; its heading and its place in "
            "the horizontal are arbitrary"
        )
    if wrong:
        advice = f": {check}" if wrong > MANY_OUTLIERS * count else ""
        if count < FEW_POSITIONS and fit.measured.all():
            advice = (
                "; with so few, mirrored axes (two swapped, or one of the wrong sign) "
                f"look like that too: {check}"
            )
        sentences.append(
            f"{wrong} of {count} positions contradict the images and were left out"
            f"{advice}"
        )
    if fit.scatter > SCATTERED:
        rms = float(np.sqrt(np.mean(np.sum(fit.misses_m[fit.inliers] ** 2, axis=1))))
        sentences.append(
            f"the positions miss the model by {rms:.2g} m, {fit.scatter:.1f} times "
            f"their standard deviations, which were enlarged so much: {check}"
        )
    turn, axis = fit.turn
    degrees = math.degrees(turn)
    if degrees > WEAK_TURN_DEG:
        word = "not determined" if degrees > OPEN_TURN_DEG else "weakly determined"
        x, y, z = axis
        sentences.append(
            f"the turn of the model about ({x:+.2f}, {y:+.2f}, {z:+.2f}) in the frame "
            f"of the positions is {word} (standard deviation {degrees:.0f} deg): they "
            "lie nearly on a line, or scatter widely"
        )
    return sentences
