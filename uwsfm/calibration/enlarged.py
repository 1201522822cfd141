"""Standard deviations from the images, enlarged by factors per group of numbers.

Where disjoint halves of the frames differ by more than their standard deviations
predict, those of the whole are too small by as much, see `uwsfm.trust.halves`. They
are enlarged here, once, so that every table, note and file has the same number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from uwsfm.calibration.parameters import PARAMETERS
from uwsfm.calibration.result import (
    CalibrationResult,
    CameraCovariance,
    Covariance,
    InAll,
)
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import Port
from uwsfm.solver.layout import HELD


def enlarged(
    calibration: CalibrationResult, factors: Mapping[str, float]
) -> CalibrationResult:
    """The calibration with larger standard deviations from the images.

    What errors of the given numbers add stays as it is. Poses and points keep theirs.

    Args:
        calibration: as it was solved, not enlarged before.
        factors: by group, as of `uwsfm.trust.shared_numbers`, "length" or "scale".
    """
    covariance, ports = calibration.covariance, calibration.scene.ports
    assert not covariance.enlarged, "deviations are enlarged once"
    if not factors:
        return calibration
    grow = column_factors(covariance, ports, factors)
    own = covariance.border * np.outer(grow, grow)
    cameras = tuple(_camera(each, factors) for each in covariance.cameras)
    of_scale = max(factors.get("scale", 1.0), factors.get("length", 1.0))
    scale = covariance.scale_stddev
    larger = replace(
        covariance,
        border=own,
        cameras=cameras,
        scale_stddev=None if scale is None else of_scale * scale,
        enlarged=dict(factors),
    )
    in_all = covariance.in_all
    if in_all is not None:
        larger = replace(larger, in_all=_in_all(covariance, in_all, larger))
    return replace(calibration, covariance=larger)


def column_factors(
    covariance: Covariance, ports: Sequence[Port], factors: Mapping[str, float]
) -> Array:
    """(B,) factor of each refined parameter."""
    grow = np.ones(len(covariance.border))
    for columns, port in zip(covariance.border_cols, ports, strict=True):
        for parameter in PARAMETERS:
            if parameter.of(port):
                some = np.atleast_1d(columns[parameter.slots])
                grow[some[some != HELD]] = factors.get(parameter.group, 1.0)
    return grow


def _camera(own: CameraCovariance, factors: Mapping[str, float]) -> CameraCovariance:
    moved = max(factors.get("direction", 1.0), factors.get("baseline", 1.0))
    center = factors.get("center", 1.0)
    x, y, z = (moved * value for value in own.translation_stddev_m)
    a, b, c = (center * value for value in own.center_stddev_m)
    return replace(
        own,
        normal_stddev_deg=factors.get("tilt", 1.0) * own.normal_stddev_deg,
        distance_stddev_m=factors.get("distance", 1.0) * own.distance_stddev_m,
        rotation_stddev_deg=factors.get("rotation", 1.0) * own.rotation_stddev_deg,
        translation_stddev_m=(x, y, z),
        center_stddev_m=(a, b, c),
    )


def _in_all(before: Covariance, in_all: InAll, after: Covariance) -> InAll:
    """With the same part of what was given, beside the enlarged one of the images."""
    pairs = zip(before.cameras, in_all.cameras, after.cameras, strict=True)
    cameras = tuple(_exchanged_camera(*three) for three in pairs)
    scale = in_all.scale_stddev
    if scale is not None:
        assert before.scale_stddev is not None and after.scale_stddev is not None
        scale = _exchanged(scale, before.scale_stddev, after.scale_stddev)
    return replace(
        in_all,
        cameras=cameras,
        border=in_all.border - before.border + after.border,
        scale_stddev=scale,
    )


def _exchanged_camera(
    own: CameraCovariance, total: CameraCovariance, larger: CameraCovariance
) -> CameraCovariance:
    def exchanged(name: str) -> list[float]:
        three = (np.atleast_1d(getattr(c, name)).tolist() for c in (total, own, larger))
        return [_exchanged(*each) for each in zip(*three, strict=True)]

    (normal,), (distance,) = map(exchanged, ("normal_stddev_deg", "distance_stddev_m"))
    (rotation,) = exchanged("rotation_stddev_deg")
    x, y, z = exchanged("translation_stddev_m")
    a, b, c = exchanged("center_stddev_m")
    return replace(
        total,
        normal_stddev_deg=normal,
        distance_stddev_m=distance,
        rotation_stddev_deg=rotation,
        translation_stddev_m=(x, y, z),
        center_stddev_m=(a, b, c),
    )


def _exchanged(total: float, own: float, larger: float) -> float:
    """A root sum of squares, with one of its parts in the place of another."""
    return float(np.sqrt(max(total**2 - own**2, 0.0) + larger**2))
