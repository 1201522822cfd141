"""Which mistake explains the observations? Every one is undone, and tried.

An adjustment of a few hundred points takes a tenth of a second. A mistake is named
where a result without it explains the images clearly better, or as well with ports and
a placement that are near the rig file's, which the result with it has left.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.parameters import PRIORS, REFINABLE
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import CalibrationResult
from uwsfm.models.ports.port import DomePort, PlanePort
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.rig_checks.lens_mistakes import OF_DISTORTION
from uwsfm.solver.threads import limited
from uwsfm.trust.explanation import (
    AS_GOOD,
    CLEAR,
    Explanation,
    Tried,
    explanations,
    of_few_observations,
)
from uwsfm.trust.midway import (
    ZoomTrial,
    coarse_firsts,
    fine_firsts,
    nearby_zooms,
    shifts_since,
    zoom_trial,
)
from uwsfm.trust.mistakes import Trial, length_trials, trials
from uwsfm.trust.trials import Fit, fit_of, retriangulated_where_lost, thinned
from uwsfm.trust.verdict import FEW_OBSERVATIONS, FITS

MAX_TILT_DEG = 15.0
"""Of a flat port; more is no usual housing."""
RULER_M, RULER_SHARE = 0.01, 0.5
"""What a port's distance in a rig file is taken to be known to: a ruler held against a
housing, to the centre of a lens that nobody sees."""
AT_ZERO = 2.0
"""Strain of a port that came out at its lens, which no housing has."""


def explain(
    verdict: str,
    reason_codes: Collection[str],
    rig: Rig,
    calibration: CalibrationResult,
    frame_names: Sequence[str] | None = None,
    progress: Progress = silent,
) -> tuple[Explanation, ...]:
    """`diagnose`, where the verdict on a result is not that it fits.

    Args:
        verdict: See `uwsfm.trust.verdict`; that a result fits ends the matter.
        reason_codes: Of that verdict.
        rig: As given.
        calibration: The result.
        frame_names: As of `diagnose`.
        progress: Called with each trial.
    """
    if verdict == FITS:
        return ()
    scene, _ = calibration.scene.select(calibration.inliers)
    found = diagnose(rig, scene, frame_names, progress, **options_of(calibration))
    return moderated(found, reason_codes)


def moderated(
    found: tuple[Explanation, ...], reason_codes: Collection[str]
) -> tuple[Explanation, ...]:
    """Explanations in words that claim no more than the verdict's reasons allow."""
    if FEW_OBSERVATIONS not in reason_codes:
        return found
    return tuple(map(of_few_observations, found))


def options_of(calibration: CalibrationResult) -> dict[str, Any]:
    """What a result was asked to refine and knew, beside its rig file, for `diagnose`.

    Another strategy or error than the joint one on pixels is left out: mistakes show in
    pixels.
    """
    given, plain = calibration.options, CalibrateOptions()
    pairs = ((name, getattr(given, name)) for name in KEPT)
    return {name: value for name, value in pairs if value != getattr(plain, name)}


KEPT = (*PRIORS, *REFINABLE.values(), "separate_water_index")
"""Fields of `CalibrateOptions` that a trial takes over from the result."""


def diagnose(
    rig: Rig,
    scene: Scene,
    frame_names: Sequence[str] | None = None,
    progress: Progress = silent,
    **options: Any,
) -> tuple[Explanation, ...]:
    """Mistakes that explain the observations, best first; none where the rig fits.

    Args:
        rig: As given: lenses, initial ports, placement, and what is to be refined.
        scene: The result with it.
        frame_names: Of the scene's frames (F), for the words; None: their numbers.
        progress: Called with each trial.
        **options: Fields of `CalibrateOptions` that the result was made with.
    """
    part, frames = thinned(scene)
    names = [frame_names[f] if frame_names else f"{f + 1}" for f in frames.tolist()]
    experiments = Experiments(options, progress)
    base = experiments.given(rig, part)
    todo = [
        *trials(rig, part.num_frames),
        *length_trials(rig, base.fit.distances_m()),
        *shifts_since(rig, part, base.fit, names),
    ]
    tried = experiments.all(todo, part)
    tried += _zooms(experiments, rig, part, names, (base, *tried))
    if tried:
        best_fit = min(tried, key=lambda one: one.total).fit
        base = experiments.again(base, best_fit, part)
    return explanations(base, without_refuted(tried))


