"""From trials to sentences: which of them explain the observations, and how well."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from uwsfm.models.ports.port import PlanePort
from uwsfm.trust.mistakes import Trial
from uwsfm.trust.trials import TRIMMED, Fit

UNIT = 0.02
"""A fall of the RMS by so much, relative, counts one; so do the strains below."""
CLEAR = 1.5
"""An explanation must be better than the rig as given by so many."""
SURE = 6.0
"""An explanation that is better by more is no coincidence."""
TIE = 1.5
"""Explanations nearer than this to the best cannot be told apart."""
HARDLY = 50.0
"""Chi-square that an explanation must save where none is clear: a dozen numbers save 45
by chance once in 10^5 times. The verdict has found that something is wrong."""
CLEAN_PX = 3.0
"""With a larger RMS there are gross errors among the observations, and not chance but
they decide about a per cent of it."""
HARDLY_TIE = 0.25
FREE_SHARE = 0.2
"""Of the handicap of numbers that are set free, where so little tells: two of them
save 0.4 % of the RMS of some 4000 coordinates, 30 of chi-square, hardly ever."""
AS_GOOD = 0.5
"""A hypothesis fits as well as another that contains it: 1 % of the RMS of some 4000
coordinates is 80 of chi square, where a dozen free numbers take a dozen."""
MAX_EXPLANATIONS = 3
OF_WHAT = "of the best 90 % of a sample of the observations"
"""See `uwsfm.trust.trials`: a mistake makes outliers of good matches."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """A mistake that explains the observations."""

    code: str
    """See `uwsfm.sfm.correction.CODES`."""
    text: str
    """A sentence for people: the mistake, its evidence, and what to change."""
    rms_before_px: float
    """Of the best 90 % of the observations, with the rig as given."""
    rms_after_px: float
    """With the mistake undone."""
    gain: float
    """How much better, in steps of 2 % of the RMS; ports and placement that stay near
    the rig file's count as well."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def of_few_observations(found: Explanation) -> Explanation:
    """An explanation of the few observations that the adjustment kept, in words that
    claim no more: most of what the images show may have another cause."""
    text = found.text.replace("Probably ", "Perhaps ", 1)
    text += " Most observations were left out, and may have another cause."
    return replace(found, text=text)


@dataclass(frozen=True)
class Tried:
    """One trial and what came of it."""

    trial: Trial
    fit: Fit
    strain: float
    """How implausible its numbers are, in steps of 2 % of the RMS."""

    @property
    def misfit(self) -> float:
        """Of the residuals alone, in the same steps."""
        return math.log(max(self.fit.rms_px, 1e-9)) / UNIT

    @property
    def total(self) -> float:
        return self.misfit + self.strain


def explanations(base: Tried, tried: Iterable[Tried]) -> tuple[Explanation, ...]:
    """Those that are clearly better, one of each kind: best first, and before it what
    leaves clearly smaller residuals. Where none is, those that are better by more than
    chance."""
    tried = list(tried)
    better = [one for one in tried if base.total - one.total >= CLEAR]
    better.sort(key=lambda one: one.total)
    chosen: list[Tried] = []
    for one in better:
        if one.total - better[0].total > TIE:
            break
        if all(one.trial.code != other.trial.code for other in chosen):
            chosen.append(_of_fewest_cameras(one, better))
    # Of those that cannot be told apart, what the images say goes before what is usual.
    limit = min((one.fit.rms_px for one in chosen), default=0.0) * (1.0 + CLEAR * UNIT)
    chosen.sort(key=lambda one: (one.fit.rms_px > limit, one.total))
    if not chosen:
        return _hardly(base, tried)
    if base.total - chosen[0].total < SURE:
        chosen += _contained(chosen, tried)
    return tuple(_explained(base, one) for one in chosen[:MAX_EXPLANATIONS])


