"""housing.yaml: its comments and its accuracies, read back with their units."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hand_made_result import camera_covariance, result_of, small_model

from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.calibration.named_covariance import NamedCovariance
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.results.housing import export_given_rig, export_housing
from uwsfm.rig.file import load_rig

NUMBER = r"\d+(?:\.\d+)?"
MM = 1e-3


@pytest.fixture(scope="module")
def model():
    """Right of two: a dome, left of it a flat port 20 mm away."""
    return small_model(dome=True)


@pytest.fixture(scope="module")
def result(model):
    return result_of(model.scene, options=CalibrateOptions(refine_cam_from_rig=True))


def comments(path):
    """Lines that begin as a comment does, without it."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    return [line.lstrip("# ") for line in lines if line.startswith("#")]


def line_of(path, what, number=0):
    return [line for line in comments(path) if line.startswith(f"{what}: ")][number]


def test_comments_are_the_deviations_from_the_images_and_in_all(
    model, result, tmp_path
):
    path = tmp_path / "housing.yaml"
    export_housing(model.rig, path, result)
    # `camera_covariance`: 0.041 deg, 0.52 mm, and so on, times 2 and 3, or 4 and 5.
    own, total = re.findall(rf"{NUMBER}(?= deg|\d* in all)", line_of(path, "normal"))
    assert (float(own), float(total)) == pytest.approx((0.082, 0.123))
    found = re.fullmatch(
        rf"distance: standard deviation ({NUMBER}) mm from the images, ({NUMBER}) in "
        "all: determined",
        line_of(path, "distance"),
    )
    assert [MM * float(v) for v in found.groups()] == pytest.approx([0.00104, 0.00156])
    found = re.fullmatch(
        r"center: standard deviation (.*) mm from the images, (.*) in all: determined",
        line_of(path, "center"),
    )
    own, total = ([MM * float(v) for v in part.split(",")] for part in found.groups())
    assert own == pytest.approx([5.6e-5, 1e-4, 1.44e-4], abs=5.1e-7)
    assert total == pytest.approx([7e-5, 1.25e-4, 1.8e-4], abs=5.1e-7)
    found = re.fullmatch(
        rf"rotation: standard deviation ({NUMBER}) deg from the images, ({NUMBER}) in "
        "all, of the whole angle; rotation_deg below is per axis",
        line_of(path, "rotation"),
    )
    assert [float(v) for v in found.groups()] == pytest.approx([0.0652, 0.0815])
    # The first camera is the rig, and has no rotation of its own.
    assert len([c for c in comments(path) if c.startswith("rotation")]) == 1
    text = path.read_text(encoding="utf-8")
    assert "Scale arbitrary" not in text and "Verdict:" not in text


def test_accuracies_are_those_in_all_for_whoever_holds_them_next(
    model, result, tmp_path
):
    path = tmp_path / "housing.yaml"
    export_housing(model.rig, path, result)
    left, right = (camera.accuracy for camera in load_rig(path).cameras)
    assert left.normal_deg == pytest.approx(0.123)
    assert left.distance_m == pytest.approx(0.00156)
    assert left.center_m is None and left.rotation_deg is None
    # Per axis: the root mean square of three, and an angle's third of its square.
    center = np.sqrt((7e-5**2 + 1.25e-4**2 + 1.8e-4**2) / 3.0)
    assert right.center_m == pytest.approx(center, rel=1e-3)  # of four digits
    assert right.rotation_deg == pytest.approx(0.0815 / np.sqrt(3.0), rel=1e-3)
    assert right.normal_deg is None and right.distance_m is None


