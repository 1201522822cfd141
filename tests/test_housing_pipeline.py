"""`uwsfm calibrate`: from a model, from one pair of images, and its refusals."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from sfm_scenes import model_of
from summary_schema import schema_faults

import uwsfm
from uwsfm.geometry import unit_vector
from uwsfm.jobs.calibrate_housing import calibrate_housing
from uwsfm.jobs.demo import sample_dir
from uwsfm.jobs.output_folder import HOUSING_SUMMARY
from uwsfm.options.file import OPTIONS
from uwsfm.results.files import export_colmap
from uwsfm.results.log import LOG
from uwsfm.rig.file import dump_rig
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

NOISE_PX = 0.3


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """A COLMAP model as a pinhole program leaves it: no ports, and off in scale."""
    folder = tmp_path_factory.mktemp("dive")
    options = ObservationOptions(num_points=400, noise_px=NOISE_PX, outlier_ratio=0.02)
    simulated = simulate_scene(
        sample_rig(), rich_motion(10), Relief(stddev=0.2), options
    )
    start = perturbed(simulated.scene)
    scaled = {
        name: np.hstack([poses[:, :4], 3.0 * poses[:, 4:]])
        for name in ("cam_from_rig", "rig_from_world")
        for poses in (getattr(start, name),)
    }
    start = replace(start, points=3.0 * start.points, **scaled)
    rig = nominal_rig(sample_rig())
    export_colmap(model_of(rig, start), folder / "sparse" / "0")
    dump_rig(rig, folder / "rig.yaml", "a rig")
    return folder, simulated.truth


def assert_within_stddevs(result, truth, sigmas=4.0):
    for camera, port, true_port in zip(
        result.calibration.covariance.cameras,
        result.calibration.scene.ports,
        truth.ports,
        strict=True,
    ):
        angle = np.degrees(unit_vector.angle_between(port.normal, true_port.normal))
        assert angle < sigmas * camera.normal_stddev_deg
        gap = abs(port.distance - true_port.distance)
        assert gap <= sigmas * camera.distance_stddev_m


@pytest.mark.parametrize("strategy", ["joint", "nested"])
@pytest.mark.parametrize("start", ["virtual", "paper"])
def test_a_colmap_model_gives_the_housing(dive, tmp_path, strategy, start):
    folder, truth = dive
    result = calibrate_housing(
        folder / "rig.yaml", folder, tmp_path, strategy=strategy, start=start
    )
    assert_within_stddevs(result, truth)
    # The scale is that of the rig file, not of the model.
    assert result.rig.baseline_m == pytest.approx(0.2, rel=1e-9)
    assert uwsfm.load_rig(tmp_path / "housing.yaml").cameras[0].port.distance > 0.015
    found = json.loads((tmp_path / HOUSING_SUMMARY).read_text())
    assert (found["strategy"], found["start"]) == (strategy, start)
    assert schema_faults(found) == []
    # 3800 observations tell their noise to 1.5 %; pruning at 3.5 takes 0.7 %.
    assert found["sigma_px"] == pytest.approx(NOISE_PX, rel=0.05)
    # The rig of a simulation is exact: nothing that was given can be wrong.
    assert [row["if"] for row in found["error_budget"]] == ["all of these together"]
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"housing.yaml", HOUSING_SUMMARY, OPTIONS, LOG, "uwsfm-work"}


def test_refined_water_and_lenses_arrive_in_the_housing(dive, tmp_path):
    folder, _ = dive
    result = calibrate_housing(
        folder / "rig.yaml",
        folder / "sparse" / "0",
        tmp_path,
        refine_water_index=True,
        refine_focal=True,
        focal_stddev=1e-3,
    )
    back = uwsfm.load_rig(tmp_path / "housing.yaml")
    lens = result.calibration.scene.cameras[0].camera
    assert back.cameras[0].camera.params == pytest.approx(lens.params, rel=1e-9)
    port = result.calibration.scene.ports[0]
    assert back.cameras[0].port.n_water == pytest.approx(port.n_water, rel=1e-9)
    entries = {entry["name"]: entry for entry in result.summary["refined"]}
    water = entries["water index"]
    assert abs(water["value"] - 1.333) < 4.0 * water["stddev"]
    assert {"fx of left", "fy of left", "fx of right", "fy of right"} < set(entries)


def test_priors_are_around_the_rig_file_not_around_a_first_result(dive, tmp_path):
    """The port at 10 mm, known to a tenth of a millimetre: so near it must stay."""
    folder, _ = dive
    tight = {"distance_stddev_m": 1e-5}
    result = calibrate_housing(folder / "rig.yaml", folder, tmp_path, **tight)
    for port in result.calibration.scene.ports:
        # The images pull by 10 mm with a standard deviation of 0.5: 4 microns.
        assert port.distance == pytest.approx(0.010, abs=2e-5)


def test_a_model_of_other_images_is_refused(dive, tmp_path):
    folder, _ = dive
    rig = uwsfm.load_rig(folder / "rig.yaml")
    larger = sample_rig(image_scale=2.0)
    pairs = zip(rig.cameras, larger.cameras, strict=True)
    rig = replace(
        rig, cameras=tuple(replace(mine, camera=other.camera) for mine, other in pairs)
    )
    with pytest.raises(uwsfm.InputError, match="800 x 600 pixels there, camera "):
        calibrate_housing(rig, folder, tmp_path / "out")


@pytest.fixture(scope="module")
def one_pair(tmp_path_factory) -> Path:
    """The first pair of the rendered sample."""
    folder, sample = tmp_path_factory.mktemp("pair"), sample_dir()
    name = min(path.name for path in (sample / "images" / "left").iterdir())
    for side in ("left", "right"):
        (folder / "images" / side).mkdir(parents=True)
        shutil.copy(sample / "images" / side / name, folder / "images" / side)
    return folder


def test_one_pair_gives_normals_if_the_distances_are_given(one_pair, tmp_path):
    sample = uwsfm.load_rig(sample_dir() / "rig.yaml")
    truth = sample_rig()
    known = tuple(
        replace(camera, refine_distance=False, port=replace(camera.port, distance=0.02))
        for camera in sample.cameras
    )
    rig = replace(sample, cameras=known)
    result = calibrate_housing(rig, one_pair / "images", tmp_path)
    assert result.summary["start"] == "pairs"
    for port, item in zip(result.calibration.scene.ports, truth.cameras, strict=True):
        assert port.distance == 0.02
        angle = unit_vector.angle_between(port.normal, item.port.normal)
        # 0.026 degrees of noise, and SIFT's own bias of a few hundredths.
        assert np.degrees(angle) < 0.1
    for camera in result.summary["cameras"]:
        assert camera["distance_verdict"] == "held"
        assert camera["cam_from_rig"]["rotation_stddev_deg"] is None
    assert "taken as given" in result.summary["warnings"][0]


def test_one_pair_is_not_asked_for_a_distance(one_pair, tmp_path):
    with pytest.raises(
        uwsfm.InputError, match="from one stereo pair, because for every"
    ):
        calibrate_housing(sample_dir() / "rig.yaml", one_pair / "images", tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"start": "somewhere"}, "start must be one of virtual, paper, pairs"),
        ({"start": "pairs"}, "is a model"),
        ({"strategy": "staged"}, "strategy must be one of joint, nested"),
        ({"error": "virtual_camera"}, "hold the distances"),
        ({"error": "point_3d", "refine_focal": True}, "needs the reprojection error"),
        ({"focal_stddev": -1.0}, "focal_stddev must be positive"),
        ({"focal_stddev": 1e-3}, "has no effect: the focal length is not refined"),
        ({"distance_stddev_m": 1e-3, "strategy": "nested"}, "needs the joint strategy"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_written(
    dive, tmp_path, how, words
):
    folder, _ = dive
    with pytest.raises(uwsfm.InputError, match=words):
        calibrate_housing(folder / "rig.yaml", folder, tmp_path, **how)
    assert not any(tmp_path.iterdir())


def test_a_reconstruction_is_not_given_another_housing(dive, tmp_path):
    folder, _ = dive
    (tmp_path / "uwsfm-work").mkdir()
    (tmp_path / "uwsfm-work" / "lock").touch()
    (tmp_path / "sparse").mkdir()
    with pytest.raises(uwsfm.InputError, match="holds a reconstruction"):
        calibrate_housing(folder / "rig.yaml", folder, tmp_path)


RADIUS_PX = 330.0
"""Of images of 800 x 600 px: a fifth of the features lies beyond."""


@pytest.mark.parametrize("start", ["virtual", "paper"])
def test_pixels_beyond_the_calibrated_radius_take_no_part(dive, tmp_path, start):
    """A lens that bends beyond its calibration, by up to 12 px in the corners."""
    folder, truth = dive
    rig = uwsfm.load_rig(folder / "rig.yaml")
    rig = replace(
        rig,
        cameras=tuple(replace(c, valid_radius_px=RADIUS_PX) for c in rig.cameras),
    )
    shutil.copytree(folder / "sparse", tmp_path / "model")
    bent = pycolmap.Reconstruction(tmp_path / "model" / "0")
    for image in bent.images.values():
        camera = bent.cameras[image.camera_id]
        center = [camera.principal_point_x, camera.principal_point_y]
        for feature in image.points2D:
            offset = feature.xy - center
            radius = np.linalg.norm(offset)
            if radius > RADIUS_PX:
                feature.xy += offset * ((radius - RADIUS_PX) / 170.0) ** 2 * 12 / radius
    bent.write(tmp_path / "model" / "0")
    result = calibrate_housing(
        rig, tmp_path / "model" / "0", tmp_path / "out", start=start
    )
    assert_within_stddevs(result, truth)
    # As without the bend: 2700 observations tell their noise to 2 %.
    assert result.summary["sigma_px"] == pytest.approx(NOISE_PX, rel=0.06)
    scene = result.calibration.scene
    centers = np.array([camera.lens[2:4] for camera in scene.cameras])
    radii = np.linalg.norm(scene.xy - centers[scene.camera_idx], axis=1)
    assert 0.95 * RADIUS_PX < radii.max() <= RADIUS_PX


def test_single_pairs_keep_to_the_calibrated_radius(one_pair, tmp_path):
    sample = uwsfm.load_rig(sample_dir() / "rig.yaml")
    radius = {"left": 0.28 * sample.cameras[0].camera.width, "right": None}
    rig = replace(
        sample,
        cameras=tuple(
            replace(c, refine_distance=False, valid_radius_px=radius[c.name])
            for c in sample.cameras
        ),
    )
    result = calibrate_housing(rig, one_pair / "images", tmp_path, start="pairs")
    scene = result.calibration.scene
    assert result.summary["num_observations"] > 100
    for index, camera in enumerate(rig.cameras):
        offset = scene.xy[scene.camera_idx == index] - scene.cameras[index].lens[2:4]
        largest = np.linalg.norm(offset, axis=1).max()
        # The whole image of the right camera takes part, its corner at 0.6 widths.
        assert largest <= (camera.valid_radius_px or np.inf)
        assert largest > 0.25 * camera.camera.width


def test_the_front_end_of_a_model_is_refused(dive, tmp_path):
    folder, _ = dive
    front_end = uwsfm.StartOptions(mapper="refractive")
    with pytest.raises(uwsfm.InputError, match="mapper has no effect: a COLMAP model"):
        calibrate_housing(folder / "rig.yaml", folder, tmp_path, front_end=front_end)
    for name, value in (("clahe", True), ("max_features", 500), ("masks", "masks")):
        with pytest.raises(uwsfm.InputError, match=f"{name} has no effect"):
            how = {name: value}
            calibrate_housing(folder / "rig.yaml", folder, tmp_path, **how)
    with pytest.raises(uwsfm.InputError, match="give matcher 'paper'"):
        uwsfm.MatchOptions(fundamental_max_error_px=3.0)
