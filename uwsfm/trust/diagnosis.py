"""Which mistake explains the observations? Every one is undone, and tried.

An adjustment of a few hundred points takes a tenth of a second. A mistake is named
where a result without it explains the images clearly better, or as well with ports and
a placement that are near the rig file's, which the result with it has left.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from uwsfm._progress import Progress, silent
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import DomePort, FlatPort
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.trust.mistakes import LENS, Trial, trials
from uwsfm.trust.trials import Fit, adjusted, thinned, trimmed_rms

UNIT = 0.03
"""A fall of the RMS by so much, relative, counts one; so do the strains below."""
CLEAR = 4.0
"""An explanation must be better than the rig as given by so many."""
TIE = 1.5
"""Explanations nearer than this to the best cannot be told apart."""
FREE = 2.0
"""What a trial that frees numbers must be better by: it always fits better."""
MAX_EXPLANATIONS = 3


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A mistake that explains the observations."""

    code: str
    """See `uwsfm.sfm.rig_mistakes.CODES`."""
    text: str
    """A sentence for people: the mistake, its evidence, and what to change."""
    rms_before_px: float
    """Of the best 90 % of the observations, with the rig as given."""
    rms_after_px: float
    """With the mistake undone."""
    gain: float
    """How much better, in steps of 3 % of the RMS; ports and placement that stay near
    the rig file's count as well."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class _Tried:
    trial: Trial
    fit: Fit
    strain: float

    @property
    def total(self) -> float:
        return math.log(max(self.fit.rms_px, 1e-9)) / UNIT + self.strain


def diagnose(
    rig: Rig, scene: Scene, progress: Progress = silent, **options: Any
) -> tuple[Explanation, ...]:
    """Mistakes that explain the observations, best first; none where the rig fits.

    Args:
        rig: As given: lenses, initial ports, placement, and what is to be refined.
        scene: The result with it, or anything with its observations and poses.
        progress: Called with each trial.
        **options: Fields of `CalibrateOptions` that the result was made with.
    """
    part = thinned(scene)
    given = Trial(code="", what="", remedy="", rig=rig)
    base = _base(given, part, options)
    if base is None:
        return ()
    todo = list(trials(rig, part.num_frames))
    tried = []
    for done, trial in enumerate(todo):
        progress("looking for the cause", done, len(todo))
        one = _try(trial, part, options)
        if one is not None:
            tried.append(one)
    progress("looking for the cause", len(todo), len(todo))
    return explanations(base, tried)


def _base(given: Trial, part: Scene, options: dict[str, Any]) -> _Tried | None:
    """The rig as given: as the result has it, or adjusted anew, whichever fits."""
    return _try(given, part, options)


def _try(trial: Trial, part: Scene, options: dict[str, Any]) -> _Tried | None:
    seen = trial.seen(part)
    fit = adjusted(seen, trial.rig, **{**options, **trial.options})
    if fit is None:
        return None
    extra = FREE if trial.options else 0.0
    return _Tried(trial, fit, strain_of(trial.rig, fit) + extra)


def strain_of(rig: Rig, fit: Fit) -> float:
    """How far ports and placement are from the rig file's, beyond what is usual."""
    total = 0.0
    for item, port in zip(rig.cameras, fit.scene.ports, strict=True):
        if isinstance(port, FlatPort) and isinstance(item.port, FlatPort):
            total += _beyond(_ratio(port.distance, item.port.distance), 1.1, 0.4)
            total += _beyond(float(np.degrees(np.arccos(port.normal[2]))), 15.0, 5.0)
        if isinstance(port, DomePort):
            offset = float(np.linalg.norm(port.center)) / port.radius
            total += _beyond(offset, 0.3, 0.1)
    return total + _beyond(fit.turn_deg, 0.5, 0.5)


def _ratio(distance: float, given: float) -> float:
    """Of a port's distance and the ruler's, as a logarithm; 3 mm are nothing."""
    return abs(math.log((distance + 0.003) / (given + 0.003)))


def _beyond(value: float, usual: float, step: float) -> float:
    return min(max(value - usual, 0.0) / step, 8.0)


def explanations(base: _Tried, tried: Iterable[_Tried]) -> tuple[Explanation, ...]:
    """Those that are clearly better, best first: one of each kind."""
    better = [one for one in tried if base.total - one.total >= CLEAR]
    better.sort(key=lambda one: one.total)
    chosen: list[_Tried] = []
    for one in better:
        if one.total - better[0].total > TIE:
            break
        if all(one.trial.code != other.trial.code for other in chosen):
            chosen.append(one)
    return tuple(_explained(base, one) for one in chosen[:MAX_EXPLANATIONS])


def _explained(base: _Tried, one: _Tried) -> Explanation:
    before, after = base.fit.rms_px, one.fit.rms_px
    return Explanation(
        code=one.trial.code,
        text=f"With {one.trial.what}, {before:.2f} px becomes {after:.2f}. "
        f"Remedy: {one.trial.remedy}.",
        rms_before_px=before,
        rms_after_px=after,
        gain=base.total - one.total,
    )
