"""What was refined beside ports and placement: glass, water, baselines, lenses."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwsfm.calibration.enlarged import column_factors
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import (
    BASELINE,
    DISTORTION,
    FOCAL,
    LENS,
    OF_PORTS,
    PARAMETERS,
    PRINCIPAL_POINT,
    WATER_INDEX,
    lens_parameter,
)
from uwsfm.calibration.prior_verdicts import prior_verdict
from uwsfm.calibration.relinearized import reopened
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.uncertainty import border_covariance
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import param_slots
from uwsfm.residuals import border
from uwsfm.rig.rig import Rig
from uwsfm.solver.layout import HELD


@dataclass(frozen=True)
class _Place:
    """Where one number is, and what it is."""

    parameter: Parameter
    camera: int
    slot: int
    name: str
    value: float


@dataclass(frozen=True, kw_only=True)
class RefinedNumber:
    """One estimate, in memory's unit."""

    parameter: Parameter
    camera: int
    """The first that has it."""
    name: str
    """As lists have it."""
    value: float
    stddev: float
    """From the images and priors; NaN: not determined."""
    stddev_in_all: float
    verdict: str | None
    """Of what has a prior by default: whether the images add to it."""


def refined_numbers(
    rig: Rig, calibration: CalibrationResult
) -> tuple[RefinedNumber, ...]:
    """Estimates beside ports and placement, in the order of lists."""
    covariance = calibration.covariance
    refined = [
        place
        for place in _places(rig, calibration)
        if covariance.border_cols[place.camera, place.slot] != HELD
    ]
    if not refined:
        return ()
    stddevs, in_all = _stddevs(calibration)
    found = []
    for place in refined:
        column = int(covariance.border_cols[place.camera, place.slot])
        found.append(
            RefinedNumber(
                parameter=place.parameter,
                camera=place.camera,
                name=place.name,
                value=place.value,
                stddev=float(stddevs[column]),
                stddev_in_all=float(in_all[column]),
                verdict=prior_verdict(calibration, place.parameter, place.camera),
            )
        )
    return tuple(found)


def refined_summary(rig: Rig, calibration: CalibrationResult) -> list[dict[str, Any]]:
    """The same as entries of summary.json."""
    entries = []
    for number in refined_numbers(rig, calibration):
        entry = {
            "name": number.name,
            "value": number.value,
            "stddev": _finite(number.stddev),
            "stddev_in_all": _finite(number.stddev_in_all),
        }
        if number.verdict is not None:
            entry["verdict"] = number.verdict
        entries.append(entry)
    return entries


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _stddevs(calibration: CalibrationResult) -> tuple[Array, Array]:
    """Standard deviations (B,) of what was refined: from the images, and in all."""
    covariance, scene = calibration.covariance, calibration.scene
    # As of ports: what neighbouring features share is in it.
    grow = column_factors(covariance, scene.ports, covariance.enlarged)
    variances = grow**2 * np.diag(border_covariance(reopened(calibration)))
    stddevs = in_all = np.sqrt(variances)
    if covariance.in_all is not None:
        added = np.diag(covariance.in_all.border) - np.diag(covariance.border)
        in_all = np.sqrt(variances + added)
    return stddevs, in_all


def _places(rig: Rig, calibration: CalibrationResult) -> Iterator[_Place]:
    """Every number that is listed, held or not: the water first, then by camera."""
    scene = calibration.scene
    waters = calibration.covariance.border_cols[:, WATER_INDEX.first]
    for c in [c for c in range(len(waters)) if waters[c] not in waters[:c]]:
        name = WATER_INDEX.name
        if len({*waters} - {HELD}) > 1:
            name += f" at {rig.cameras[c].name}"
        index = scene.ports[c].n_water
        yield _Place(WATER_INDEX, c, WATER_INDEX.first, name, index)
    for c, item in enumerate(rig.cameras):
        length = float(np.linalg.norm(scene.cam_from_rig[c, 4:]))
        name = BASELINE.listed_name(item.name)
        yield _Place(BASELINE, c, BASELINE.first, name, length)
        for each in OF_PORTS:
            has = each.of(scene.ports[c])
            if has and each.listed and each is not WATER_INDEX:
                value = float(scene.ports[c].row[each.column])
                name = each.listed_name(item.name)
                yield _Place(each, c, each.first, name, value)
        lens = scene.cameras[c].camera
        names = item.camera.params_info.split(", ")
        slots = param_slots(lens.model_name)
        for name, slot, value in zip(names, slots, lens.params, strict=True):
            place = border.FIRST_LENS + slot
            parameter = lens_parameter(place)
            text = parameter.listed_name(item.name, name)
            yield _Place(parameter, c, place, text, float(value))


def listed(text: str) -> tuple[Parameter, str, str]:
    """What a name in a list of estimates is of.

    Args:
        text: as of `RefinedNumber.name`; without a camera if all share the number.

    Returns:
        The parameter, the name of the number, and the camera, or nothing.
    """
    name, _, camera = text.partition(" of ")
    for each in PARAMETERS:
        if each.listed and each not in LENS and name.startswith(each.name):
            return each, name, camera.removesuffix(each.unit.noted)
    if name in ("f", "fx", "fy"):
        return FOCAL, name, camera
    return (PRINCIPAL_POINT if name in ("cx", "cy") else DISTORTION), name, camera
