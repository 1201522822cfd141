"""`uwsfm refine`: any model ends at the refractive optimum, or is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_models import moved, self_calibrated, write
from sfm_scenes import model_of

import uwsfm
from uwsfm.export.files import export_colmap
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.rig_file import dump_rig
from uwsfm.sfm.refine import refine_scene
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

NUM_FRAMES = 10


class Dive:
    """A simulated dive, what the user knows of its rig, and its optimum."""

    def __init__(self) -> None:
        self.true_rig = sample_rig()
        options = ObservationOptions(
            num_points=400, noise_px=0.3, outlier_ratio=0.02, seed=2
        )
        relief = Relief(stddev=0.2)
        simulated = simulate_scene(
            self.true_rig, rich_motion(NUM_FRAMES), relief, options
        )
        self.truth = simulated.truth
        self.rig = nominal_rig(self.true_rig)
        self.model = model_of(self.rig, simulated.scene)
        self.optimum = refine_scene(perturbed(simulated.scene), self.rig).calibration


@pytest.fixture(scope="module")
def dive() -> Dive:
    return Dive()


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
    result = uwsfm.refine_model(tmp_path / "model", dive.rig, tmp_path / "out")
    # The same minimum, but for a few observations at the limit of what is pruned.
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert_ports(result, dive.truth.ports, sigmas=4.0)
    summary = result.summary
    assert summary["num_registered_frames"] == NUM_FRAMES
    # Pruning at 3.5 sigma takes 0.7 %; 3600 observations tell the noise to 1.5 %.
    assert summary["sigma_px"] == pytest.approx(0.3, rel=0.05)
    assert summary["colmap_model"]["median_error_px"] > 0.3
    # A pinhole's depth is off by some per cent, and with it its baseline.
    assert summary["colmap_model"]["scale_m"] == pytest.approx(1 / scale, rel=0.15)
    # What is on disk is a refractive model like any other.
    model = uwsfm.read_model(tmp_path / "out")
    np.testing.assert_allclose(  # COLMAP normalises quaternions: rounding only
        model.errors_px(), result.model.errors_px(), atol=1e-8
    )
    names = {"sparse", "housing.yaml", "points.ply", "summary.json", "uwsfm-work"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert np.all(model.colors == [10, 20, 30])  # those of the model
    assert np.linalg.norm(model.scene.cam_from_rig[1, 4:]) == pytest.approx(0.2)


def test_partial_frames_and_junk_points_do_no_harm(dive, tmp_path):
    """Frames with one image only, and 60 of 400 points that join pixels at random."""
    absent = {(1, 2), (1, 5), (0, 7)}
    found = self_calibrated(
        dive.model, without=lambda c, f: (c, f) in absent, num_junk=60
    )
    write(found, tmp_path / "model", old=True)
    result = uwsfm.refine_model(tmp_path / "model", dive.rig, tmp_path / "out")
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
    result = uwsfm.refine_model(tmp_path / "model", dive.rig, tmp_path / "out")
    assert result.summary["colmap_model"]["num_doubtful_images"] == 1
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    rows = result.model.scene.frame_idx == 4
    assert set(result.model.scene.camera_idx[rows]) == {0, 1}


def test_a_baseline_alone_is_completed_by_the_model(dive, tmp_path):
    write(moved(self_calibrated(dive.model), 0.37), tmp_path / "model", old=True)
    rig = replace(dive.rig, cam_from_rig=None)
    result = uwsfm.refine_model(tmp_path / "model", rig, tmp_path / "out")
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert any(
        "cam_from_rig was derived" in text for text in result.summary["warnings"]
    )


def test_a_model_with_a_rig_is_refined_too(dive, tmp_path):
    """As COLMAP 4 writes it; and of two models in a folder the larger one is taken."""
    export_colmap(dive.model, tmp_path / "sparse" / "1")
    few = self_calibrated(dive.model, without=lambda c, f: f > 3)
    write(few, tmp_path / "sparse" / "0", old=True)
    result = uwsfm.refine_model(tmp_path, dive.rig, tmp_path / "out")
    assert_ports(result, dive.optimum.scene.ports, sigmas=0.5)
    assert "2 models, of 8, 20 images" in result.summary["warnings"][0]
    assert result.summary["colmap_model"]["scale_m"] == pytest.approx(1.0, rel=1e-9)


# ---- Refusals ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(dive, tmp_path_factory) -> Path:
    """A model that is right in every respect."""
    folder = tmp_path_factory.mktemp("plain") / "model"
    return write(self_calibrated(dive.model), folder, old=True)


def inverted(rig):
    poses = np.stack([rigid3.IDENTITY, rigid3.inverse(rig.cam_from_rig[1])])
    return replace(rig, cam_from_rig=poses)


def swapped(rig):
    left, right = rig.cameras
    cameras = (replace(left, images="right"), replace(right, images="left"))
    return replace(rig, cameras=cameras)


def turned(rig):
    turn = rigid3.quat_from_rotvec(np.radians([8.0, 0.0, 3.0]))
    poses = np.array(rig.cam_from_rig)
    poses[1] = rigid3.compose([*turn, 0.0, 0.0, 0.0], poses[1])
    return replace(rig, cam_from_rig=poses)


def elsewhere(rig):
    left, right = rig.cameras
    return replace(rig, cameras=(left, replace(right, images="starboard")))


def smaller(rig):
    lens = pycolmap.Camera(
        model="PINHOLE", width=400, height=300, params=[300, 300, 200, 150]
    )
    return replace(rig, cameras=(rig.cameras[0], replace(rig.cameras[1], camera=lens)))


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (inverted, "cam_from_rig of 'right' is inverted"),
        (swapped, "'right' and 'left' are swapped"),
        (turned, "does not fit the images|wrong by several degrees"),
        (elsewhere, r"image right/0000.jpg is in no folder of the rig \(left/, starb"),
        (smaller, "800 x 600 pixels there, camera 'right' of the rig has 400 x 300"),
    ],
)
def test_a_rig_that_contradicts_the_model_is_refused(
    dive, plain, tmp_path, mistake, words
):
    with pytest.raises(uwsfm.InputError, match=words):
        uwsfm.refine_model(plain, mistake(dive.rig), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mistake", [inverted, swapped])
def test_without_common_points_the_poses_tell_of_a_wrong_rig(dive, tmp_path, mistake):
    """Cameras that look past each other: no point is seen twice in a frame."""
    found = self_calibrated(dive.model)
    name_of = {image.image_id: image.name for image in found.images.values()}
    for point_id in list(found.points3D):
        sides = ("left", "right") if point_id % 2 else ("right", "left")
        elements = [
            (e.image_id, e.point2D_idx) for e in found.points3D[point_id].track.elements
        ]
        for image_id, keypoint in elements:
            if name_of[image_id].startswith(sides[0]) and found.exists_point3D(
                point_id
            ):
                found.delete_observation(image_id, keypoint)
    write(found, tmp_path / "model", old=True)
    words = "probably it is inverted .* or the folders '.*' and '.*' are swapped"
    with pytest.raises(uwsfm.InputError, match=words):
        uwsfm.refine_model(tmp_path / "model", mistake(dive.rig), tmp_path / "out")


def renamed(plain: Path, folder: Path, names) -> Path:
    """A copy whose images have other names; ``names``: (old name) -> new name."""
    found = pycolmap.Reconstruction(str(plain))
    for image in found.images.values():
        image.name = names(image.name)
    return write(found, folder, old=True)


def wrong_partner(name: str) -> str:
    side, number = name.split("/")
    shift = 3 if side == "right" else 0
    return f"{side}/{(int(number[:4]) + shift) % NUM_FRAMES:04}.jpg"


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (wrong_partner, r"changes from frame to frame, by .* worst in 000\d.jpg"),
        (lambda n: n.replace("right/0", "right/1"), "equal names"),
        (lambda n: n.replace("/", "_"), "told apart by folders, not by the beginn"),
        (lambda n: f"dive1/{n}", "write images: dive1/left in the rig file"),
        (lambda n: n.replace("left", "right/x"), "no registered image is in left/"),
    ],
)
def test_names_that_do_not_pair_images_are_refused(dive, plain, tmp_path, names, words):
    folder = renamed(plain, tmp_path / "model", names)
    with pytest.raises(uwsfm.InputError, match=words):
        uwsfm.refine_model(folder, dive.rig, tmp_path / "out")


def test_folders_without_a_usable_model_are_refused(dive, plain, tmp_path):
    out = tmp_path / "out"

    def refused(folder: Path, words: str) -> None:
        with pytest.raises(uwsfm.InputError, match=words):
            uwsfm.refine_model(folder, dive.rig, out)

    refused(tmp_path / "none", "does not exist")
    refused(tmp_path, "holds no COLMAP model")
    pycolmap.Reconstruction().write_binary(str(tmp_path))
    refused(tmp_path, "has no registered image")
    shutil.copytree(plain, tmp_path / "cut")
    data = (plain / "images.bin").read_bytes()
    (tmp_path / "cut" / "images.bin").write_bytes(data[: len(data) // 2])
    refused(tmp_path / "cut", "not a COLMAP model")
    found = pycolmap.Reconstruction(str(plain))
    for point_id in list(found.points3D):
        found.delete_point3D(point_id)
    refused(write(found, tmp_path / "pointless", old=True), "has no points that its")
    assert not out.exists()


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        ("PINHOLE", "probably its images were undistorted"),
        ("SIMPLE_RADIAL", "away from the lens: are the images of the model the raw"),
    ],
)
def test_a_model_of_undistorted_images_is_refused(dive, tmp_path, lens, words):
    """Of the same size, so that only the pixels tell: pinholes fit them too well."""
    no_port = uwsfm.FlatPort(distance=0.0, thickness=0.0, n_glass=1.0, n_water=1.0)
    pinhole = pycolmap.Camera(
        model="PINHOLE", width=800, height=600, params=[790, 790, 400, 300]
    )
    camera = uwsfm.RefractiveCamera(pinhole, no_port)
    scene = replace(dive.model.scene, cameras=(camera, camera))
    noise = np.random.default_rng(0).normal(scale=0.3, size=scene.xy.shape)
    scene = replace(scene, xy=scene.projections()[0] + noise)
    found = self_calibrated(model_of(dive.rig, scene), lens=lens)
    write(found, tmp_path / "model", old=True)
    with pytest.raises(uwsfm.UwsfmError, match=words):
        uwsfm.refine_model(tmp_path / "model", dive.rig, tmp_path / "out")


def test_a_model_is_not_overwritten_by_its_own_refinement(dive, tmp_path):
    export_colmap(dive.model, tmp_path / "sparse" / "0")
    (tmp_path / "uwsfm-work").mkdir()
    (tmp_path / "uwsfm-work" / "lock").touch()
    with pytest.raises(uwsfm.InputError, match="which the result would replace"):
        uwsfm.refine_model(tmp_path, dive.rig, tmp_path)


def test_options_that_do_nothing_are_refused(dive, plain, tmp_path):
    with pytest.raises(uwsfm.InputError, match="has no effect"):
        uwsfm.refine_model(plain, dive.rig, tmp_path / "out", focal_stddev=1e-3)


def test_the_command_line_refines_a_model(dive, plain, tmp_path, capsys, monkeypatch):
    from uwsfm import cli

    dump_rig(dive.rig, tmp_path / "rig.yaml")
    command = ["uwsfm", "refine", str(plain), str(tmp_path / "rig.yaml")]
    command += ["-o", str(tmp_path / "out"), "--refine", "water-index"]
    monkeypatch.setattr("sys.argv", [*command, "--prior", "water_index_stddev=0.002"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code in (0, None)
    shown = capsys.readouterr().out
    assert "mean error of the COLMAP model" in shown and "water index" in shown
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["refined"][0]["name"] == "water index"
