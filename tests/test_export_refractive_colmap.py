"""Refractive COLMAP's text models: what we write, and what its users have."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import model_of

import uwsfm
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.export.refractive_colmap import export_refractive_colmap
from uwsfm.rig.file import dump_rig
from uwsfm.sfm.from_colmap.refractive_colmap import (
    read_refractive_cameras,
    read_refractive_colmap,
    rig_of_refractive_colmap,
)
from uwsfm.simulate import ObservationOptions, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

# As that program writes it: one space between items, 17 digits.
PUBLISHED = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] OPTIONAL[REFRAC_MODEL REFRAC_PARAMS[]]
# Number of cameras: 2
2 PINHOLE 1920 1080 1297.3700000000001 1297.3700000000001 960 540
7 SIMPLE_RADIAL 1920 1080 1200 960 540 -0.10000000000000001 FLATPORT 0.6 0 0.8 0.02 \
0.012 1 1.4733000000000001 1.333
"""


@pytest.fixture(scope="module")
def model() -> Model:
    rig = sample_rig()
    options = ObservationOptions(num_points=80, noise_px=0.3)
    return model_of(rig, simulate_scene(rig, rich_motion(3), None, options).scene)


def test_published_lines_are_understood(tmp_path):
    (tmp_path / "cameras.txt").write_text(PUBLISHED)
    found = read_refractive_cameras(tmp_path / "cameras.txt")
    assert list(found) == [2, 7]
    assert found[2].port == uwsfm.NoPort()
    assert found[2].camera.model_name == "PINHOLE"
    assert found[7].camera.params.tolist() == [1200, 960, 540, -0.1]
    assert found[7].port == uwsfm.FlatPort((0.6, 0, 0.8), 0.02, 0.012, 1.4733, 1.333)


def test_models_come_back_as_they_were(model, tmp_path):
    export_refractive_colmap(model, tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"cameras.txt", "images.txt", "points3D.txt"}
    found, cameras = read_refractive_colmap(tmp_path / "out")
    ours = to_reconstruction(model)
    for index, camera in enumerate(model.scene.cameras):
        entry = cameras[index + 1]
        assert entry.port == camera.port  # to the last digit
        assert entry.camera.params.tolist() == list(camera.camera.params)
    assert found.num_images() == ours.num_images()
    for image_id, image in found.images.items():
        theirs = ours.images[image_id]
        assert image.name == theirs.name
        np.testing.assert_allclose(  # text quaternions are made unit again
            image.cam_from_world().matrix(),
            theirs.cam_from_world().matrix(),
            atol=1e-14,
        )
        pixels = [[p.xy for p in i.points2D] for i in (image, theirs)]
        np.testing.assert_array_equal(*pixels)
    for point_id, point in found.points3D.items():
        np.testing.assert_array_equal(point.xyz, ours.points3D[point_id].xyz)


def test_their_model_projects_to_our_observations(model, tmp_path):
    """Lens, port and pose of the files alone give the pixels of the points."""
    export_refractive_colmap(model, tmp_path / "out")
    found, cameras = read_refractive_colmap(tmp_path / "out")
    errors = []
    for image in found.images.values():
        entry = cameras[image.camera_id]
        camera = uwsfm.RefractiveCamera(entry.camera, entry.port)
        rows = [p for p in image.points2D if p.has_point3D()]
        world = np.array([found.points3D[p.point3D_id].xyz for p in rows])
        in_cam = np.array([image.cam_from_world() * xyz for xyz in world])
        xy, _ = camera.img_from_point(in_cam)
        errors.append(np.linalg.norm(xy - [p.xy for p in rows], axis=1))
    mean = np.concatenate(errors).mean()
    assert mean == pytest.approx(np.mean(model.errors_px()), rel=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 PINHOLE 800", "CAMERA_ID MODEL WIDTH HEIGHT"),
        (
            "1 PINHOLE 800 600 500 500 400 300 CONEPORT 1",
            "unknown port model 'CONEPORT'",
        ),
        ("1 PINHOLE 800 600 500 500 400 300 FLATPORT 0 0 1", "8 numbers, got 3"),
        ("1 PINHOLE 800 600 500 500 400 FLATPORT 0 0 1 0 0 1 1 1", "has 4 params"),
        ("1 PINHOLE 800 600 500 500 400 3x1", "'3x1' is not a number"),
        ("one PINHOLE 800 600 500 500 400 300", "'one' is not a whole number"),
        ("1 PINHOLE 800 600 500 500 400 300\n" * 2, "camera 1 comes twice"),
        ("# nothing", "describes no camera"),
    ],
)
def test_lines_that_cannot_be_understood_are_named(tmp_path, line, words):
    (tmp_path / "cameras.txt").write_text(line + "\n")
    with pytest.raises(uwsfm.InputError, match="cameras.txt") as found:
        read_refractive_cameras(tmp_path / "cameras.txt")
    assert words in str(found.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(uwsfm.InputError, match=r"cameras.txt: no such file"):
        read_refractive_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text(PUBLISHED)
    with pytest.raises(uwsfm.InputError, match=r"images.txt: no such file"):
        read_refractive_colmap(tmp_path)


def test_rig_comes_back_from_a_model(model, tmp_path):
    """Folders, ports and placement, by way of a rig file."""
    export_refractive_colmap(model, tmp_path / "out")
    rig = rig_of_refractive_colmap(tmp_path / "out" / "cameras.txt")
    dump_rig(rig, tmp_path / "rig.yaml")
    again = uwsfm.load_rig(tmp_path / "rig.yaml")
    assert [c.images for c in again.cameras] == [c.images for c in model.rig.cameras]
    assert [c.port for c in again.cameras] == list(model.scene.ports)
    np.testing.assert_allclose(
        np.array(again.cam_from_rig), model.scene.cam_from_rig, atol=1e-12
    )
    assert again.baseline_m == pytest.approx(0.2)


def test_one_camera_needs_no_images(tmp_path):
    """And only ratios of indices matter: air of 1.003, as Calibmar writes it."""
    (tmp_path / "cameras.txt").write_text(
        "4 PINHOLE 800 600 600 600 400 300 DOMEPORT 0 0.01 0 0.05 0.007 1.003 1.5 1.34"
    )
    rig = rig_of_refractive_colmap(tmp_path)
    (camera,) = rig.cameras
    assert (camera.name, camera.images, rig.baseline_m) == ("camera4", "camera4", None)
    assert camera.port.n_air == 1.0
    theirs = uwsfm.DomePort((0, 0.01, 0), 0.05, 0.007, 1.5, 1.34, 1.003)
    xy = [[30.0, 40.0], [700.0, 500.0]]
    ours = uwsfm.RefractiveCamera(camera.camera, camera.port).ray_from_img(xy)
    expected = uwsfm.RefractiveCamera(camera.camera, theirs).ray_from_img(xy)
    np.testing.assert_allclose(ours, expected, atol=1e-15)


def test_placement_that_nothing_tells_is_refused(model, tmp_path):
    (tmp_path / "cameras.txt").write_text(PUBLISHED)
    with pytest.raises(uwsfm.InputError, match="2 cameras, and without images.txt"):
        rig_of_refractive_colmap(tmp_path)
    names = tuple(f"{i}.jpg" for i in range(3))
    export_refractive_colmap(replace(model, frame_names=names), tmp_path / "out")
    text = (tmp_path / "out" / "images.txt").read_text()
    (tmp_path / "out" / "images.txt").write_text(text.replace("right/", "right/r"))
    with pytest.raises(uwsfm.InputError, match="no images of left and right have"):
        rig_of_refractive_colmap(tmp_path / "out")