def without_refuted(tried: Sequence[Tried]) -> list[Tried]:
    """Orders and signs of distortion coefficients against coefficients that are free.

    The free ones contain the others. So an order that is right fits as well as they do;
    one that fits worse is refuted by them.
    """

    def plain(one: Tried) -> float:
        return one.total - one.trial.handicap

    free = [plain(one) for one in tried if one.trial.code == "distortion"]
    limit = min(free, default=math.inf) + AS_GOOD
    return [
        one
        for one in tried
        if one.trial.code not in OF_DISTORTION or plain(one) <= limit
    ]


def _zooms(
    experiments: Experiments,
    rig: Rig,
    part: Scene,
    names: Sequence[str],
    tried: Sequence[Tried],
) -> list[Tried]:
    """The likeliest change of zoom, if it explains clearly more than one focal length.

    Args:
        experiments: Runs the trials.
        rig: As given.
        part: The observations.
        names: Of its frames.
        tried: The rig as given, and the other trials.
    """
    firsts = coarse_firsts(part.num_frames)
    found = experiments.all([zoom_trial(rig, f, names[f]) for f in firsts], part)
    if not found:
        return []
    best = min(found, key=lambda one: one.total)
    near = fine_firsts(best.trial.first, part.num_frames)
    found += experiments.all([zoom_trial(rig, f, names[f]) for f in near], part)
    best = min(found, key=lambda one: one.total)
    assert isinstance(best.trial, ZoomTrial)
    found += experiments.all(nearby_zooms(best.trial, best.fit), part)
    best = min(found, key=lambda one: one.total)
    common = [one.total for one in tried if one.trial.code in ("", "focal")]
    return [best] if best.total <= min(common) - CLEAR else []


class Experiments:
    """Runs trials, and counts them."""

    def __init__(self, options: dict[str, Any], progress: Progress) -> None:
        self.options = options
        self.progress = progress
        self.done = 0

    def tried(self, trial: Trial, part: Scene) -> Tried | None:
        self.done += 1
        self.progress("looking for the cause", self.done, None)
        with limited(1):  # a few hundred points are not worth a second thread
            fit = trial.fit(part, self.options)
        if fit is None:
            return None
        return Tried(trial, fit, strain_of(trial.rig, fit) + trial.handicap)

    def given(self, rig: Rig, part: Scene) -> Tried:
        """The rig as given: adjusted anew, or as the result has it."""
        trial = Trial(code="", what="", remedy="", rig=rig)
        placement = part.cam_from_rig if rig.cam_from_rig is None else rig.cam_from_rig
        fit = fit_of(retriangulated_where_lost(part), placement)
        result = Tried(trial, fit, strain_of(rig, fit))
        anew = self.tried(trial, part)
        return result if anew is None or result.total < anew.total else anew

    def again(self, base: Tried, best: Fit, part: Scene) -> Tried:
        """The rig as given, from the poses of the best trial: from the ones that it
        bent it may not have come back."""
        if best.scene.num_frames != part.num_frames:
            return base
        poses = replace(
            part,
            rig_from_world=best.scene.rig_from_world,
            cam_from_rig=best.scene.cam_from_rig,
        )
        anew = self.tried(base.trial, poses)
        return base if anew is None or base.total < anew.total else anew

    def all(self, todo: Iterable[Trial], part: Scene) -> list[Tried]:
        found = (self.tried(trial, part) for trial in todo)
        return [one for one in found if one is not None]


def strain_of(rig: Rig, fit: Fit) -> float:
    """How far ports and placement are from the rig file's, beyond what is usual."""
    total = 0.0
    for item, port in zip(rig.cameras, fit.scene.ports, strict=True):
        if isinstance(port, PlanePort) and isinstance(item.port, PlanePort):
            if item.refine_distance:
                total += _distance_strain(port.distance, item.port.distance)
            tilt = float(np.degrees(np.arccos(min(port.normal[2], 1.0))))
            total += _beyond(tilt, MAX_TILT_DEG, 5.0)
        if isinstance(port, DomePort):
            offset = float(np.linalg.norm(port.center)) / port.radius
            total += _beyond(offset, 0.3, 0.1)
    return total + _beyond(fit.turn_deg, 0.5, 0.5) + _beyond(fit.swing_deg, 1.0, 1.0)


def _distance_strain(distance: float, given: float) -> float:
    """Of a port's distance against the ruler's."""
    ruler = math.hypot(RULER_M, RULER_SHARE * min(distance, given))
    at_zero = AT_ZERO if distance < 5e-4 < given else 0.0
    return _beyond(abs(distance - given) / ruler, 2.0, 1.0) + at_zero


def _beyond(value: float, usual: float, step: float) -> float:
    return min(max(value - usual, 0.0) / step, 8.0)