def test_what_was_held_or_not_determined_keeps_the_accuracy_it_had(
    model, result, tmp_path
):
    known = CameraAccuracy(normal_deg=0.7, distance_m=0.003, rotation_deg=0.9)
    left, right = model.rig.cameras
    held = replace(left, refine_normal=False, refine_distance=False, accuracy=known)
    rig = replace(model.rig, cameras=(held, replace(right, accuracy=known)))
    path = tmp_path / "a.yaml"
    options = CalibrateOptions(refine_cam_from_rig=False)
    export_housing(rig, path, replace(result, options=options))
    for camera, expected in zip(
        load_rig(path).cameras, ((0.7, 0.003), (0.7, 0.003)), strict=True
    ):
        found = (camera.accuracy.normal_deg, camera.accuracy.distance_m)
        assert found == expected and camera.accuracy.rotation_deg == 0.9
    assert not [c for c in comments(path) if c.startswith(("normal:", "rotation:"))]
    assert not [c for c in comments(path) if c.startswith("distance:")]
    # Neither NaN nor a distance at its bound is an accuracy.
    lost = (
        camera_covariance(3.0, normal_stddev_deg=np.nan, distance_at_zero=True),
        camera_covariance(5.0),
    )
    in_all = replace(result.covariance.in_all, cameras=lost)
    own = (replace(lost[0]), result.covariance.cameras[1])
    covariance = replace(result.covariance, in_all=in_all, cameras=own)
    rig = replace(model.rig, cameras=(replace(left, accuracy=known), right))
    path = tmp_path / "b.yaml"
    export_housing(rig, path, replace(result, covariance=covariance))
    found = load_rig(path).cameras[0].accuracy
    assert (found.normal_deg, found.distance_m) == (0.7, 0.003)
    assert line_of(path, "distance").startswith("distance: ran into zero; the images")


def test_a_correlation_with_a_rotation_that_was_refined_is_of_the_past(
    model, result, tmp_path
):
    matrix = np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-6
    names = ("left.fx", *(f"right.rotation_{axis}" for axis in "xyz"))
    known = RigAccuracy(covariance=NamedCovariance(names=names, matrix=matrix))
    rig = replace(model.rig, accuracy=known)
    for turned, expected in ((True, names[:1]), (False, names)):
        options = CalibrateOptions(refine_cam_from_rig=turned)
        path = tmp_path / f"{turned}.yaml"
        export_housing(rig, path, replace(result, options=options))
        found = load_rig(path).accuracy.covariance
        assert tuple(found.names) == expected
        assert found.matrix[0, 0] == pytest.approx(1e-6)


def test_comments_say_no_more_than_the_verdict(model, result, tmp_path):
    for verdict, word in (("doubtful", "doubtful"), ("does not fit", "withheld")):
        path = tmp_path / f"{word}.yaml"
        export_housing(model.rig, path, result, verdict=verdict)
        assert line_of(path, "distance").endswith(f"in all: {word}")
        assert line_of(path, "center").endswith(f"in all: {word}")
        assert f"Verdict: {verdict}. The reasons" in path.read_text(encoding="utf-8")
        assert load_rig(path).verdict == verdict


def test_each_number_has_a_comment_if_it_was_refined(model, result, tmp_path):
    left, right = model.rig.cameras
    for k, (tilt, distance, center) in enumerate(
        ((True, False, True), (False, True, False))
    ):
        cameras = (
            replace(left, refine_normal=tilt, refine_distance=distance),
            replace(right, refine_center=center),
        )
        path = tmp_path / f"{k}.yaml"
        export_housing(replace(model.rig, cameras=cameras), path, result)
        begun = [comment.partition(":")[0] for comment in comments(path)]
        found = tuple(
            begun.count(name) == 1 for name in ("normal", "distance", "center")
        )
        assert found == (tilt, distance, center)


def test_an_arbitrary_scale_is_no_millimetre(model, result, tmp_path):
    covariance = replace(result.covariance, scale_stddev=None)
    path = tmp_path / "housing.yaml"
    export_housing(model.rig, path, replace(result, covariance=covariance))
    for what in ("distance", "center"):
        assert "1e-3, scale arbitrary from the images" in line_of(path, what)
    assert "Scale arbitrary: nothing determined it." in path.read_text(encoding="utf-8")


def test_what_the_images_leave_free_has_no_deviation(model, result, tmp_path):
    covariance = replace(result.covariance, determined=False)
    path = tmp_path / "housing.yaml"
    export_housing(model.rig, path, replace(result, covariance=covariance))
    assert len([c for c in comments(path) if "do not determine this housing" in c]) == 2
    assert "standard deviation 1" not in path.read_text(encoding="utf-8")


def test_a_rig_that_was_given_has_no_comments_and_is_read_as_it_was(model, tmp_path):
    path = tmp_path / "rig_given.yaml"
    export_given_rig(model.rig, path)
    assert comments(path)[0].startswith("The rig as given for this result")
    assert "standard deviation" not in path.read_text(encoding="utf-8")
    for before, after in zip(model.rig.cameras, load_rig(path).cameras, strict=True):
        assert np.array_equal(before.port.row, after.port.row)
    plain = tmp_path / "plain.yaml"
    export_housing(model.rig, plain)
    assert "standard deviation" not in "".join(comments(plain)[3:])
