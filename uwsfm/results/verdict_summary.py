"""The verdict at the head of summary.json, and words that never say more than it."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from uwsfm.calibration.length_verdicts import ARBITRARY
from uwsfm.results.schema import SCHEMA_VERSION
from uwsfm.trust.verdict import DOES_NOT_FIT, FITS, Verdict

CONFIDENT = ("determined", "weakly determined")
"""Words that hold only where the model does."""
DOUBTFUL_WORD, WITHHELD = "doubtful", "withheld"


def shown_word(word: str, verdict: str) -> str:
    """How well a number is determined, as far as the verdict on the result allows.

    Args:
        word: of `uwsfm.calibration.observability` or `length_verdicts`.
        verdict: "fits", "doubtful" or "does not fit".
    """
    if verdict == FITS or word not in CONFIDENT:
        return word
    return WITHHELD if verdict == DOES_NOT_FIT else DOUBTFUL_WORD


def with_verdict(verdict: Verdict, summary: Mapping[str, Any]) -> dict[str, Any]:
    """A summary with the verdict, its reasons and numbers first, and its words toned
    down to it."""
    word, scale = verdict.verdict, summary["scale"]
    cameras = [
        {
            key: shown_word(value, word) if key.endswith("_verdict") else value
            for key, value in camera.items()
        }
        for camera in summary["cameras"]
    ]
    first = {
        "schema_version": SCHEMA_VERSION,
        "verdict": word,
        "reasons": [
            {
                "code": reason.code,
                "text": reason.text,
                "severity": reason.severity,
                **{key: plain(value) for key, value in reason.numbers.items()},
            }
            for reason in verdict.reasons
        ],
        "goodness": plain(verdict.goodness),
    }
    rest = {key: value for key, value in summary.items() if key not in first}
    shown = {**scale, "verdict": shown_word(scale["verdict"], word)}
    shown_parts: dict[str, Any] = {"cameras": cameras, "scale": shown}
    if "refined" in summary:
        shown_parts["refined"] = [_shown_row(row, word) for row in summary["refined"]]
    return {**first, **rest, **shown_parts}


def _shown_row(row: dict[str, Any], verdict: str) -> dict[str, Any]:
    """An estimate of a list, whose word claims no more than the verdict."""
    if "verdict" not in row:
        return row
    return {**row, "verdict": shown_word(row["verdict"], verdict)}


def verdict_line(summary: Mapping[str, Any]) -> str:
    """The first line of everything that people read: the verdict as a sentence."""
    word = summary.get("verdict")
    if word is None:
        return (
            "No verdict: an earlier version of uwsfm made this result; run the command "
            "that made it again."
        )
    if word != FITS:
        return f"Verdict: {word}, for {_count(len(summary['reasons']))}."
    word = summary["scale"]["verdict"]
    metric = (
        ""
        if word == ARBITRARY
        else (f" Its scale is {word}, as far as the given lengths are right.")
    )
    return f"Verdict: fits. The model explains the images within their noise.{metric}"


def verdict_note(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """What has to be said beside numbers of a result that does not simply fit."""
    if summary.get("verdict", FITS) == FITS:
        return ()
    first = summary["reasons"][0]["text"]
    return (
        f"the verdict on this result is {summary['verdict']!r}, so the standard "
        f"deviations here may be far too small: {first}",
    )


def _count(number: int) -> str:
    return "one reason" if number == 1 else f"{number} reasons"


def plain(value: Any) -> Any:
    """Data as JSON has them: NaN becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
