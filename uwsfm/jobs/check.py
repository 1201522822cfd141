"""`uwsfm check`: is a result to be trusted, and if not, which mistake explains it?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm.results.folder import given_rig, open_result
from uwsfm.results.log import job_log, logger
from uwsfm.results.summary import write_json
from uwsfm.trust.diagnosis import diagnose, moderated, options_of
from uwsfm.trust.explanation import Explanation

CHECK = "check.json"


@dataclass(frozen=True, kw_only=True)
class Check:
    """What a check found; the same is in `CHECK`."""

    verdict: str | None
    """Of the result, see `uwsfm.trust.verdict`; None: of a version that gave none."""
    reasons: tuple[dict[str, Any], ...]
    """Of that verdict."""
    explanations: tuple[Explanation, ...]
    """Mistakes that explain the observations, best first; none where the rig fits."""

    def to_json(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "explanations": [one.to_json() for one in self.explanations],
        }


def check_result(out: str | Path, progress: Progress = silent) -> Check:
    """Look for the mistake that explains a result, whatever its verdict.

    Args:
        out: Folder that `reconstruct`, `refine_model` or `run_demo` wrote; receives
            ``check.json``.
        progress: Called with each trial.

    Raises:
        InputError: the folder is not such a one, or lacks the rig file as given.
    """
    result = open_result(out)
    rig = given_rig(result.folder)
    model, summary = result.model, result.summary
    with job_log(result.folder, f"uwsfm check {out}", {}, progress) as log:
        reasons = tuple(summary.get("reasons", ()))
        causes = diagnose(
            rig,
            model.scene,
            model.frame_names,
            log.progress,
            **options_of(result.calibration),
        )
        causes = moderated(causes, {one["code"] for one in reasons})
        found = Check(
            verdict=summary.get("verdict"), reasons=reasons, explanations=causes
        )
        write_json(found.to_json(), result.folder / CHECK)
        if not causes:
            logger.info("no mistake explains the images better than the rig as given")
        log.result(found.to_json())
    return found
