"""`Scene`: what it refuses, and what it computes."""

from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene
from jacobians import EXAMPLE_CAMERAS

from uwsfm import FlatPort, InputError, RefractiveCamera, Scene
from uwsfm.geometry import rigid3

CAMERA = RefractiveCamera(EXAMPLE_CAMERAS[0], FlatPort())


def arrays(**changes):
    """Two cameras, two frames, three points, four observations; then the changes."""
    values = {
        "cameras": [CAMERA, CAMERA],
        "cam_from_rig": np.stack([rigid3.IDENTITY, [0, 0, 0, 1, -0.2, 0, 0]]),
        "rig_from_world": np.stack([rigid3.IDENTITY, [0, 0, 1, 0, 0, 0, 1]]),
        "points": np.array([[0, 0, 2.0], [0.1, 0, 2], [np.nan] * 3]),
        "camera_idx": [0, 1, 0, 1],
        "frame_idx": [0, 0, 1, 1],
        "point_idx": [0, 0, 1, 1],
        "xy": np.full((4, 2), 400.0),
    }
    return values | changes


def changed(name, index, value):
    array = np.array(arrays()[name], dtype=float)
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cameras": []}, r"cameras is empty"),
        ({"cameras": [CAMERA]}, r"2 rows in cam_from_rig for 1 cameras"),
        ({"cam_from_rig": rigid3.IDENTITY}, r"cam_from_rig.shape=\(7,\)"),
        (
            changed("cam_from_rig", (0, 4), 0.1),
            r"cam_from_rig\[0\] must be the identity",
        ),
        (
            changed("cam_from_rig", (1, 3), 0.9),
            r"cam_from_rig\[1\] must be a unit quat",
        ),
        (changed("rig_from_world", (1, 6), np.nan), r"rig_from_world\[1\]"),
        (changed("rig_from_world", (1, 2), 0.0), r"rig_from_world\[1\] .* unit quat"),
        ({"rig_from_world": np.zeros((2, 6))}, r"rig_from_world.shape=\(2, 6\)"),
        ({"points": np.zeros((3, 2))}, r"points.shape=\(3, 2\)"),
        (changed("xy", (2, 0), np.nan), r"xy\[2\] is not finite"),
        ({"xy": np.zeros((4, 3))}, r"xy.shape=\(4, 3\)"),
        ({"xy": np.zeros((3, 2))}, r"camera_idx must be 3 integers"),
        ({"camera_idx": [0, 1, 0, 2]}, r"camera_idx\[3\]=2 is out of range: .* 2"),
        ({"frame_idx": [0, 0, -1, 1]}, r"frame_idx\[2\]=-1 is out of range"),
        ({"point_idx": [0, 3, 1, 1]}, r"point_idx\[1\]=3 is out of range"),
        ({"point_idx": [0.0, 0.0, 1.0, 1.0]}, r"point_idx must be 4 integers"),
    ],
)
def test_wrong_arrays_are_refused_with_array_and_row_named(changes, words):
    with pytest.raises(InputError, match=words):
        Scene.from_arrays(**arrays(**changes))


def test_arrays_are_copied_and_quaternions_made_unit():
    given = arrays()
    given["rig_from_world"][1, 2] = 1.0 + 1e-7
    given["cam_from_rig"][0, 3] = -1.0  # the same rotation
    scene = Scene.from_arrays(**given)
    given["xy"][:] = given["points"][:] = 0.0
    assert scene.xy[0, 0] == 400.0 and scene.points[0, 2] == 2.0
    np.testing.assert_allclose(np.linalg.norm(scene.rig_from_world[:, :4], axis=1), 1.0)
    np.testing.assert_array_equal(scene.cam_from_rig[0], rigid3.IDENTITY)
    assert (scene.num_frames, scene.num_points, scene.num_observations) == (2, 3, 4)


def test_poses_are_applied_rig_first_then_camera():
    scene = Scene.from_arrays(**arrays())
    # Frame 1 turns by 180 degrees about z and rises 1 m; camera 1 shifts by -0.2.
    np.testing.assert_allclose(
        scene.points_in_cam(),
        [[0, 0, 2], [-0.2, 0, 2], [-0.1, 0, 3], [-0.3, 0, 3]],
        atol=1e-15,
    )


def test_exact_observations_project_back_and_their_rays_meet_the_points():
    scene = small_scene().truth
    assert np.abs(scene.residuals()).max() < 1e-9
    origins, dirs = scene.water_rays()
    to_point = scene.points[scene.point_idx] - origins
    # Metres; the pixel is exact to 1e-11 px, a ray of 3 m to 1e-13.
    assert np.abs(np.cross(to_point, dirs)).max() < 1e-11
    shifted = replace(scene, xy=scene.xy + [1.0, -2.0])
    np.testing.assert_allclose(shifted.residuals()[0], [-1.0, 2.0], atol=1e-9)


def test_points_that_cannot_be_projected_are_nan_and_not_valid():
    points = np.array([[0, 0, 2.0], [0, 0, -5], [0, 0, 0]])
    scene = Scene.from_arrays(**arrays(points=points))
    xy, valid = scene.projections()
    assert valid.tolist() == [True, True, False, False]
    assert np.isnan(xy[2:]).all() and np.isnan(scene.residuals()[2:]).all()


def test_selection_keeps_only_the_points_still_seen_and_says_which():
    scene = Scene.from_arrays(**arrays())
    smaller, used = scene.select([False, False, True, True])
    assert used.tolist() == [1] and smaller.num_points == 1
    assert smaller.point_idx.tolist() == [0, 0]
    assert smaller.num_frames == 2  # frames and cameras keep their numbers
    np.testing.assert_array_equal(smaller.points, scene.points[[1]])
    np.testing.assert_array_equal(smaller.points_in_cam(), scene.points_in_cam()[2:])
    nothing, used = scene.select(np.zeros(4, dtype=bool))
    assert nothing.num_observations == nothing.num_points == len(used) == 0
