"""COLMAP models of poses alone, with the database that they were made from."""

import shutil

import numpy as np
import pycolmap
import pytest
from foreign_models import Dive, self_calibrated, simulated_dive, write
from hostile import CASES, copied, needs_cases
from test_refine_database import write_database

import uwsfm
from uwsfm.rig.file import load_rig
from uwsfm.sfm.from_colmap.colmap_model import FoundModel, read_image_model
from uwsfm.sfm.from_colmap.model_points import triangulated


@pytest.fixture(scope="module")
def dive() -> Dive:
    return simulated_dive()


@pytest.fixture(scope="module")
def whole(dive) -> pycolmap.Reconstruction:
    return self_calibrated(dive.model)


def poses_of(whole: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The same poses and cameras; images without keypoints."""
    bare = pycolmap.Reconstruction()
    for image_id in sorted(whole.images):
        image = whole.images[image_id]
        if not bare.exists_camera(image.camera_id):
            bare.add_camera_with_trivial_rig(whole.cameras[image.camera_id])
        copy = pycolmap.Image(
            name=image.name, camera_id=image.camera_id, image_id=image_id
        )
        bare.add_image_with_trivial_frame(copy, image.cam_from_world())
    return bare


def test_points_come_from_the_verified_matches_at_the_poses_given(
    dive, whole, tmp_path
):
    """The whole model's own points are known: COLMAP adjusted them to these poses."""
    database = write_database(tmp_path / "database.db", dive.model, wrong=0.05)
    found = triangulated(poses_of(whole), tmp_path, database)
    assert {i.name for i in found.images.values()} == {
        i.name for i in whole.images.values()
    }
    for image_id, image in found.images.items():
        np.testing.assert_allclose(  # held, but for rounding
            image.cam_from_world().params,
            whole.images[image_id].cam_from_world().params,
            atol=1e-12,
        )
    # 400 points; refraction that no pinhole explains costs some, wrong matches others.
    assert found.num_points3D() > 300
    point_of = {
        (e.image_id, e.point2D_idx): p.xyz
        for p in whole.points3D.values()
        for e in p.track.elements
    }
    misses = [
        np.linalg.norm(p.xyz - point_of[e.image_id, e.point2D_idx])
        for p in found.points3D.values()
        for e in p.track.elements
        if (e.image_id, e.point2D_idx) in point_of
    ]
    # Seen 2 m away with 0.3 px at 1000 px focal length, from tracks of some images.
    assert np.median(misses) < 0.01


def test_a_model_of_poses_is_refined_like_the_whole_one(dive, whole, tmp_path):
    database = write_database(tmp_path / "database.db", dive.model, wrong=0.0)
    write(poses_of(whole), tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", dive.rig, tmp_path / "out", database=database, report=False
    )
    assert any("has poses without points" in w for w in result.summary["warnings"])
    full = dive.optimum.scene
    assert result.model.scene.num_observations > 0.95 * full.num_observations
    for port, other, stddev in zip(
        result.model.scene.ports,
        full.ports,
        result.calibration.covariance.cameras,
        strict=True,
    ):
        # The same optimum: the same observations but for a few.
        assert abs(port.distance - other.distance) < stddev.distance_stddev_m


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ("no database", r"its database to uwsfm refine \(--database\)"),
        ("other images", "the database has no image left/0000.jpg"),
        ("other poses", "agree with no point at these poses"),
        ("not matched", "no verified matches between their images"),
    ],
)
def test_poses_that_give_no_points_are_named(dive, whole, tmp_path, mistake, words):
    folders = ("l/", "r/") if mistake == "other images" else ("left/", "right/")
    database = write_database(
        tmp_path / "database.db", dive.model, wrong=0.0, folders=folders
    )
    bare = poses_of(whole)
    if mistake == "other poses":
        for image in bare.images.values():  # all at one place, looking one way
            bare.frames[image.frame_id].set_cam_from_world(
                image.camera_id, pycolmap.Rigid3d()
            )
    if mistake == "not matched":
        with pycolmap.Database.open(database) as opened:
            opened.clear_two_view_geometries()
    write(bare, tmp_path / "model", old=True)
    given = None if mistake == "no database" else database
    with pytest.raises(uwsfm.InputError, match=words):
        uwsfm.refine_model(
            tmp_path / "model", dive.rig, tmp_path / "out", database=given
        )
    assert not (tmp_path / "out").exists()


def database_of(model: pycolmap.Reconstruction, path) -> None:
    """Keypoints of a model and, as verified matches, its tracks."""
    seen: dict[int, dict[int, int]] = {image_id: {} for image_id in model.images}
    for point_id, point in model.points3D.items():
        for element in point.track.elements:
            seen[element.image_id][point_id] = element.point2D_idx
    with pycolmap.Database.open(path) as database:
        for camera in model.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        # Other identifiers than the model has: images are found by their names.
        new_id = {old: new for new, old in enumerate(sorted(seen, reverse=True), 1)}
        for old, new in new_id.items():
            image = model.images[old]
            database.write_image(
                pycolmap.Image(
                    name=image.name, camera_id=image.camera_id, image_id=new
                ),
                use_image_id=True,
            )
            xy = np.array([p.xy for p in image.points2D], dtype=np.float32)
            database.write_keypoints(new, xy)
        for a in seen:
            for b in seen:
                common = sorted(seen[a].keys() & seen[b].keys())
                if a < b and common:
                    rows = [(seen[a][p], seen[b][p]) for p in common]
                    matches = np.array(rows, dtype=np.uint32)
                    database.write_matches(new_id[a], new_id[b], matches)
                    database.write_two_view_geometry(
                        new_id[a],
                        new_id[b],
                        pycolmap.TwoViewGeometry(config=2, inlier_matches=matches),
                    )


@needs_cases
def test_the_case_without_points_gives_those_of_the_good_one(tmp_path):
    good = pycolmap.Reconstruction(str(CASES / "models" / "good"))
    database_of(good, tmp_path / "database.db")
    rig = load_rig(CASES / "models" / "rig.yaml")
    folder = copied("no_points", tmp_path / "model")
    model = read_image_model(FoundModel(folder=folder), rig, tmp_path / "database.db")
    whole = read_image_model(FoundModel(folder=CASES / "models" / "good"), rig)
    # COLMAP drops two of 149 observations at these poses, beyond 4 px.
    assert len(model.points) == len(whole.points) == 40
    assert 145 <= len(model.xy) <= len(whole.xy) == 149
    error = np.nanmean(model.own_error_px), np.nanmean(whole.own_error_px)
    # Poses and lenses are the same, and the two that are gone were the worst.
    assert 0.7 * error[1] < error[0] < error[1]


@needs_cases
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("track_to_removed_image", r"points3D.txt: line \d+: point \d+ is seen by"),
        ("right_as_png", "0001.jpg and 0001.png differ by their suffix only"),
        ("no_points", r"its database to uwsfm refine \(--database\)"),
    ],
)
def test_cases_that_stay_refused_name_their_cause(tmp_path, name, words):
    rig = shutil.copy(CASES / "models" / "rig.yaml", tmp_path / "rig.yaml")
    with pytest.raises(uwsfm.InputError, match=words) as error:
        uwsfm.refine_model(copied(name, tmp_path / "model"), rig, tmp_path / "out")
    assert "\n" not in str(error.value)
