"""What every job does with its optimum: deviations in all, halves, verdict, notes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.enlarged import enlarged
from uwsfm.calibration.error_budget import ALIKE, BudgetRow, with_budget
from uwsfm.calibration.observability import verdicts
from uwsfm.calibration.result import CalibrationResult
from uwsfm.results.halves_summary import KEY, halves_numbers
from uwsfm.results.summary import budget_summary
from uwsfm.results.verdict_summary import with_verdict
from uwsfm.rig.rig import Rig
from uwsfm.trust.diagnosis import explain
from uwsfm.trust.goodness import Used
from uwsfm.trust.halves import CrossValidation, cross_validate_if_cheap
from uwsfm.trust.halves_reason import (
    enlarged_notes,
    halves_reasons,
    untested_notes,
)
from uwsfm.trust.verdict import DOES_NOT_FIT, FITS, Verdict, judged, with_reasons


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """An optimum with all that is known of it."""

    solved: CalibrationResult
    """With deviations in all; what is stored."""
    calibration: CalibrationResult
    """The same, its deviations enlarged where halves of the frames differ; what is
    shown."""
    budget: tuple[BudgetRow, ...]
    halves: CrossValidation | None
    """None: too few frames, or too many observations to do it without being asked."""
    verdict: Verdict
    untested: tuple[str, ...] = ()
    """Why there are no halves, if that is worth a note."""

    @property
    def word(self) -> str:
        return self.verdict.verdict

    def added_to(self, summary: Mapping[str, Any], rig: Rig) -> dict[str, Any]:
        """A summary with the verdict, the notes, the budget and the halves.

        Args:
            summary: of ``calibration``; its "warnings" go before the notes.
            rig: as refined.
        """
        notes = housing_warnings(rig, self.calibration, self.budget, self.word)
        scale = self.calibration.covariance.scale_stddev
        more: dict[str, Any] = {
            "warnings": [*summary["warnings"], *notes, *self.untested],
            "error_budget": budget_summary(self.budget, scale),
        }
        if self.halves is not None:
            more[KEY] = halves_numbers(self.halves)
        return with_verdict(self.verdict, {**summary, **more})

    def causes(
        self,
        rig: Rig,
        frame_names: Sequence[str] | None = None,
        progress: Progress = silent,
    ) -> list[dict[str, Any]]:
        """What explains an optimum that does not fit, for the summary.

        Args:
            rig: as given.
            frame_names: of the calibration's frames, if they have names.
            progress: called with each trial.
        """
        explained = explain(
            *(self.word, self.verdict.codes, rig, self.calibration),
            frame_names,
            progress,
        )
        return [one.to_json() for one in explained]


def judged_result(
    rig: Rig,
    calibration: CalibrationResult,
    used: Used,
    progress: Progress = silent,
    *,
    in_halves: bool = True,
    has_model: bool = True,
) -> Judgement:
    """Judge an optimum: with its error budget and, where that costs little, by halves.

    Args:
        rig: as given, before anything was refined.
        calibration: the optimum.
        used: how much of the input it has.
        progress: called with each step.
        in_halves: False: the frames hold what halves would differ in.
        has_model: whether the model is stored with the result.
    """
    progress("judging the fit", 0, None)
    solved, budget = with_budget(calibration)
    halves = cross_validate_if_cheap(rig, solved) if in_halves else None
    untested = untested_notes(solved, has_model=has_model) if in_halves else []
    shown = enlarged(solved, {} if halves is None else halves.enlarged)
    return Judgement(
        solved=solved,
        calibration=shown,
        budget=budget,
        halves=halves,
        verdict=with_reasons(judged(rig, shown, used), halves_reasons(halves)),
        untested=tuple(untested),
    )


def _prior_note(budget: Sequence[BudgetRow]) -> list[str]:
    """What a reader might take to be of the images alone."""
    priors = [row.name for row in budget if row.prior and ALIKE not in row.name]
    if not priors:
        return []
    return [
        'standard deviations "from the images" hold what was entered as a prior, too: '
        + ", ".join(priors)
    ]


def housing_warnings(
    rig: Rig,
    calibration: CalibrationResult,
    budget: Sequence[BudgetRow] = (),
    verdict: str = FITS,
) -> list[str]:
    """What is not determined or less well known of the housings, one sentence each.

    Of a result that does not fit nothing is: more frames would not help it.
    """
    names = [camera.name for camera in rig.cameras]
    warnings: list[str] = []
    if verdict != DOES_NOT_FIT:
        warnings += verdicts(calibration, names, budget)
    warnings += enlarged_notes(calibration.covariance.enlarged)
    warnings += _prior_note(budget)
    bare = [c.name for c in rig.cameras if not c.port.refracts]
    if bare:
        warnings.append(
            f"the rig file has no port of {', '.join(bare)}: lenses without one were "
            "taken as calibrated in the water; one that was calibrated in air needs "
            "its port there"
        )
    if calibration.options.error_name == "point_3d":
        warnings.append(
            "the error in space is far more sensitive to noise than the reprojection "
            "error, and biased: its result is for comparison only"
        )
    if not calibration.summary.converged:
        warnings.append("the refractive adjustment stopped before it converged")
    return warnings
