"""Units of the parameters of a covariance, beside those of single accuracies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwsfm.calibration.given_accuracy import GivenCamera, corner_shift


@dataclass(frozen=True, kw_only=True)
class NamedUnit:
    """The unit of a parameter in a covariance, beside that of a single accuracy."""

    unit: str
    """In the covariance: "px", "rad", "m", or "" for coefficients."""
    key: str
    """Of the accuracy that a person would state for it."""
    factor: float
    """How much one ``unit`` is in the unit of ``key``; of "distortion": the share by
    which it moves the image corner."""


def named_unit(cameras: Sequence[GivenCamera], name: str) -> NamedUnit:
    """What a standard deviation of a covariance's parameter compares with.

    A translation turns the baseline, or makes it longer by as much.

    Args:
        cameras: in the rig's order.
        name: CAMERA.PARAMETER, one of those that `given_accuracy` takes.
    """
    camera_name, _, parameter = name.rpartition(".")
    camera = next(one for one in cameras if one.name == camera_name)
    if parameter.startswith("rotation_"):
        factor = float(np.degrees(1.0))
        return NamedUnit(unit="rad", key="rotation_deg", factor=factor)
    if parameter.startswith("translation_"):
        factor = float(np.degrees(1.0) / np.linalg.norm(camera.translation))
        return NamedUnit(unit="m", key="direction_deg", factor=factor)
    slot = camera.slots[camera.param_names.index(parameter)]
    if slot < 2:
        return NamedUnit(unit="px", key="focal", factor=1.0 / float(camera.lens[slot]))
    if slot < 4:
        return NamedUnit(unit="px", key="principal_point_px", factor=1.0)
    factor = corner_shift(camera, slot)
    return NamedUnit(unit="", key="distortion", factor=factor)
