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


def test_a_flatness_has_the_sign_of_its_side():
    """Of an area's, where its corners go round counter-clockwise; of a height's, where
    its top is."""
    z = np.array([0.1, -0.1, 0.1, -0.1])
    square = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], dtype=float)
    bent = square + np.outer(z, [0.0, 0.0, 1.0])
    # Sums of a few numbers near one: their last digits.
    np.testing.assert_allclose(quantities.area(bent).flatness, z, atol=1e-14)
    np.testing.assert_allclose(quantities.area(bent[::-1]).flatness, z, atol=1e-14)
    for side in (1.0, -1.0):
        found = quantities.height(np.vstack([[0.7, 0.4, 5.0 * side], bent]))
        assert found.value == pytest.approx(5.0)
        assert np.isnan(found.flatness[0])
        np.testing.assert_allclose(found.flatness[1:], side * z, atol=1e-14)


def thin(share):
    """Corners of a rectangle, 2 m long and this share of that wide."""
    return 2.0 * np.array([[0, 0, 0], [1, 0, 0], [1, share, 0], [0, share, 0]])


def test_places_are_on_a_line_below_a_thousandth():
    """Of their length; of an angle, the sine."""
    assert quantities.area(thin(1.1e-3)).value == pytest.approx(4.4e-3)
    # A quarter up from one end of the rectangle, and 3 m above it.
    top = [0.5, 0.001, -3.0]
    assert quantities.height(np.vstack([top, thin(1.1e-3)])).value == pytest.approx(3.0)
    narrow = thin(0.9e-3)
    with pytest.raises(InputError, match="corners lie on a line"):
        quantities.area(narrow)
    with pytest.raises(InputError, match="places of the plane lie on a line"):
        quantities.height(np.vstack([top, narrow]))
    for far in (1.0, -1.0):
        for sine, refused in ((1.1e-3, False), (0.9e-3, True)):
            ends = np.array([[0, 0, 0], [2, 0, 0], [far, far * sine, 0]])
            if refused:
                with pytest.raises(InputError, match="three places lie on a line"):
                    quantities.angle(ends)
            else:
                expected = np.arctan(sine) if far > 0 else np.pi - np.arctan(sine)
                assert quantities.angle(ends).value == pytest.approx(expected)


def test_places_that_are_nearly_one_are_refused():
    """The squares of their distances are zero."""
    corners = 1e-170 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    with pytest.raises(InputError, match="corners lie on a line"):
        quantities.area(corners)
    for base in (corners, np.ones((3, 3))):
        with pytest.raises(InputError, match="places of the plane lie on a line"):
            quantities.height(np.vstack([[1.0, 2.0, 3.0], base]))


FAR = np.array([9000.0, -8000.0, 7000.0])
"""Metres, of a frame that positions gave."""


def test_small_things_far_from_the_origin_are_measured_as_well():
    """Coordinates there have 2e-12 m: of a centimetre, and of its square, 1e-9."""
    square = 0.01 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) + FAR
    assert quantities.area(square).value == pytest.approx(1e-4, rel=1e-8)
    slope = quantities.area(square).slope
    # Half the diagonal beside a corner, outwards.
    np.testing.assert_allclose(slope[0], [-0.005, -0.005, 0.0], atol=1e-10)
    np.testing.assert_allclose(quantities.area(square).flatness, 0.0, atol=1e-11)
    top = FAR + [0.003, 0.004, 0.02]
    above = quantities.height(np.vstack([top, square]))
    assert above.value == pytest.approx(0.02, rel=1e-8)
    line = np.outer([0.0, 0.004, 0.01], [0.6, 0.8, 0.0]) + FAR
    with pytest.raises(InputError, match="corners lie on a line"):
        quantities.area(line)


TURNED_IN = [[0, 0, 0], [4, 0, 0], [4, 3, 0], [2, 1, 0], [0, 3, 0]]
"""A roof upside down on a box: 12 less a triangle of 4 by 2, half of it."""
TOUCHING = [[0, 0, 0], [4, 0, 0], [4, 4, 0], [2, 0, 0], [0, 4, 0]]
"""Its notch reaches the opposite side: 16 less 8."""
STEPS = [[0, 0, 0], [3, 0, 0], [3, 1, 0], [2, 1, 0], [2, 2, 0], [0, 2, 0]]


@pytest.mark.parametrize(
    ("corners", "value"), [(TURNED_IN, 8.0), (TOUCHING, 8.0), (STEPS, 5.0)]
)
def test_corners_that_turn_in_are_no_crossing(corners, value):
    """Whichever is the first, and either way round."""
    points = np.array(corners, dtype=float)
    for start in range(len(points)):
        around = np.roll(points, start, axis=0)
        assert quantities.area(around).value == pytest.approx(value)
        assert quantities.area(around[::-1]).value == pytest.approx(value)


@pytest.mark.parametrize(
    ("corners", "sides"),
    [
        ([[0, 0], [1, 0], [0, 1], [1, 1]], (2, 4)),
        ([[0, 0], [2, 0], [2, 2], [1, -1], [0, 2]], (1, 3)),
        ([[1, -1], [0, 2], [0, 0], [2, 0], [2, 2]], (1, 3)),
        ([[0, 0], [3, 0], [3, 3], [2, 4], [1, -1], [0, 3]], (1, 4)),
        ([[0, 3], [0, 0], [3, 0], [3, 3], [2, 4], [1, -1]], (2, 5)),
        ([[1, -1], [0, 3], [0, 0], [3, 0], [3, 3], [2, 4]], (1, 3)),
        ([[2, 4], [1, -1], [0, 3], [0, 0], [3, 0], [3, 3]], (1, 4)),
    ],
)
def test_the_first_sides_that_cross_are_named(corners, sides):
    points = np.column_stack([np.array(corners, dtype=float), np.zeros(len(corners))])
    with pytest.raises(InputError, match=f"sides {sides[0]} and {sides[1]} cross"):
        quantities.area(points)


@pytest.mark.parametrize(
    ("order", "named"),
    [
        ([0, 1, 2, 1], "2 and 4"),
        ([0, 1, 2, 0], "1 and 4"),
        ([2, 0, 1, 3, 1, 2], "3 and 5"),
        ([3, 2, 0, 2, 3], "2 and 4"),
        ([0, 1, 1, 2], "2 and 3"),
    ],
)
def test_a_corner_that_is_given_twice_is_named(order, named):
    """The first that comes again, and where it was."""
    points = np.array([[0, 0, 1], [0.7, 0.1, 1], [1, 1, 1], [0, 1, 1.1]])[order]
    with pytest.raises(InputError, match=f"^corners {named} are one and the same"):
        quantities.area(points)


def test_two_places_of_a_line_that_are_one_are_named():
    points = np.array([[0, 0, 1], [1, 0, 1], [1, 0, 1], [2, 0, 1]], dtype=float)
    with pytest.raises(InputError, match="^places 2 and the next are one"):
        quantities.polyline(points)
    assert quantities.polyline(points[[0, 1, 3]]).value == pytest.approx(2.0)