def _contained(chosen: Sequence[Tried], tried: Sequence[Tried]) -> list[Tried]:
    """Coefficients that are free, beside an order of them that gains little: it may be
    right by chance, where one of them is wrong and nobody mistook any order."""
    codes = {one.trial.code for one in chosen}
    if chosen[0].trial.code != "distortion_order" or "distortion" in codes:
        return []
    free = [one for one in tried if one.trial.code == "distortion"]
    best = min(free, key=lambda one: one.total, default=None)
    if best is None or best.misfit > chosen[0].misfit + AS_GOOD:
        return []
    return [best]


def _hardly(base: Tried, tried: Sequence[Tried]) -> tuple[Explanation, ...]:
    """What explains the observations better by little, and yet by more than chance."""
    if base.fit.rms_px > CLEAN_PX:
        return ()

    def total(one: Tried) -> float:
        return one.total - (1.0 - FREE_SHARE) * one.trial.handicap

    coordinates = 2.0 * TRIMMED * len(base.fit.squares)
    better = [
        one
        for one in tried
        if 2.0 * coordinates * UNIT * (base.misfit - one.misfit) >= HARDLY
        and total(one) < base.total
    ]
    better.sort(key=total)
    chosen: list[Tried] = []
    for one in better:
        near = total(one) - total(better[0]) <= HARDLY_TIE
        if near and all(one.trial.code != other.trial.code for other in chosen):
            chosen.append(one)
    return tuple(
        _explained(base, one, clear=False) for one in chosen[:MAX_EXPLANATIONS]
    )


def _of_fewest_cameras(best: Tried, better: Iterable[Tried]) -> Tried:
    """The trial of the same kind that accuses the fewest cameras and explains as well:
    numbers that are right and set free change nothing, and fit no worse."""
    as_good = (
        one
        for one in better
        if one.trial.code == best.trial.code and one.total - best.total <= AS_GOOD
    )

    def rank(one: Tried) -> tuple[int, float]:
        concerned = one.trial.cameras or one.trial.rig.cameras
        return len(concerned), one.total

    return min(as_good, key=rank)


def _explained(base: Tried, one: Tried, *, clear: bool = True) -> Explanation:
    before, after = base.fit.rms_px, one.fit.rms_px
    evidence = [f"the RMS error {OF_WHAT} falls from {before:.2f} to {after:.2f} px"]
    if not clear:
        evidence = [
            f"the RMS error {OF_WHAT} falls from {before:.4g} to {after:.4g} px, which "
            "is more than chance, but little"
        ]
    elif before < after * (1.0 + UNIT):
        evidence = [f"the RMS error {OF_WHAT} stays at {after:.2f} px"]
    evidence += [*_port_evidence(base, one), *_turn_evidence(base, one)]
    told, remedy = one.trial.estimate(one.fit), one.trial.remedy
    word = "Probably" if clear else "Perhaps"
    return Explanation(
        code=one.trial.code,
        text=f"{word} {one.trial.what}{told}. Without this mistake "
        f"{', '.join(evidence)}. {remedy[0].upper()}{remedy[1:]}.",
        rms_before_px=before,
        rms_after_px=after,
        gain=base.total - one.total,
    )


def _port_evidence(base: Tried, one: Tried) -> list[str]:
    before, after = base.fit.distances_m(), one.fit.distances_m()
    given = [
        item.port.distance
        for item in one.trial.rig.cameras
        if isinstance(item.port, PlanePort)
    ]
    if not before or base.strain < 1.0:
        return []
    text = f"while in this test, of a sample, ports at {_millimetres(before)}"
    if after and np.allclose(before, after, rtol=0.1, atol=1e-3):
        return []
    if after:
        text += f" become {_millimetres(after)} (rig file: {_millimetres(given)})"
        return [text]
    return [f"{text} are no longer needed"]


def _turn_evidence(base: Tried, one: Tried) -> list[str]:
    before, after = base.fit.turn_deg, one.fit.turn_deg
    if before < 0.5 or after > 0.5 * before:
        return []
    return [f"and cam_from_rig turns by {after:.1f} degrees in place of {before:.1f}"]


def _millimetres(values: Sequence[float]) -> str:
    return " and ".join(f"{1e3 * value:.0f}" for value in values) + " mm"
