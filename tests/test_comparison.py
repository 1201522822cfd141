"""Results beside their truth: errors that were put in by hand come out as numbers."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import dome_camera, flat_camera
from hand_made_result import result_of, small_model

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.jobs.evaluate import center_rms, compare_with_truth
from uwsfm.jobs.reconstruct import ReconstructResult, StartArrays
from uwsfm.trust.verdict import FITS, Verdict

NAMES = ("0000.jpg", "0001.jpg", "0002.jpg")
ELSEWHERE = np.append(rigid3.quat_from_rotvec([0.2, -0.4, 0.3]), [3.0, -2.0, 1.0])


def moved(poses, offsets):
    """Poses whose centres are off by so much (F, 3), in their own world."""
    world_from_rig = rigid3.inverse(poses)
    world_from_rig[:, 4:] += offsets
    return rigid3.inverse(world_from_rig)


OBSERVED = ("points", "camera_idx", "frame_idx", "point_idx", "xy")
OFF = np.array([[0.0, 0.0, 0.0], [0.003, 0.004, 0.0], [0.0, 0.0, 0.012]])
"""0, 5 and 12 mm: an RMS of 13 mm / sqrt(3)."""


def test_centres_are_compared_after_the_first_pose_is_laid_upon_the_truth():
    poses = small_model().scene.rig_from_world
    here = rigid3.compose(moved(poses, OFF), ELSEWHERE)  # in another world
    assert center_rms(here, poses) == pytest.approx(0.013 / math.sqrt(3.0), rel=1e-9)
    # A scale is no motion: twice as large is off by the distances from the first.
    larger = moved(poses, rigid3.inverse(poses)[:, 4:] - rigid3.inverse(poses)[0, 4:])
    far = rigid3.inverse(poses)[:, 4:] - rigid3.inverse(poses)[0, 4:]
    expected = math.sqrt(np.mean(np.sum(far**2, axis=1)))
    assert center_rms(larger, poses) == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A result that is off by known amounts, with five frames in its truth."""
    model = small_model()
    poses = model.scene.rig_from_world
    scene = replace(model.scene, rig_from_world=moved(poses, OFF))
    start = StartArrays(
        frame_names=NAMES,
        rig_from_world=moved(poses, 2.0 * OFF),
        keypoint_idx=model.keypoint_idx,
        keypoints=model.keypoints,
        **{name: getattr(scene, name) for name in OBSERVED},
    )
    cameras = [
        flat_camera("left", 2.0),
        dome_camera("nose", 7.0),
        {"name": "air", "port": "none"},
        flat_camera("right", 4.0),
    ]
    result = ReconstructResult(
        model=replace(model, scene=scene),
        calibration=result_of(scene),
        summary={"cameras": cameras},
        start=start,
        verdict=Verdict(verdict=FITS, reasons=(), goodness=None),
    )
    # Leaning about x by 2 and 5 degrees more than the estimate does.
    truth = {
        "rig_from_world": {
            **dict(zip(NAMES, poses.tolist(), strict=True)),
            "0003.jpg": poses[0].tolist(),
            "0004.jpg": poses[0].tolist(),
        },
        "cameras": [
            {"normal": leaning(cameras[0]["normal"], 2.0), "distance_m": 0.0301},
            {"center_m": [0.001, 0.002, 0.003]},
            {},
            {"normal": leaning(cameras[3]["normal"], 5.0), "distance_m": 0.0299},
        ],
    }
    path = tmp_path_factory.mktemp("truth") / "truth.json"
    path.write_text(json.dumps(truth))
    return result, path, truth


def leaning(normal, degrees):
    """A normal turned about an axis across it."""
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    axis *= math.radians(degrees) / np.linalg.norm(axis)
    pose = np.append(rigid3.quat_from_rotvec(axis), np.zeros(3))
    return rigid3.rotate(pose, np.array(normal)).tolist()


def test_every_error_is_the_one_that_was_put_in(compared):
    result, path, truth = compared
    found = compare_with_truth(result, path)
    left, right = found.cameras
    assert [left.name, right.name] == ["left", "right"]
    assert left.tilt_error_deg == pytest.approx(2.0, rel=1e-6)
    assert right.tilt_error_deg == pytest.approx(5.0, rel=1e-6)
    entries = result.summary["cameras"]
    for camera, entry, true in (
        (left, entries[0], truth["cameras"][0]),
        (right, entries[3], truth["cameras"][3]),
    ):
        assert list(camera.normal) == entry["normal"]
        assert list(camera.true_normal) == true["normal"]
        assert camera.tilt_stddev_deg == entry["normal_stddev_deg"]
        assert camera.distance_m == entry["distance_m"]
        assert camera.distance_stddev_m == entry["distance_stddev_m"]
        assert camera.true_distance_m == true["distance_m"]
    # 20.45 mm instead of 30.1, 40.45 instead of 29.9
    assert left.distance_error_m == pytest.approx(-0.00965, abs=1e-12)
    assert right.distance_error_m == pytest.approx(0.01055, abs=1e-12)
    (dome,) = found.domes
    assert dome.name == "nose"
    assert dome.center_m == tuple(entries[1]["center_m"])
    assert dome.center_stddev_m == tuple(entries[1]["center_stddev_m"])
    assert dome.true_center_m == (0.001, 0.002, 0.003)
    assert (found.num_frames, found.num_true_frames) == (3, 5)
    rms = 0.013 / math.sqrt(3.0)
    assert found.center_rms_m == pytest.approx(rms, rel=1e-9)
    assert found.start_center_rms_m == pytest.approx(2.0 * rms, rel=1e-9)


def test_a_truth_of_other_images_is_refused(compared, tmp_path):
    result, _, truth = compared
    poses = dict(truth["rig_from_world"])
    for name in NAMES[1:]:
        del poses[name]
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({**truth, "rig_from_world": poses}))
    with pytest.raises(InputError, match=f"truth.json: no pose of frame {NAMES[1]}"):
        compare_with_truth(result, path)
