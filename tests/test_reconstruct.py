"""The main job on the rendered sample, end to end, beside its truth."""

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from summary_schema import schema_faults

import uwsfm
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.jobs.demo import MAX_FEATURES, run_demo, sample_dir
from uwsfm.jobs.evaluate import Comparison, compare_with_truth
from uwsfm.jobs.reconstruct import ReconstructResult
from uwsfm.sfm.refine import rig_options


@dataclass(frozen=True)
class Demo:
    """A run of the main job, and what it was given."""

    images: Path
    options: dict[str, Any]
    out: Path
    result: ReconstructResult
    comparison: Comparison
    num_pairs: int

    def again(self, **more: Any) -> ReconstructResult:
        """The same command once more."""
        rig = sample_dir() / "rig.yaml"
        return uwsfm.reconstruct(rig, self.images, self.out, **self.options, **more)


def few_pairs(folder: Path) -> Demo:
    """The first eight pairs, and half of the features: a third of the time."""
    for side in ("left", "right"):
        (folder / "images" / side).mkdir(parents=True)
        for path in sorted((sample_dir() / "images" / side).iterdir())[:8]:
            shutil.copy(path, folder / "images" / side / path.name)
    images, options = folder / "images", {"max_features": MAX_FEATURES // 2}
    rig = sample_dir() / "rig.yaml"
    result = uwsfm.reconstruct(rig, images, folder / "out", **options)
    comparison = compare_with_truth(result, sample_dir() / "truth.json")
    return Demo(images, options, folder / "out", result, comparison, 8)


def whole_demo(folder: Path) -> Demo:
    result, comparison = run_demo(folder / "out")
    options = {"max_features": MAX_FEATURES}
    images = sample_dir() / "images"
    return Demo(images, options, folder / "out", result, comparison, 14)


@pytest.fixture(
    scope="module", params=[few_pairs, pytest.param(whole_demo, marks=pytest.mark.slow)]
)
def demo(request, tmp_path_factory) -> Demo:
    return request.param(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="module")
def result(demo) -> ReconstructResult:
    return demo.result


@pytest.fixture(scope="module")
def comparison(demo) -> Comparison:
    return demo.comparison


def test_all_pairs_are_registered(demo, comparison):
    assert comparison.num_true_frames == 14
    assert comparison.num_frames == demo.num_pairs


def test_ports_are_found(comparison):
    """0.1 degree and 1.5 mm are what a diver's own measurements cannot reach."""
    for camera in comparison.cameras:
        assert camera.tilt_error_deg <= 0.1
        assert abs(camera.distance_error_m) <= 1.5e-3


def test_errors_are_what_the_standard_deviations_promise(demo, comparison):
    # Of few pairs a tilt is 0.037 degrees off, 3.1 deviations: what features of all
    # images have in common is not in them.
    limit = 3.0 if demo.num_pairs == 14 else 4.0
    for camera in comparison.cameras:
        assert camera.tilt_stddev_deg is not None
        assert camera.distance_stddev_m is not None
        assert camera.tilt_error_deg <= limit * camera.tilt_stddev_deg
        assert abs(camera.distance_error_m) <= limit * camera.distance_stddev_m
        # And they promise something: the sample was made to determine the housings.
        assert camera.distance_stddev_m < (0.5e-3 if demo.num_pairs == 14 else 1e-3)


def test_standard_deviations_are_those_of_the_noise_found(result):
    """The Cramer-Rao bound of the same views at the noise found; the larger of two
    estimates is reported, of 64 quarters of images and more."""
    scene, sigma = result.calibration.scene, result.calibration.summary.sigma_px
    bound = predict_covariance(scene, sigma, **rig_options(result.model.rig))
    for one, best in zip(
        result.calibration.covariance.cameras, bound.cameras, strict=True
    ):
        assert 0.9 < one.distance_stddev_m / best.distance_stddev_m < 2.0
        assert 0.9 < one.normal_stddev_deg / best.normal_stddev_deg < 2.0
    found, expected = (
        np.sqrt(np.einsum("pii->p", c.points))
        for c in (result.calibration.covariance, bound)
    )
    np.testing.assert_allclose(np.median(found / expected), 1.0, atol=0.05)


def test_scale_is_metric(comparison):
    """Only the first pose is aligned: 2 mm over a dive of two metres is scale too."""
    assert comparison.center_rms_m <= 2e-3


def test_summary_says_everything(demo):
    out, result = demo.out, demo.result
    summary = json.loads((out / "summary.json").read_text())
    assert summary == json.loads(json.dumps(result.summary))
    assert schema_faults(summary) == []
    for camera in summary["cameras"]:
        assert math.isclose(np.linalg.norm(camera["normal"]), 1.0)
        for key in ("distance_m", "normal_stddev_deg", "distance_stddev_m"):
            assert camera[key] > 0.0
        assert len(camera["cam_from_rig"]["rotation_xyzw"]) == 4
    rms = summary["reprojection_rms_px"]
    assert rms["after"] < rms["before"]
    counts = ("num_frames", "num_registered_frames", "num_points", "num_observations")
    assert all(summary[key] > 0 for key in counts)
    assert summary["num_invalid"] == 0
    assert summary["timings_s"]
    assert summary["versions"]["pycolmap"] == pycolmap.__version__


def test_outputs_open_elsewhere_and_here(demo):
    out, result = demo.out, demo.result
    colmap = pycolmap.Reconstruction(str(out / "sparse"))
    assert colmap.num_reg_frames() == result.model.scene.num_frames
    lens = result.model.rig.cameras[0].camera
    np.testing.assert_array_equal(colmap.cameras[1].params, lens.params)
    model = uwsfm.read_model(out)
    assert model.scene.num_observations == result.model.scene.num_observations
    # Written and read in double precision; the observations come in another order.
    rms = np.sqrt(np.mean(model.errors_px() ** 2))
    assert math.isclose(rms, result.summary["reprojection_rms_px"]["after"])
    housing = uwsfm.load_rig(out / "housing.yaml")
    assert housing.cameras[0].port == result.model.rig.cameras[0].port
    assert (out / "points.ply").read_bytes().startswith(b"ply\nformat binary_little")


def test_points_have_believable_uncertainties(result):
    cov = result.calibration.covariance.points
    stddev = np.sqrt(np.einsum("pii->p", cov))
    assert np.all(np.isfinite(stddev))
    # By the angle between the outermost of a point's rays, f = 590 px: noise / f times
    # the range over that angle, and no less than the noise of a mean of its images.
    scene, noise = result.calibration.scene, result.calibration.summary.sigma_px
    _, dirs = scene.water_rays()
    ranges = np.linalg.norm(scene.points_in_cam(), axis=1)
    for p in range(0, scene.num_points, 97):
        rows = np.flatnonzero(scene.point_idx == p)
        angle = np.arccos(np.clip((dirs[rows] @ dirs[rows].T).min(), -1.0, 1.0))
        of_pixel = noise * ranges[rows].mean() / 590.0
        least = of_pixel / np.sqrt(len(rows))
        assert least < stddev[p] < 3.0 * of_pixel / angle + 3.0 * of_pixel


def test_second_run_starts_from_what_is_on_disk(demo):
    """And gives the same result: nothing in the refractive part is random."""
    steps = []
    again = demo.again(
        progress=lambda step, done, total: steps.append(step), report=False
    )
    assert not {"features", "matching", "mapping"} & set(steps)
    np.testing.assert_array_equal(
        again.model.scene.points, demo.result.model.scene.points
    )


def test_another_seed_maps_again_and_matches_no_more(demo):
    """A new map, from the features and matches that are there."""
    steps = []

    class Begun(Exception):
        pass

    def stop(step, done, total):
        steps.append(step)
        if step == "verifying":
            raise Begun

    with pytest.raises(Begun):
        demo.again(seed=1, progress=stop, report=False)
    assert not {"features", "matching"} & set(steps)
