"""housing.yaml: the refined rig, in the format of the rig file."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm.calibration.length_verdicts import small_unit
from uwsfm.calibration.named_covariance import without_names
from uwsfm.calibration.observability import center_verdict, distance_verdict
from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.calibration.result import CalibrationResult, CameraCovariance
from uwsfm.models.ports.port import DomePort, PlanePort
from uwsfm.results.refined import RefinedNumber, refined_numbers
from uwsfm.results.verdict_summary import shown_word
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig, RigCamera
from uwsfm.solver.layout import HELD
from uwsfm.trust.verdict import FITS

GIVEN = """The rig as given for this result, before anything was refined."""
HEADER = """The rig as refined by uwsfm from underwater images; loadable as a rig file.
Standard deviations are one sigma; normals are unit vectors from camera to water.
"estimated" lets it hold what no person would type; "accuracy" is in all."""
ARBITRARY = """Scale arbitrary: nothing determined it. Every length below that was
refined is in the arbitrary unit of the model, not in metres."""


def export_housing(
    rig: Rig,
    path: str | Path,
    calibration: CalibrationResult | None = None,
    *,
    verdict: str = FITS,
) -> None:
    """Write a rig, with standard deviations as comments if known.

    Args:
        rig: As refined.
        path: The file.
        calibration: The result that it is of.
        verdict: On that result; the comments say no more than it does, and no job
            takes what does not fit as given.
    """
    comments, header, arbitrary = {}, HEADER, False
    if calibration is not None:
        arbitrary = calibration.covariance.scale_stddev is None
        if arbitrary:
            header = f"{HEADER}\n{ARBITRARY}"
        if verdict != FITS:
            header += f"\nVerdict: {verdict}. The reasons are in the summary beside it."
        comments = {
            camera.name: _comments(rig, calibration, index, verdict)
            for index, camera in enumerate(rig.cameras)
        }
        glass = _glass(rig, calibration)
        for number in glass:
            lines = comments[rig.cameras[number.camera].name]
            lines.append(_comment(number, verdict))
        rig = replace(_with_accuracy(rig, calibration, glass), verdict=verdict)
    dump_rig(
        rig,
        path,
        header,
        comments,
        arbitrary_scale=arbitrary,
        estimated=calibration is not None,
    )


def _glass(rig: Rig, calibration: CalibrationResult) -> list[RefinedNumber]:
    """Refined numbers whose accuracy was their prior, and is better known now."""
    columns = calibration.covariance.border_cols
    kinds = [each for each in OF_PORTS if each.has_prior_by_accuracy]
    if not any(np.any(columns[:, each.first] != HELD) for each in kinds):
        return []
    return [n for n in refined_numbers(rig, calibration) if n.parameter in kinds]


def _comment(number: RefinedNumber, verdict: str) -> str:
    own, total = (
        number.parameter.unit.shown(value, ".4g")
        for value in (number.stddev, number.stddev_in_all)
    )
    return (
        f"{number.parameter.name}: standard deviation {own} from the images and the "
        f"prior, {total} in all: {shown_word(number.verdict or '', verdict)}"
    )


def _with_accuracy(
    rig: Rig, calibration: CalibrationResult, glass: Sequence[RefinedNumber]
) -> Rig:
    """The rig with what is known of its estimates, for whoever holds them next."""
    known = calibration.covariance.judged_cameras
    turned = calibration.options.refine_cam_from_rig
    cameras, covariance = [], rig.accuracy.covariance
    for c, (camera, cov) in enumerate(zip(rig.cameras, known, strict=True)):
        found: dict[str, Any] = {}
        if camera.refine_normal:
            found["normal_deg"] = cov.normal_stddev_deg
        if camera.refine_distance and not cov.distance_at_zero:
            found["distance_m"] = cov.distance_stddev_m
        if camera.refine_center:
            found["center_m"] = math.hypot(*cov.center_stddev_m) / math.sqrt(3.0)
        if c > 0 and turned:
            found["rotation_deg"] = cov.rotation_stddev_deg / math.sqrt(3.0)
            if covariance is not None:  # which was of the rotation before
                covariance = without_names(covariance, f"{camera.name}.rotation_")
        for number in glass:
            if number.camera == c and number.parameter.accuracy is not None:
                found[number.parameter.accuracy.key] = number.stddev_in_all
        digits: dict[str, Any] = {
            key: float(f"{value:.4g}")
            for key, value in found.items()
            if math.isfinite(value)
        }
        cameras.append(replace(camera, accuracy=replace(camera.accuracy, **digits)))
    accuracy = replace(rig.accuracy, covariance=covariance)
    return replace(rig, cameras=tuple(cameras), accuracy=accuracy)


def export_given_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as it was given, for `uwsfm check` to find the mistake in it."""
    dump_rig(rig, path, GIVEN, {})


def _comments(
    rig: Rig, calibration: CalibrationResult, index: int, verdict: str
) -> list[str]:
    camera = rig.cameras[index]
    cov = calibration.covariance.cameras[index]
    in_all = calibration.covariance.judged_cameras[index]
    port = calibration.scene.ports[index]
    unit = small_unit(calibration.covariance.scale_stddev)
    lines = []
    if not calibration.covariance.determined:
        return ["the images do not determine this housing: no standard deviations"]
    if isinstance(port, DomePort) and camera.refine_center:
        own, total = (
            ", ".join(f"{1e3 * value:.3f}" for value in c.center_stddev_m)
            for c in (cov, in_all)
        )
        word = shown_word(center_verdict(port.radius, in_all, True), verdict)
        lines.append(
            f"center: standard deviation {own} {unit} from the images, {total} in all: "
            f"{word}"
        )
    if isinstance(port, PlanePort):
        lines += _plane_comments(camera, port, (cov, in_all), unit, verdict)
    if index > 0 and calibration.options.refine_cam_from_rig:
        lines.append(
            f"rotation: standard deviation {cov.rotation_stddev_deg:.4f} deg from the "
            f"images, {in_all.rotation_stddev_deg:.4f} in all, of the whole angle; "
            "rotation_deg below is per axis"
        )
    return lines


def _plane_comments(
    camera: RigCamera,
    port: PlanePort,
    both: tuple[CameraCovariance, CameraCovariance],
    unit: str,
    verdict: str,
) -> list[str]:
    cov, in_all = both
    lines = []
    if camera.refine_normal:
        lines.append(
            f"normal: standard deviation {cov.normal_stddev_deg:.4f} deg from the "
            f"images, {in_all.normal_stddev_deg:.4f} in all"
        )
    word = distance_verdict(port.distance, in_all, camera.refine_distance)
    word = shown_word(word, verdict)
    if cov.distance_at_zero:
        lines.append(f"distance: {word}; the images contradict the lens in air")
    elif camera.refine_distance:
        lines.append(
            f"distance: standard deviation {1e3 * cov.distance_stddev_m:.3f} {unit} "
            f"from the images, {1e3 * in_all.distance_stddev_m:.3f} in all: {word}"
        )
    return lines
