"""housing.yaml: the refined rig, in the format of the rig file."""

from pathlib import Path

from uwsfm.calibration.length_verdicts import small_unit
from uwsfm.calibration.observability import center_verdict, distance_verdict
from uwsfm.calibration.problem import CalibrationResult, CameraCovariance
from uwsfm.models.port import DomePort, FlatPort
from uwsfm.rig import Rig, RigCamera
from uwsfm.rig_file import dump_rig

GIVEN = """The rig as given for this result, before anything was refined."""
HEADER = """The rig as refined by uwsfm from underwater images; loadable as a rig file.
Standard deviations are one sigma; normals are unit vectors from camera to water."""
ARBITRARY = """Scale arbitrary: nothing determined it. Every length below that was
refined is in the arbitrary unit of the model, not in metres."""


def export_housing(
    rig: Rig, path: str | Path, calibration: CalibrationResult | None = None
) -> None:
    """Write a rig, with standard deviations as comments if known."""
    comments, header, arbitrary = {}, HEADER, False
    if calibration is not None:
        arbitrary = calibration.covariance.scale_stddev is None
        if arbitrary:
            header = f"{HEADER}\n{ARBITRARY}"
        comments = {
            camera.name: _comments(rig, calibration, index)
            for index, camera in enumerate(rig.cameras)
        }
    dump_rig(rig, path, header, comments, arbitrary_scale=arbitrary)


def export_given_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as it was given, for `uwsfm check` to find the mistake in it."""
    dump_rig(rig, path, GIVEN, {})


def _comments(rig: Rig, calibration: CalibrationResult, index: int) -> list[str]:
    camera = rig.cameras[index]
    cov = calibration.covariance.cameras[index]
    port = calibration.scene.ports[index]
    unit = small_unit(calibration.covariance.scale_stddev)
    lines = []
    if not calibration.covariance.determined:
        return ["the images do not determine this housing: no standard deviations"]
    if isinstance(port, DomePort) and camera.refine_center:
        x, y, z = (f"{1e3 * value:.3f}" for value in cov.center_stddev_m)
        verdict = center_verdict(port.radius, cov, True)
        lines.append(
            f"center: standard deviation {x}, {y}, {z} {unit}, {verdict} by the images"
        )
    if isinstance(port, FlatPort):
        lines += _flat_comments(camera, port, cov, unit)
    if index > 0 and calibration.options.refine_cam_from_rig:
        lines.append(f"rotation: standard deviation {cov.rotation_stddev_deg:.4f} deg")
    return lines


def _flat_comments(
    camera: RigCamera, port: FlatPort, cov: CameraCovariance, unit: str
) -> list[str]:
    lines = []
    if camera.refine_normal:
        lines.append(f"normal: standard deviation {cov.normal_stddev_deg:.4f} deg")
    verdict = distance_verdict(port.distance, cov, camera.refine_distance)
    if cov.distance_at_zero:
        lines.append(f"distance: {verdict}; the images contradict the lens in air")
    elif camera.refine_distance:
        lines.append(
            f"distance: standard deviation {1e3 * cov.distance_stddev_m:.3f} {unit}, "
            f"{verdict} by the images"
        )
    return lines
