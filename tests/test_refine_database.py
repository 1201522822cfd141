"""`uwsfm refine --database`: what the pinholes lost comes back from all the matches."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_models import NUM_FRAMES, Dive, self_calibrated, simulated_dive, write

import uwsfm
from uwsfm.geometry import unit_vector
from uwsfm.rig.rig import Rig
from uwsfm.sfm.from_colmap.colmap_model import FoundModel, read_image_model
from uwsfm.sfm.from_colmap.model_database import read_image_database
from uwsfm.sfm.frontend.background import opened

LOST = {(0, 3), (1, 3), (0, 8), (1, 8), (1, 5)}
"""(camera, frame) of images that the model has not registered."""


@pytest.fixture(scope="module")
def dive() -> Dive:
    return simulated_dive()


def write_database(
    path: Path, model, *, wrong: float, shift: float = 0.0, folders=("left/", "right/")
) -> Path:
    """Keypoints, raw matches, and as verified those of frames near each other."""
    scene, rng = model.scene, np.random.default_rng(0)
    keypoint_of = {}
    images = [(c, f) for f in range(scene.num_frames) for c in range(2)]
    with opened(path) as database, pycolmap.DatabaseTransaction(database):
        for image_id, (c, f) in enumerate(images, start=1):
            if f == 0:
                size = scene.cameras[c].width, scene.cameras[c].height
                lens = pycolmap.Camera.create_from_model_name(
                    c + 1, "SIMPLE_RADIAL", 800.0, *size
                )
                database.write_camera(lens, use_camera_id=True)
            name = folders[c] + model.frame_names[f]
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=image_id)
            database.write_image(image, use_image_id=True)
            xy = (model.keypoints[c][f] + shift).astype(np.float32)
            database.write_keypoints(image_id, xy)
            rows = np.flatnonzero((scene.camera_idx == c) & (scene.frame_idx == f))
            keypoint_of[image_id] = dict(
                zip(scene.point_idx[rows], model.keypoint_idx[rows], strict=True)
            )
        for a, b in combinations(keypoint_of, 2):
            common = sorted(keypoint_of[a].keys() & keypoint_of[b].keys())
            rows = [(keypoint_of[a][p], keypoint_of[b][p]) for p in common]
            matches = np.array(rows, dtype=np.uint32).reshape(-1, 2)
            bad = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[bad, 1] = matches[np.roll(bad, 1), 1]  # still one to one
            database.write_matches(a, b, matches)
            if abs(images[a - 1][1] - images[b - 1][1]) <= 2:
                geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=matches)
                database.write_two_view_geometry(a, b, geometry)
    return path


def test_lost_frames_and_images_are_registered_from_all_matches(dive, tmp_path):
    database = write_database(tmp_path / "database.db", dive.model, wrong=0.05)
    content = database.read_bytes()
    found = self_calibrated(dive.model, without=lambda c, f: (c, f) in LOST)
    write(found, tmp_path / "model", old=True)
    result = uwsfm.refine_model(
        tmp_path / "model", dive.rig, tmp_path / "out", database=database, report=False
    )
    assert database.read_bytes() == content
    assert result.summary["num_registered_frames"] == NUM_FRAMES
    assert result.summary["reprojection_rms_px"]["before"] > 5.0  # before anything
    scene, full = result.model.scene, dive.optimum.scene
    seen = set(zip(scene.camera_idx.tolist(), scene.frame_idx.tolist(), strict=True))
    assert seen >= LOST
    # Points that only two images see stay out, and 5 % of the matches are wrong.
    assert scene.num_observations > 0.95 * full.num_observations
    for port, other, stddev in zip(
        scene.ports, full.ports, result.calibration.covariance.cameras, strict=True
    ):
        angle = np.degrees(unit_vector.angle_between(port.normal, other.normal))
        assert angle < stddev.normal_stddev_deg
        assert abs(port.distance - other.distance) < stddev.distance_stddev_m
    common = result.model_idx >= 0
    assert 0.5 < np.mean(common) < 0.95
    np.testing.assert_allclose(  # single precision
        result.start.model.xy[result.model_idx[common]], scene.xy[common], atol=1e-4
    )


def test_a_single_cameras_database_need_not_name_the_folder(dive, tmp_path):
    """The model and the database of COLMAP that was run inside the folder."""
    rig = Rig(cameras=dive.rig.cameras[:1], cam_from_rig=None, baseline_m=None)
    found = self_calibrated(dive.model, without=lambda c, f: c == 1)
    for image in found.images.values():
        image.name = image.name.removeprefix("left/")
    write(found, tmp_path / "model", old=True)
    path = write_database(
        tmp_path / "database.db", dive.model, wrong=0.0, folders=("", "elsewhere/")
    )
    model = read_image_model(FoundModel(folder=tmp_path / "model"), rig)
    known = read_image_database(path, model, rig)
    assert known.frame_names[:NUM_FRAMES] == dive.model.frame_names
    assert np.count_nonzero(known.model_idx >= 0) == len(model.xy)


@pytest.mark.parametrize("what", ["other features", "no database", "missing"])
def test_a_database_that_is_not_of_the_model_is_refused(dive, tmp_path, what):
    write(self_calibrated(dive.model), tmp_path / "model", old=True)
    database, words = tmp_path / "database.db", "does not exist"
    if what == "other features":
        write_database(database, dive.model, wrong=0.0, shift=0.5)
        words = "the keypoints of image left/0000.jpg are others"
    elif what == "no database":
        database.write_bytes(b"no database" * 1000)
        words = "is not a COLMAP database"
    with pytest.raises(uwsfm.InputError, match=words):
        uwsfm.refine_model(
            tmp_path / "model",
            dive.rig,
            tmp_path / "out",
            database=database,
            report=False,
        )
    assert not (tmp_path / "out").exists()
