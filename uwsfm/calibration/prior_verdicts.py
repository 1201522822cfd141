"""Whether the images add anything to a prior that nobody asked for, in words."""

import math
from collections.abc import Sequence

from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.calibration.priors import prior_stddevs
from uwsfm.calibration.result import CalibrationResult
from uwsfm.solver.layout import HELD

DETERMINED_BY_IMAGES, HELD_BY_PRIOR = 0.5, 0.9
"""Shares of a prior's standard deviation: what the images leave of it is below the
first where they determine a number, and above the second where they show nothing."""


def prior_verdict(
    result: CalibrationResult, parameter: Parameter, camera: int
) -> str | None:
    """Whether the images add to the prior of what always has one: a word for people.

    Args:
        result: of a calibration.
        parameter: that it refined.
        camera: that it is of.

    Returns:
        None for what has a prior only if somebody gives one.
    """
    if not parameter.has_prior_by_accuracy:
        return None
    stddev, prior = _with_prior(result, parameter, camera)
    if stddev < DETERMINED_BY_IMAGES * prior:
        return "determined"
    if stddev < HELD_BY_PRIOR * prior:
        return "weakly determined"
    return "held by the prior" if math.isfinite(stddev) else "not determined"


def _with_prior(
    result: CalibrationResult, parameter: Parameter, camera: int
) -> tuple[float, float]:
    """Standard deviations from images and prior together, and of the prior alone."""
    columns = result.covariance.border_cols
    column, slot = columns[camera, parameter.first], parameter.first
    alone = prior_stddevs(result.scene, result.options, columns)[camera, slot]
    together = math.sqrt(result.covariance.border[column, column])
    return together, float(alone)


def held_by_priors(result: CalibrationResult, names: Sequence[str]) -> list[str]:
    """Numbers that were refined, of which the images show nothing."""
    sentences = []
    for c, name in enumerate(names):
        for each in OF_PORTS:
            refined = result.covariance.border_cols[c, each.first] != HELD
            has = each.of(result.scene.ports[c])
            if not (refined and has and each.prior is not None):
                continue
            if prior_verdict(result, each, c) == "held by the prior":
                left, known = (
                    each.unit.shown(stddev, ".2g")
                    for stddev in _with_prior(result, each, c)
                )
                sentences.append(
                    f"the {each.name} of {name} is held by the prior: the images leave "
                    f"± {left} of its ± {known}; hold it, or measure it and state its "
                    "accuracy in the rig file"
                )
    return sentences
