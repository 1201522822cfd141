"""The cross-validation of a summary, as the page and the pictures show it."""

from typing import Any

import numpy as np

from uwsfm.results.halves_summary import KEY
from uwsfm.trust.halves_reason import NAMES


def halves_of(summary: dict[str, Any]) -> dict[str, Any] | None:
    """Sentences, rows of the table, and what the maps are of; None without any."""
    found = summary.get(KEY)
    if not found or not found.get("splits"):
        return None
    rows = {
        "sentences": found["sentences"],
        "rows": [
            {
                "split": split["name"],
                "numbers": NAMES[row["group"]],
                "ratio": f"{row['ratio']:.2f}",
                "chance": _chance(row["p_value"]),
            }
            for split in found["splits"]
            for row in split["agreements"]
        ],
    }
    if not _estimated(found):
        return {**rows, "split": None}
    worse = _worse(found["splits"])
    maps, unit = worse["projections"], found["unit"]
    small = "mm" if unit == "m" else "thousandths of a unit"
    others = [
        f"{px:.2g} px, {mm:.2g} {small} at {far:.2g} {unit}"
        for far, px, mm in zip(
            maps["ranges_m"], maps["rms_px"], maps["rms_mm"], strict=True
        )
        if None not in (px, mm)  # no pixel of both halves sees so far
    ]
    return {
        **rows,
        "split": worse["name"],
        "range": f"{maps['ranges_m'][_middle(maps)]:.2g} {unit}",
        "ranges": f"RMS over all cameras: {'; '.join(others)}.",
    }


def halves_payload(summary: dict[str, Any]) -> dict[str, Any]:
    """What the script draws: a map (rows, columns) per camera, and its darkest, px."""
    found = summary.get(KEY)
    if not found or not found.get("splits") or not _estimated(found):
        return {}
    maps = _worse(found["splits"])["projections"]
    middle = [camera[_middle(maps)] for camera in maps["px"]]
    values = np.array(middle, dtype=np.float64)
    known = values[np.isfinite(values)]
    largest = float(np.percentile(known, 95.0)) if len(known) else 1.0
    return {"halves": middle, "halves_limit": max(largest, 1e-3)}


def _estimated(found: dict[str, Any]) -> bool:
    """Whether anything is that halves could project differently by."""
    return any(split["numbers"] for split in found["splits"])


def _worse(splits: list[dict[str, Any]]) -> dict[str, Any]:
    """The split that projects farther apart."""

    def apart(split: dict[str, Any]) -> float:
        known = [px for px in split["projections"]["rms_px"] if px is not None]
        return max(known, default=0.0)

    return max(splits, key=apart)


def _middle(maps: dict[str, Any]) -> int:
    return len(maps["ranges_m"]) // 2


def _chance(p_value: float) -> str:
    return "< 0.1 %" if p_value < 1e-3 else f"{100.0 * p_value:.2g} %"
