"""Lengths, areas, heights and angles: known values, and slopes by differences."""

import numpy as np
import pytest
from jacobians import central_differences

from uwsfm import InputError
from uwsfm.geometry import rigid3
from uwsfm.measuring import quantities

COUNTS = {"distance": 2, "polyline": 5, "angle": 3, "area": 6, "height": 6}


def places(name, rng):
    """In general position; polygons go round."""
    count = COUNTS[name]
    found = rng.normal(size=(count, 3))
    if name == "area":
        turn = np.arange(count) * 2.0 * np.pi / count
        found = np.column_stack([np.cos(turn), np.sin(turn), 0.1 * found[:, 2]])
    return found


@pytest.mark.parametrize("name", COUNTS)
def test_slopes_are_the_derivatives(name, rng):
    compute, points = getattr(quantities, name), places(name, rng)

    def value(delta):
        return np.array([compute(points + delta.reshape(-1, 3)).value])

    expected = central_differences(value, points.size, 1e-3).reshape(-1, 3)
    # A five-point stencil at steps of 1e-3: 1e-12 of the fifth derivative.
    np.testing.assert_allclose(compute(points).slope, expected, atol=1e-8)


@pytest.mark.parametrize("name", COUNTS)
def test_the_frame_of_the_world_does_not_matter(name, rng):
    """Neither to the value nor, turned with it, to the slope."""
    compute, points = getattr(quantities, name), places(name, rng)
    pose = np.append(rigid3.quat_from_rotvec([0.3, -1.1, 0.7]), [4.0, -2.0, 9.0])
    before, after = compute(points), compute(rigid3.transform(pose, points))
    assert after.value == pytest.approx(before.value, rel=1e-12)
    turned = rigid3.rotate(pose, before.slope)
    np.testing.assert_allclose(after.slope, turned, atol=1e-12)


def test_known_figures():
    square = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1]], dtype=float)
    assert quantities.area(square).value == pytest.approx(4.0)
    assert np.abs(quantities.area(square).flatness).max() < 1e-15
    bent = square + [[0, 0, 0.1], [0, 0, -0.1], [0, 0, 0.1], [0, 0, -0.1]]
    np.testing.assert_allclose(np.abs(quantities.area(bent).flatness), 0.1)
    assert quantities.polyline(square).value == pytest.approx(6.0)
    assert quantities.angle(square[:3]).value == pytest.approx(np.pi / 4)
    above = np.vstack([[0.3, 1.9, -2.5], square])
    assert quantities.height(above).value == pytest.approx(3.5)


@pytest.mark.parametrize(
    ("compute", "points", "words"),
    [
        ("distance", [[0, 0, 1], [0, 0, 1]], "places 1 and the next are one"),
        ("angle", [[0, 0, 1], [0, 0, 1], [1, 0, 0]], "an end is the corner itself"),
        ("angle", [[0, 0, 1], [0, 0, 2], [0, 0, 3]], "lie on a line"),
        ("area", [[0, 0, 1], [0, 0, 2], [0, 0, 4]], "lie on a line: there is no area"),
        ("area", [[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]], "sides 1 and 3 cross"),
        ("area", [[0, 0, 0], [3, 2, 0], [1, 0, 0], [0, 1, 0.1]], "sides 1 and 3 cross"),
        ("height", [[9, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 4]], "plane lie on a line"),
    ],
)
def test_figures_that_are_none_are_refused(compute, points, words):
    with pytest.raises(InputError, match=words):
        getattr(quantities, compute)(np.array(points, dtype=float))
