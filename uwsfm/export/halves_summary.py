"""A cross-validation as numbers in JSON and as sentences, and what it enlarges."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uwsfm.calibration.problem import CalibrationResult
from uwsfm.errors import UwsfmError
from uwsfm.export.verdict_summary import plain
from uwsfm.rig import Rig
from uwsfm.trust.halves import (
    CrossValidation,
    Split,
    costs_little,
    cross_validate,
)

KEY = "cross_validation"
NAMES = {
    "tilt": "port tilts",
    "distance": "port distances",
    "center": "dome centres",
    "rotation": "rotations of cam_from_rig",
    "direction": "directions of the baselines",
    "baseline": "lengths of the baselines",
    "water index": "water indices",
    "lens": "lenses",
    "length": "distances between points",
    "scale": "scale",
}
_OF_PORTS = {"tilt": "normal", "distance": "distance", "center": "center"}
_STDDEVS = {"tilt": "_deg", "distance": "_m", "center": "_m"}


def with_halves(
    summary: Mapping[str, Any], rig: Rig, calibration: CalibrationResult
) -> dict[str, Any]:
    """A summary with its cross-validation, and with deviations enlarged by it, where
    that costs little; else the summary as it is."""
    if not costs_little(calibration) or not calibration.covariance.determined:
        return dict(summary)
    try:
        found = cross_validate(rig, calibration)
    except (UwsfmError, np.linalg.LinAlgError) as error:  # the result is worth more
        return {**summary, KEY: {"omitted": [str(error)]}}
    return with_cross_validation(summary, found)


def with_cross_validation(
    summary: Mapping[str, Any], found: CrossValidation
) -> dict[str, Any]:
    """The summary of a result with its cross-validation.

    Standard deviations that the halves found too small are multiplied by the factor
    that is given beside them; the same again for a summary that has been enlarged.
    """
    before = summary.get(KEY, {}).get("enlarged", {})
    factors = {
        group: found.enlarged.get(group, 1.0) / before.get(group, 1.0)
        for group in NAMES
    }
    cameras = []
    for camera in summary["cameras"]:
        entry = dict(camera)
        for group, name in _OF_PORTS.items():
            unit = _STDDEVS[group]
            _enlarge(entry, f"{name}_stddev", unit, factors[group])
        placed = dict(entry["cam_from_rig"])
        _enlarge(placed, "rotation_stddev", "_deg", factors["rotation"])
        moved = max(factors["direction"], factors["baseline"])
        _enlarge(placed, "translation_stddev", "_m", moved)
        cameras.append({**entry, "cam_from_rig": placed})
    scale = dict(summary["scale"])
    _enlarge(scale, "relative_stddev", "", max(factors["scale"], factors["length"]))
    return {**summary, "cameras": cameras, "scale": scale, KEY: halves_numbers(found)}


def _enlarge(entry: dict[str, Any], name: str, unit: str, factor: float) -> None:
    """Multiply what the images tell; what was given adds to it as before."""
    own, in_all = f"{name}{unit}", f"{name}_in_all{unit}"
    if factor == 1.0 or entry.get(own) is None:
        return
    stddev = np.asarray(entry[own], dtype=np.float64)  # null becomes NaN
    if entry.get(in_all) is not None:
        total = np.asarray(entry[in_all], dtype=np.float64)
        added = np.maximum(total**2 - stddev**2, 0.0)
        entry[in_all] = plain(np.sqrt(added + (factor * stddev) ** 2).tolist())
    entry[own] = plain((factor * stddev).tolist())


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
    unit = "mm" if found.unit == "m" else "thousandths of a unit"
    lines = []
    for split in found.splits:
        maps = split.projections
        middle = len(maps.ranges_m) // 2
        lines.append(
            f"Halves {split.name} ({split.num_frames[0]} and {split.num_frames[1]} "
            f"frames, each adjusted alone) project {maps.rms_px(middle):.2g} px apart, "
            f"which is {maps.rms_mm(middle):.2g} {unit} at {maps.ranges_m[middle]:.2g} "
            f"{found.unit} (RMS over the image)."
        )
    for group, factor in found.enlarged.items():
        lines.append(
            f"The halves differ in their {NAMES[group]} by {factor:.1f} times what "
            "their standard deviations predict. These standard deviations are "
            f"enlarged by {factor:.1f}."
        )
    if not found.enlarged:
        lines.append(
            "The halves differ by no more than their standard deviations predict."
        )
    return [*lines, *found.omitted]
