"""The verdict on a result and the causes that are named, as the jobs come by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from uwsfm.calibration.error_budget import with_budget
from uwsfm.rig.rig import Rig
from uwsfm.sfm.refine import Refined
from uwsfm.trust.diagnosis import explain
from uwsfm.trust.verdict import judged, used_of


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """What a person is shown first."""

    verdict: str
    words: str
    """The reasons, and the causes in words."""
    causes: tuple[str, ...]
    """Codes, the likeliest first."""


def with_deviations(refined: Refined) -> Refined:
    """The result with its standard deviations in all."""
    calibration, _ = with_budget(refined.calibration)
    return replace(refined, calibration=calibration)


def assessed(
    rig: Rig,
    refined: Refined,
    num_frames: int,
    frame_names: Sequence[str],
    *,
    diagnosed: bool,
) -> Assessment:
    """Judge a result; where it does not simply fit, look for the cause.

    Args:
        rig: As given.
        refined: The result.
        num_frames: That there were, registered or not.
        frame_names: Of those that are.
        diagnosed: False: look for no cause, which takes some seconds.
    """
    verdict = judged(rig, refined.calibration, used_of(refined, num_frames))
    reasons = [f"{reason.code}: {reason.text}" for reason in verdict.reasons]
    causes: tuple[str, ...] = ()
    if diagnosed:
        found = explain(
            verdict.verdict, verdict.codes, rig, refined.calibration, frame_names
        )
        causes = tuple(one.code for one in found)
        reasons += [one.text for one in found]
    return Assessment(verdict=verdict.verdict, words=" ".join(reasons), causes=causes)
