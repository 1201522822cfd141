"""`Model` to COLMAP and back, and the files that other programs read."""

import json

import numpy as np
import pycolmap
import pytest
from sfm_scenes import model_of

import uwsfm
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.geometry import rigid3
from uwsfm.results.files import depth_stddev, export_colmap, export_ply, read_model
from uwsfm.results.housing import export_housing
from uwsfm.results.summary import write_json
from uwsfm.simulate.observations import ObservationOptions, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion


@pytest.fixture(scope="module")
def model() -> Model:
    rig = paper_rig()
    scene = simulate_scene(
        rig, rich_motion(4), None, ObservationOptions(num_points=60, noise_px=0.3)
    ).scene
    return model_of(rig, scene)


def test_stock_pycolmap_opens_the_model(model, tmp_path):
    export_colmap(model, tmp_path / "sparse")
    names = {path.name for path in (tmp_path / "sparse").iterdir()}
    expected = ("cameras", "rigs", "frames", "images", "points3D")
    assert {f"{name}.bin" for name in expected} <= names
    found = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    assert (found.num_rigs(), found.num_frames(), found.num_images()) == (1, 4, 8)
    assert found.num_points3D() == model.scene.num_points
    # Poses compose as COLMAP composes them: camera from rig from world.
    for image in found.images.values():
        camera = image.camera_id - 1
        frame = model.frame_names.index(image.name.split("/")[1])
        ours = rigid3.compose(
            model.scene.cam_from_rig[camera], model.scene.rig_from_world[frame]
        )
        theirs = image.cam_from_world()
        np.testing.assert_allclose(  # both renormalise: rounding only
            theirs.matrix(), rigid3.matrix_rows(ours).reshape(3, 4), atol=1e-14
        )
        assert image.num_points2D() == len(model.keypoints[camera][frame])


def test_point_errors_are_the_refractive_ones(model):
    """Not those of the in-air pinhole that is stored, which are tens of pixels."""
    found = to_reconstruction(model)
    scene = model.scene
    for point in (0, 7, scene.num_points - 1):
        rows = scene.point_idx == point
        np.testing.assert_array_equal(
            found.points3D[point + 1].xyz, scene.points[point]
        )
        assert found.points3D[point + 1].error == pytest.approx(
            np.mean(model.errors_px()[rows])
        )


def test_output_folder_reads_back(model, tmp_path):
    export_colmap(model, tmp_path / "sparse")
    export_housing(model.rig, tmp_path / "housing.yaml")
    again = read_model(tmp_path)
    assert again.frame_names == model.frame_names
    assert again.scene.num_observations == model.scene.num_observations
    np.testing.assert_array_equal(again.colors, model.colors)
    # Positions are stored in double precision.
    np.testing.assert_allclose(again.scene.points, model.scene.points, atol=1e-15)
    np.testing.assert_allclose(
        np.sort(again.errors_px()), np.sort(model.errors_px()), atol=1e-9
    )


def test_reading_a_folder_that_is_none_says_so(tmp_path):
    with pytest.raises(uwsfm.InputError, match="nowhere"):
        read_model(tmp_path / "nowhere")
    with pytest.raises(uwsfm.InputError, match="sparse"):
        read_model(tmp_path)


def test_ply_fields(model, tmp_path):
    cov = np.broadcast_to(4e-6 * np.eye(3), (model.scene.num_points, 3, 3))
    export_ply(model, tmp_path / "points.ply", cov)
    data = (tmp_path / "points.ply").read_bytes()
    header, body = data.split(b"end_header\n")
    names = [
        line.split()[-1] for line in header.decode().splitlines() if "prop" in line
    ]
    assert names == [
        *("x", "y", "z", "red", "green", "blue"),
        *("id", "track_length", "reprojection_error_px", "depth_stddev_m"),
    ]
    kinds = ["<f4"] * 3 + ["u1"] * 3 + ["<i4", "<i4", "<f4", "<f4"]
    rows = np.frombuffer(body, dtype=list(zip(names, kinds, strict=True)))
    assert len(rows) == model.scene.num_points
    np.testing.assert_allclose(  # stored in single precision
        np.stack([rows[axis] for axis in "xyz"], axis=1), model.scene.points, rtol=1e-6
    )
    np.testing.assert_allclose(rows["depth_stddev_m"], 2e-3, rtol=1e-6)
    # The ids are COLMAP's, whose file has the same places.
    export_colmap(model, tmp_path / "sparse")
    stored = pycolmap.Reconstruction(str(tmp_path / "sparse")).points3D
    for row in rows:
        place = [row[axis] for axis in "xyz"]
        np.testing.assert_allclose(stored[int(row["id"])].xyz, place, rtol=1e-6)


def test_depth_stddev_is_along_the_line_of_sight(model):
    """A covariance that is flat across the sight of a downward camera has no depth."""
    cov = np.zeros((model.scene.num_points, 3, 3))
    cov[:, 2, 2] = 1e-4
    deep = depth_stddev(model, cov)
    # The cameras look down within some tens of degrees: cos > 0.7.
    assert np.all((deep > 0.7e-2) & (deep <= 1e-2 + 1e-12))


def test_json_refuses_nan_and_leaves_no_file(tmp_path):
    with pytest.raises(ValueError):
        write_json({"value": float("nan")}, tmp_path / "summary.json")
    assert not list(tmp_path.iterdir())
    write_json({"value": 1}, tmp_path / "summary.json")
    assert json.loads((tmp_path / "summary.json").read_text()) == {"value": 1}
