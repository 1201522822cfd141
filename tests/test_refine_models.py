"""`uwsfm refine`: any model ends at the refractive optimum, or is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from foreign_models import (
    NUM_FRAMES,
    Dive,
    moved,
    self_calibrated,
    simulated_dive,
    write,
)
from sfm_scenes import model_of
from test_three_cameras import dive as three_camera_dive
from test_three_cameras import three_camera_rig

import uwsfm
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.jobs.output_folder import RESULTS, WORK
from uwsfm.report.files import FOLDER, PAGE
from uwsfm.results.files import export_colmap
from uwsfm.results.log import LOG
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig, stereo_rig
from uwsfm.simulate.trajectories import straight_strip


@pytest.fixture(scope="module")
def dive() -> Dive:
    return simulated_dive()


def assert_ports(result, ports, sigmas: float) -> None:
    found = result.calibration
    for port, other, stddev in zip(
        found.scene.ports, ports, found.covariance.cameras, strict=True
    ):
        angle = np.degrees(unit_vector.angle_between(port.normal, other.normal))
        assert angle < sigmas * stddev.normal_stddev_deg
        gap = abs(port.distance - other.distance)
        assert gap < sigmas * stddev.distance_stddev_m


@pytest.mark.parametrize(
    ("cameras", "lens", "scale", "text", "old"),
    [
        ("folder", "SIMPLE_RADIAL", 0.37, False, True),
        ("shared", "SIMPLE_RADIAL", 1.0, True, True),
        ("image", "SIMPLE_RADIAL", 55.0, True, False),
        ("folder", "OPENCV", 1.0, False, False),
    ],
)
def test_self_calibrated_models_end_at_the_refractive_optimum(
    dive, tmp_path, cameras, lens, scale, text, old
):
    found = self_calibrated(dive.model, cameras=cameras, lens=lens)
    write(moved(found, scale), tmp_path / "model", text=text, old=old)
    result = uwsfm.refine_model(
        tmp_path / "model", dive.rig, tmp_path / "out", report=False
    )
    # The same minimum, but for a few observations at the limit of what is pruned.
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert_ports(result, dive.truth.ports, sigmas=4.0)
    summary = result.summary
    assert summary["num_registered_frames"] == NUM_FRAMES
    # Pruning takes some tenths of a per cent; 3600 observations tell noise to 1.5 %.
    assert summary["sigma_px"] == pytest.approx(0.3, rel=0.05)
    assert summary["colmap_model"]["median_error_px"] > 0.3
    # A pinhole's depth is off by some per cent, and with it its baseline.
    assert summary["colmap_model"]["scale_m"] == pytest.approx(1 / scale, rel=0.15)
    # What is on disk is a refractive model like any other.
    model = uwsfm.read_model(tmp_path / "out")
    np.testing.assert_allclose(  # COLMAP normalises quaternions: rounding only
        model.errors_px(), result.model.errors_px(), atol=1e-8
    )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {*RESULTS, WORK, LOG} - {PAGE, FOLDER}
    assert np.all(model.colors == [10, 20, 30])  # those of the model
    assert np.linalg.norm(model.scene.cam_from_rig[1, 4:]) == pytest.approx(0.2)


def test_a_camera_may_never_meet_the_reference(tmp_path):
    """Three cameras; images of the first and of the third are in different frames, so
    that the model does not tell where they are to each other: the rig file does."""
    rig = three_camera_rig()
    scene = three_camera_dive(noise_px=0.3).scene
    model = model_of(nominal_rig(rig), scene)
    absent = {(2 if f % 2 else 0, f) for f in range(scene.num_frames)}
    found = self_calibrated(model, without=lambda c, f: (c, f) in absent)
    write(moved(found, 4.0), tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", model.rig, tmp_path / "out", report=False
    )
    assert result.summary["colmap_model"]["num_frames_with_both"] == [4, 0]
    assert result.summary["num_registered_frames"] == scene.num_frames
    assert_ports(result, [item.port for item in rig.cameras], sigmas=4.0)


def test_a_single_camera_is_refined_up_to_its_scale(dive, tmp_path):
    """As COLMAP leaves it that was run in the folder of the images: bare file names."""
    rig = Rig(cameras=dive.rig.cameras[:1], cam_from_rig=None, baseline_m=None)
    scene, _ = dive.model.scene.select(dive.model.scene.camera_idx == 0)
    scene = replace(
        scene, cameras=scene.cameras[:1], cam_from_rig=scene.cam_from_rig[:1]
    )
    found = self_calibrated(model_of(rig, scene))
    for image in found.images.values():
        image.name = image.name.removeprefix("left/")
    write(moved(found, 7.0), tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", rig, tmp_path / "out", scene_distance_m=2.0, report=False
    )
    assert result.calibration.covariance.scale_stddev is None
    assert result.summary["num_registered_frames"] == NUM_FRAMES
    assert uwsfm.read_model(tmp_path / "out").image_name(0, 0) == "left/0000.jpg"
    (port,), true_port = result.model.scene.ports, dive.truth.ports[0]
    (stddev,) = result.calibration.covariance.cameras
    angle = np.degrees(unit_vector.angle_between(port.normal, true_port.normal))
    assert angle < 4.0 * stddev.normal_stddev_deg
    spread = {}
    true_centers = rigid3.inverse(dive.truth.rig_from_world)[:, 4:]
    for name, poses in (
        ("refined", result.model.scene.rig_from_world),
        ("pinhole", result.start.model.cam_from_world[0]),
    ):
        centers = rigid3.inverse(poses)[:, 4:]
        ratio = np.linalg.norm(centers[1:] - centers[0], axis=1) / np.linalg.norm(
            true_centers[1:] - true_centers[0], axis=1
        )
        spread[name] = np.std(ratio) / np.mean(ratio)
    # Found: 0.10 % and 2.5 %. The shape is right, and no length in it is known.
    assert spread["refined"] < 0.1 * spread["pinhole"]
    assert spread["refined"] < 2e-3


def test_what_a_start_is_too_far_off_for_comes_back(tmp_path):
    """Ports tilted by 8 degrees, 0.6 m above the floor: half of the tracks are lost
    while the ports are straight, for they miss their points by more than 50 px."""
    lenses = sample_rig().cameras
    rig = stereo_rig(
        (lenses[0].camera, lenses[1].camera), tilts_deg=((8.0, 40.0), (8.0, 190.0))
    )
    scene = simulate_scene(
        rig,
        straight_strip(15, altitude=0.6, spacing=0.06),
        Relief(stddev=0.05),
        ObservationOptions(num_points=400, noise_px=0.3),
    ).scene
    model = model_of(nominal_rig(rig), scene)
    write(self_calibrated(model), tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", model.rig, tmp_path / "out", report=False
    )
    # All that are pruned is 0.7 %; the first pass alone keeps 44 %.
    assert result.model.scene.num_observations > 0.8 * scene.num_observations
    assert_ports(result, [item.port for item in rig.cameras], sigmas=4.0)


def test_partial_frames_and_junk_points_do_no_harm(dive, tmp_path):
    """Frames with one image only, and 60 of 400 points that join pixels at random."""
    absent = {(1, 2), (1, 5), (0, 7)}
    found = self_calibrated(
        dive.model, without=lambda c, f: (c, f) in absent, num_junk=60
    )
    write(found, tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", dive.rig, tmp_path / "out", report=False
    )
    assert_ports(result, dive.truth.ports, sigmas=4.0)
    assert result.summary["num_registered_frames"] == NUM_FRAMES
    assert result.summary["sigma_px"] == pytest.approx(0.3, rel=0.05)
    written = uwsfm.read_model(tmp_path / "out")
    empty = {
        (c, f)
        for c in range(2)
        for f in range(NUM_FRAMES)
        if not len(written.keypoints[c][f])
    }
    assert empty == absent
    assert written.frame_names == dive.model.frame_names
    rows = set(zip(written.scene.camera_idx, written.scene.frame_idx, strict=True))
    assert not rows & absent


def test_an_image_with_a_wrong_pose_does_not_spoil_its_frame(dive, tmp_path):
    found = self_calibrated(dive.model)
    image = next(i for i in found.images.values() if i.name == "right/0004.jpg")
    found.frames[image.frame_id].rig_from_world.rotation.quat[:] = [0.0, 0.0, 1.0, 0.0]
    write(found, tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", dive.rig, tmp_path / "out", report=False
    )
    assert result.summary["colmap_model"]["num_doubtful_images"] == 1
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    rows = result.model.scene.frame_idx == 4
    assert set(result.model.scene.camera_idx[rows]) == {0, 1}


def test_a_baseline_alone_is_completed_by_the_model(dive, tmp_path):
    write(moved(self_calibrated(dive.model), 0.37), tmp_path / "model", old=True)
    rig = replace(dive.rig, cam_from_rig=None)
    result = uwsfm.refine_model(tmp_path / "model", rig, tmp_path / "out", report=False)
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert any(
        "cam_from_rig was derived" in text for text in result.summary["warnings"]
    )


def test_a_model_with_a_rig_is_refined_too(dive, tmp_path):
    """As COLMAP 4 writes it; and of two models in a folder the larger one is taken."""
    export_colmap(dive.model, tmp_path / "sparse" / "1")
    few = self_calibrated(dive.model, without=lambda c, f: f > 3)
    write(few, tmp_path / "sparse" / "0", old=True)
    result = uwsfm.refine_model(tmp_path, dive.rig, tmp_path / "out", report=False)
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert "2 models, of 8, 20 images" in result.summary["warnings"][0]
    assert result.summary["colmap_model"]["scale_m"] == pytest.approx(1.0, rel=1e-9)


def test_the_error_of_a_refractive_model_as_a_pinhole_is_not_told(dive, tmp_path):
    write(self_calibrated(dive.model), tmp_path / "model", old=True)
    first, again = tmp_path / "first", tmp_path / "again"
    before = uwsfm.refine_model(tmp_path / "model", dive.rig, first, report=False)
    after = uwsfm.refine_model(first, first / "housing.yaml", again, report=False)
    for name in ("mean_error_of_common_px", "median_error_px"):
        assert before.summary["colmap_model"][name] > 0.3
        assert after.summary["colmap_model"][name] is None
    note = f"{first / 'sparse'} is a result of uwsfm, refractive already"
    told = [note in " ".join(r.summary["warnings"]) for r in (before, after)]
    assert told == [False, True]


def test_the_command_line_refines_a_model(dive, tmp_path, capsys, monkeypatch):
    from uwsfm.cli import app as cli

    plain = write(self_calibrated(dive.model), tmp_path / "model", old=True)
    dump_rig(dive.rig, tmp_path / "rig.yaml")
    command = ["uwsfm", "refine", str(plain), str(tmp_path / "rig.yaml")]
    command += ["-o", str(tmp_path / "out"), "--refine", "water-index"]
    monkeypatch.setattr("sys.argv", [*command, "--prior", "water_index_stddev=0.002"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code in (0, None)
    shown = capsys.readouterr().out
    assert "with the COLMAP model" in shown and "water index" in shown
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["refined"][0]["name"] == "water index"
