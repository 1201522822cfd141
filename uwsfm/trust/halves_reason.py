"""Halves of the frames that differ far, as a reason of a verdict."""

from collections.abc import Mapping

from uwsfm.calibration.parameters import GROUPS
from uwsfm.calibration.result import CalibrationResult
from uwsfm.trust.halves import (
    MIN_FRAMES,
    CrossValidation,
    num_frames,
    why_not_halved,
)
from uwsfm.trust.reason import DOUBTFUL, Reason, reason

FAR_APART = 3.0
"""Times the prediction, and significant. Up to it, deviations are enlarged and that is
all: a real rig in a tank has 1.3 to 2.1, as its lens fits badly; a port that was
mounted anew midway, 10 mm farther away, has more."""
NAMES = {**GROUPS, "length": "distances between points", "scale": "scale"}
"""Groups of numbers that halves are compared by, for people."""


def enlarged_notes(factors: Mapping[str, float]) -> list[str]:
    """Which standard deviations were enlarged, and by how much, one sentence each.

    Args:
        factors: by group, as of `uwsfm.calibration.problem.Covariance.enlarged`.
    """
    return [
        f"halves of the frames differ in their {NAMES[group]} by {factor:.1f} times "
        "what their standard deviations predict; those from the images are enlarged "
        "by as much"
        for group, factor in factors.items()
    ]


def untested_notes(calibration: CalibrationResult, *, has_model: bool) -> list[str]:
    """That nothing tested the standard deviations, and how to do it, one sentence.

    Args:
        calibration: of the whole.
        has_model: whether a model is stored, which `uwsfm check --halves` can read.

    Returns:
        Nothing if the halves were tested, or there are no standard deviations.
    """
    cause = why_not_halved(calibration)
    if cause is None or not calibration.covariance.determined:
        return []
    note = f"the standard deviations were not tested by halves of the frames: {cause}"
    if num_frames(calibration) < MIN_FRAMES:
        return [note]
    first = "" if has_model else "uwsfm reconstruct or refine, and then "
    return [f"{note}; {first}uwsfm check OUT --halves tests them"]


def halves_reasons(found: CrossValidation | None) -> list[Reason]:
    """A reason if the halves differ so far that the rig was not one and the same."""
    enlarged = {} if found is None else found.enlarged
    far = {group: factor for group, factor in enlarged.items() if factor > FAR_APART}
    if not far:
        return []
    worst = max(far, key=lambda group: far[group])
    text = (
        f"Halves of the frames, each adjusted alone, differ in their {NAMES[worst]} by "
        f"{far[worst]:.1f} times what their standard deviations predict: something "
        "changed during the dive (a lens, a port, the placement of the cameras), or "
        "the model does not fit all frames alike."
    )
    return [reason("halves_differ", text, DOUBTFUL, ratio=far[worst])]
