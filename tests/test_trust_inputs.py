"""Wrong inputs of the study in pipelines/trust are what their names say."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig

FOLDER = Path(__file__).parent.parent / "pipelines" / "trust"
sys.path.insert(0, str(FOLDER))

from dives import Dive, simulated_dive  # noqa: E402
from wrong_inputs import (  # noqa: E402
    BOTH,
    MISTAKES,
    as_position,
    in_water_lens,
    inverted,
    mirrored,
    transposed,
)


@pytest.fixture(scope="module")
def flat() -> Dive:
    return simulated_dive("small", num_frames=6, num_points=150)


@pytest.fixture(scope="module")
def domes() -> Dive:
    return simulated_dive("small", num_frames=6, num_points=150, domes=True)


def rig_numbers(rig: Rig) -> np.ndarray:
    """All of a rig that its observations depend on, and what is held, in one row."""
    parts = [np.ravel(rig.cam_from_rig), [float(rig.refine_cam_from_rig)]]
    for camera in rig.cameras:
        parts += [[float(camera.camera.model)], camera.camera.params, camera.port.row]
    return np.concatenate([np.asarray(part, dtype=float) for part in parts])


def same_input(a: Dive, b: Dive) -> bool:
    if a.keypoints.keys() != b.keypoints.keys() or a.matches.keys() != b.matches.keys():
        return False
    numbers = rig_numbers(a.rig), rig_numbers(b.rig)
    return (
        np.array_equal(*numbers)
        and all(np.array_equal(a.keypoints[k], b.keypoints[k]) for k in a.keypoints)
        and all(np.array_equal(a.matches[k], b.matches[k]) for k in a.matches)
    )


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_every_mistake_changes_its_dive_and_repeats(mistake, flat, domes):
    right = domes if mistake.domes else flat
    wrong = mistake.applied(right, 0)
    assert not same_input(wrong, right)
    assert same_input(wrong, mistake.applied(right, 0))
    for (a, b), rows in wrong.matches.items():  # every match is of keypoints there are
        assert rows[:, 0].max() < len(wrong.keypoints[a])
        assert rows[:, 1].max() < len(wrong.keypoints[b])
        assert a[1] < wrong.num_frames and b[1] < wrong.num_frames
    assert wrong.keypoints.keys() == set(wrong.images) == wrong.taken.keys()


def test_there_are_forty_kinds_with_names_of_their_own():
    assert len(MISTAKES) >= 40
    assert len({mistake.name for mistake in MISTAKES}) == len(MISTAKES)


@pytest.mark.parametrize("change", [transposed, inverted])
def test_a_pose_changed_twice_is_the_right_one(change, flat, rng):
    pose = flat.rig.cam_from_rig[1]
    wrong = change(pose, rng)
    # 2 to 5 degrees of toe-in: transposing turns by twice as much.
    turn = rigid3.rotation_angle(rigid3.compose(wrong, rigid3.inverse(pose)))
    assert np.degrees(turn) > 3.9
    # A quaternion and its negative are one rotation.
    np.testing.assert_allclose(
        rigid3.compose(change(wrong, rng), rigid3.inverse(pose)),
        rigid3.IDENTITY,
        atol=1e-12,
    )


def test_the_position_of_a_camera_keeps_its_rotation_and_baseline(flat, rng):
    pose = flat.rig.cam_from_rig[1]
    wrong = as_position(pose, rng)
    assert np.array_equal(wrong[:4], pose[:4])
    assert np.linalg.norm(wrong[4:]) == pytest.approx(0.2, rel=1e-12)
    assert wrong[4] == pytest.approx(
        0.2, rel=1e-9
    )  # where the rig was built to have it


@pytest.mark.parametrize("axis", [0, 1])
def test_images_mirrored_twice_are_the_right_ones(flat, rng, axis):
    mirror = mirrored(BOTH, axis)
    twice = mirror(mirror(flat, rng), rng)
    for key, xy in flat.keypoints.items():
        np.testing.assert_allclose(twice.keypoints[key], xy, atol=1e-9)
    assert twice.matches.keys() == flat.matches.keys()


def test_a_lens_calibrated_in_the_water_sees_what_the_camera_sees(flat):
    """Against the exact projection at the depth of calibration: the distortion takes
    in the port, but for its tilt of 3 degrees, which is worth some tenths of a pixel;
    the focal length is that of the water."""
    camera = flat.true_rig.refractive_cameras()[0]
    lens = in_water_lens(camera, 1.0)
    assert lens.params[0] / camera.lens[0] == pytest.approx(1.35, abs=0.05)
    xy = np.array([[60.0, 60.0], [200.0, 150.0], [350.0, 250.0]])
    origin, ray = camera.ray_from_img(xy)
    points = origin + ray * ((1.0 - origin[:, 2]) / ray[:, 2])[:, None]
    assert np.abs(lens.img_from_cam(points) - xy).max() < 0.5


def test_a_late_camera_loses_the_frames_that_it_has_no_image_for(flat):
    late = next(m for m in MISTAKES if m.name == "right camera two frames late")
    wrong = late.applied(flat, 0)
    assert wrong.num_frames == flat.num_frames - 2
    left = [flat.keypoints[0, flat.names.index(name)] for name in wrong.names]
    for f, xy in enumerate(left):  # the reference keeps its images
        assert np.array_equal(wrong.keypoints[0, f], xy)
        assert not np.array_equal(
            wrong.keypoints[1, f], flat.keypoints[1, flat.names.index(wrong.names[f])]
        )


def test_matches_follow_their_images_into_the_database(flat, tmp_path):
    from dives import read_dive

    late = next(m for m in MISTAKES if m.name == "left camera one frame late")
    wrong = late.applied(flat, 1)
    wrong.write_database(tmp_path / "database.db")
    again = read_dive(
        tmp_path / "database.db",
        wrong.frames(tmp_path),
        wrong.rig,
        wrong.true_rig,
        wrong.true_poses,
    )
    assert same_input(replace(again, rig=wrong.rig), rounded(wrong))


def rounded(dive: Dive) -> Dive:
    """As a database stores it: keypoints in single precision."""
    xy = {k: v.astype(np.float32).astype(float) for k, v in dive.keypoints.items()}
    return replace(dive, keypoints=xy)
