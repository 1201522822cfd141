"""A cross-validation as numbers in JSON and as sentences."""

from __future__ import annotations

from typing import Any

from uwsfm.results.verdict_summary import plain
from uwsfm.trust.halves import CrossValidation, Split
from uwsfm.trust.halves_reason import NAMES

KEY = "cross_validation"


def halves_numbers(found: CrossValidation) -> dict[str, Any]:
    """All of a cross-validation, for JSON."""
    return {
        "sentences": halves_sentences(found),
        "enlarged": found.enlarged,
        "unit": found.unit,
        "splits": [plain(_split_numbers(split)) for split in found.splits],
        "omitted": list(found.omitted),
    }


def _split_numbers(split: Split) -> dict[str, Any]:
    maps = split.projections
    ranges = range(len(maps.ranges_m))
    return {
        "name": split.name,
        "num_frames": list(split.num_frames),
        "num_observations": list(split.num_observations),
        "sigma_px": list(split.sigma_px),
        "numbers": [
            {
                "name": number.name,
                "group": number.group,
                "unit": number.unit,
                "values": list(number.values),
                "difference": number.difference,
                "stddev": number.stddev,
                "stddev_in_all": number.stddev_in_all,
                "z": number.z,
            }
            for number in split.numbers
        ],
        "agreements": [vars(agreement) for agreement in split.agreements],
        "lengths": None if split.lengths is None else vars(split.lengths),
        "projections": {
            "ranges_m": maps.ranges_m,
            "rms_px": [maps.rms_px(r) for r in ranges],
            "rms_mm": [maps.rms_mm(r) for r in ranges],
            "px": maps.px,
            "mm": maps.mm,
        },
    }


def halves_sentences(found: CrossValidation) -> list[str]:
    """What a cross-validation says, for people."""
    lines = [_apart(split, found.unit) for split in found.splits]
    for group, factor in found.enlarged.items():
        lines.append(
            f"The halves differ in their {NAMES[group]} by {factor:.1f} times what "
            "their standard deviations predict. These standard deviations are "
            f"enlarged by {factor:.1f}."
        )
    if found.splits and not found.enlarged:
        lines.append(
            "The halves differ by no more than their standard deviations predict."
        )
    return [*lines, *found.omitted]


def _apart(split: Split, unit: str) -> str:
    """How far the projections of two halves differ."""
    first, second = split.num_frames
    halves = f"Halves {split.name} ({first} and {second} frames, each adjusted alone)"
    if not split.numbers:
        return (
            f"{halves} have nothing to differ in but poses and points: no number of "
            "the rig, its ports or lenses is estimated here."
        )
    maps = split.projections
    middle = len(maps.ranges_m) // 2
    small = "mm" if unit == "m" else "thousandths of a unit"
    return (
        f"{halves} project {maps.rms_px(middle):.2g} px apart, which is "
        f"{maps.rms_mm(middle):.2g} {small} at {maps.ranges_m[middle]:.2g} {unit} (RMS "
        "over the image)."
    )
