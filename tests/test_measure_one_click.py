"""A spot clicked in one image: what click and surface add to its deviation."""

import numpy as np
import pytest

import uwsfm
from uwsfm.calibration.propagation import Propagation
from uwsfm.geometry import rigid3
from uwsfm.measuring.measurements_file import load_measurements
from uwsfm.measuring.spots import Spotter
from uwsfm.measuring.surface import Surface

STEP = 0.02
"""Of the surface's points, metres: some eight pixels."""


@pytest.fixture(scope="module")
def opened(dive_result):
    return uwsfm.open_result(dive_result.out)


def plane_before(scene, rough):
    """A slope 1.5 m before the first camera in the first frame, and points on it that
    lie ``rough`` before and behind it along the sight, in turn."""
    pose = rigid3.inverse(scene.rig_from_world[0])
    count = int(0.8 / STEP) + 1
    index = np.arange(count)
    i, j = (n.ravel() for n in np.meshgrid(index, index))
    x, y = (STEP * (n - count // 2) for n in (i, j))
    in_cam = np.stack([x, y, 1.5 + 0.3 * x - 0.2 * y], axis=1)
    sight = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
    in_cam += rough * np.where((i + j) % 2, 1.0, -1.0)[:, None] * sight
    return rigid3.transform(pose, in_cam)


def spotted(opened, rough, click_stddev_px=1.0, xy=(410.0, 290.0)):
    """(place (3,), its covariance (3, 3), direction of sight (3,)) of a click."""
    propagation = Propagation(opened.calibration)
    spotter = Spotter(opened, propagation)
    points = plane_before(opened.model.scene, rough)
    # A cloud that claims next to nothing adds next to nothing.
    spotter.surface = Surface(points, "a cloud", np.full(len(points), 1e-7))
    picks = [f"left/0000.jpg:{xy[0]},{xy[1]}", 1]
    content = {"version": 1, "click_stddev_px": click_stddev_px}
    tasks = load_measurements({**content, "distances": [{"ends": picks}]})
    row = spotter.rows_of(tasks[0])[0]
    places = spotter.places()
    slopes = np.zeros((3, len(places), 3))
    slopes[:, row] = np.eye(3)
    camera = opened.model.scene.cameras[0]
    _, direction = camera.ray_from_img([xy])
    pose = rigid3.inverse(opened.model.scene.rig_from_world[0])
    sight = rigid3.rotate(pose, direction[0])
    return places.points[row], propagation.covariance(places, slopes), sight


def test_a_click_slides_along_the_surface(opened):
    """By differences: the place of a click a pixel aside, on a plane."""
    _, sharp, _ = spotted(opened, 0.0, click_stddev_px=1.0)
    _, blunt, _ = spotted(opened, 0.0, click_stddev_px=3.0)
    slide = [
        spotted(opened, 0.0, xy=(410.0 + dx, 290.0 + dy))[0]
        - spotted(opened, 0.0, xy=(410.0 - dx, 290.0 - dy))[0]
        for dx, dy in ((0.5, 0.0), (0.0, 0.5))
    ]
    expected = np.einsum("ka,kb->ab", slide, slide)  # of a click of one pixel
    # Over a pixel, a central difference is good to 1e-6 of it.
    np.testing.assert_allclose(
        (blunt - sharp) / 8.0, expected, atol=1e-4 * np.trace(expected)
    )


@pytest.mark.parametrize("rough", [0.003, 0.006])
def test_relief_is_in_the_depth_of_a_click(opened, rough):
    """Points some millimetres before and behind the plane, in turn: the depth of what
    was clicked is known to that, and not better for being a mean of twelve."""
    place, smooth, sight = spotted(opened, 0.0)
    other, found, _ = spotted(opened, rough)
    added = sight @ (found - smooth) @ sight
    # A plane fitted to twelve of them takes three of twelve degrees of freedom, and
    # follows the relief by up to that.
    assert 0.7 * rough < np.sqrt(added) < 1.05 * rough
    across = np.linalg.svd(sight[None])[2][1:]
    assert np.abs(across @ (found - smooth) @ across.T).max() < 0.05 * rough**2
    assert np.linalg.norm(other - place) < rough
