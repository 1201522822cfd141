"""Why a result is not simply called fitting."""

from dataclasses import dataclass
from typing import Literal

Severity = Literal["doubtful", "does not fit"]

DOUBTFUL: Severity = "doubtful"
DOES_NOT_FIT: Severity = "does not fit"


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why a result is not simply called fitting."""

    code: str
    text: str
    """One full sentence, with its numbers."""
    severity: Severity
    numbers: dict[str, float]


def reason(code: str, text: str, severity: Severity, **numbers: float) -> Reason:
    """A reason with its numbers."""
    return Reason(code=code, text=text, severity=severity, numbers=numbers)
