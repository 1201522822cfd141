"""`uwsfm refine`: what contradicts itself is refused, in one sentence that helps."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_models import NUM_FRAMES, Dive, self_calibrated, simulated_dive, write
from sfm_scenes import model_of

import uwsfm
from uwsfm.geometry import rigid3
from uwsfm.results.files import export_colmap


@pytest.fixture(scope="module")
def dive() -> Dive:
    return simulated_dive()


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
        (turned, "the rotation of 'right' is wrong by [89] degrees"),
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


def test_a_few_wrong_pairs_are_named_and_lose_one_image(dive, plain, tmp_path):
    """The right images of two frames are exchanged: the other frames know the rig."""
    swap = {"right/0002.jpg": "right/0006.jpg", "right/0006.jpg": "right/0002.jpg"}
    folder = renamed(plain, tmp_path / "model", lambda name: swap.get(name, name))
    result = uwsfm.refine_model(folder, dive.rig, tmp_path / "out", report=False)
    text = "in 2 frames, for instance 0002.jpg, the poses of the images contradict"
    assert any(text in note for note in result.summary["warnings"])
    scene = result.model.scene
    for frame in (2, 6):
        cameras = scene.camera_idx[scene.frame_idx == frame]
        assert len(np.unique(cameras)) == 1 and len(cameras) > 100
    assert result.summary["sigma_px"] == pytest.approx(0.3, rel=0.05)


def test_folders_without_a_usable_model_are_refused(dive, plain, tmp_path):
    out = tmp_path / "out"

    def refused(folder: Path, words: str) -> None:
        with pytest.raises(uwsfm.InputError, match=words):
            uwsfm.refine_model(folder, dive.rig, out)

    with pytest.raises(uwsfm.InputError, match="folder of the model itself"):
        uwsfm.refine_model(plain, dive.rig, plain)
    assert not (plain / "uwsfm-work").exists()
    refused(tmp_path / "none", "does not exist")
    refused(tmp_path, "holds no COLMAP model")
    pycolmap.Reconstruction().write_binary(str(tmp_path))
    refused(tmp_path, "has no registered image")
    shutil.copytree(plain, tmp_path / "cut")
    data = (plain / "images.bin").read_bytes()
    (tmp_path / "cut" / "images.bin").write_bytes(data[: len(data) // 2])
    refused(tmp_path / "cut", "images.bin: is cut short or damaged")
    found = pycolmap.Reconstruction(str(plain))
    found.frames[1].rig_from_world.translation[0] = np.nan
    refused(
        write(found, tmp_path / "nan", old=True), "pose of image left/0000.jpg is not"
    )
    found = pycolmap.Reconstruction(str(plain))
    for point_id in list(found.points3D):
        found.delete_point3D(point_id)
    refused(write(found, tmp_path / "pointless", old=True), "but no points that")
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
        uwsfm.refine_model(tmp_path / "model", dive.rig, tmp_path / "deep" / "out")
    # Told by the adjustment only, when the folder was locked.
    assert {path.name for path in tmp_path.iterdir()} == {"model"}


def test_a_model_is_not_overwritten_by_its_own_refinement(dive, tmp_path):
    export_colmap(dive.model, tmp_path / "sparse" / "0")
    (tmp_path / "uwsfm-work").mkdir()
    (tmp_path / "uwsfm-work" / "lock").touch()
    with pytest.raises(uwsfm.InputError, match="the folder of the model itself"):
        uwsfm.refine_model(tmp_path, dive.rig, tmp_path)
    with pytest.raises(uwsfm.InputError, match="which the result would replace"):
        uwsfm.refine_model(tmp_path / "sparse", dive.rig, tmp_path)


def test_options_that_do_nothing_are_refused(dive, plain, tmp_path):
    with pytest.raises(uwsfm.InputError, match="has no effect"):
        uwsfm.refine_model(plain, dive.rig, tmp_path / "out", focal_stddev=1e-3)


@pytest.mark.parametrize("job", ["reconstruct", "refine_model", "calibrate_housing"])
def test_the_distance_of_a_scene_is_not_asked_of_a_rig_with_a_baseline(
    dive, plain, tmp_path, job
):
    """Also if it is the default, which the user of a stereo rig has no need to give."""
    source = plain if job != "reconstruct" else tmp_path
    inputs = (source, dive.rig) if job == "refine_model" else (dive.rig, source)
    words = r"^--scene-distance \(scene_distance_m\) has no effect: the baseline of the"
    with pytest.raises(uwsfm.InputError, match=words):
        getattr(uwsfm, job)(*inputs, tmp_path / "out", scene_distance_m=1.0)
    assert not (tmp_path / "out").exists()
    alone = replace(dive.rig, cameras=dive.rig.cameras[:1], baseline_m=None)
    inputs = (source, alone) if job == "refine_model" else (alone, source)
    with pytest.raises(uwsfm.InputError, match=r"^--scene-distance.* must be positive"):
        getattr(uwsfm, job)(*inputs, tmp_path / "out", scene_distance_m=0.0)
