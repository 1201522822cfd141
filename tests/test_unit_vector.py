"""The sphere as a manifold: bases, steps and angles."""

import numpy as np
import pytest

from uwsfm.geometry.unit_vector import angle_between, minus, plus, tangent_basis

SPECIAL = [
    (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0),
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (np.sqrt(1.0 - 1e-16), 0.0, -1e-8),
]


def random_directions(rng, count=100):
    rows = rng.normal(size=(count, 3))
    return [*map(np.array, SPECIAL), *(rows / np.linalg.norm(rows, axis=1)[:, None])]


def test_tangent_basis_is_right_handed_and_orthonormal_everywhere(rng):
    for n in random_directions(rng):
        frame = np.column_stack([tangent_basis(n), n])
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)


def test_step_length_is_the_angle_turned_and_its_start_is_the_basis(rng):
    for n in random_directions(rng):
        delta = rng.normal(size=2)
        moved = plus(n, delta)
        assert np.linalg.norm(moved) == pytest.approx(1.0, abs=1e-15)
        assert angle_between(n, moved) == pytest.approx(
            np.linalg.norm(delta), rel=1e-13
        )
        tiny = plus(n, 1e-9 * delta) - n
        np.testing.assert_allclose(tiny, 1e-9 * tangent_basis(n) @ delta, atol=3e-16)
    np.testing.assert_array_equal(plus(SPECIAL[0], (0.0, 0.0)), SPECIAL[0])


def test_minus_is_the_step_that_plus_takes(rng):
    for n in random_directions(rng):
        step = rng.normal(size=2)
        step *= rng.uniform(0.0, 3.0) / np.linalg.norm(step)  # short of the antipode
        for delta in (step, 1e-6 * step, 1e-12 * step):
            # Coordinates are exact to 1e-16; at 3 rad the angle's sine is 0.14 of it.
            np.testing.assert_allclose(minus(plus(n, delta), n), delta, atol=1e-14)
        np.testing.assert_allclose(minus(n, n), 0.0, atol=1e-15)


def test_angles_keep_their_digits_near_zero_and_pi():
    for angle in (1e-12, 1e-6, 1.0, np.pi - 1e-7):
        b = (2.0 * np.sin(angle), 0.0, 2.0 * np.cos(angle))  # lengths do not matter
        assert angle_between((0, 0, 1), b) == pytest.approx(angle, rel=1e-13)
