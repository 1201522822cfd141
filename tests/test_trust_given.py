"""Estimates against what was given: the factor of several numbers together."""

import numpy as np
import pytest

from uwsfm.trust.given import mean_factor


def test_a_factor_of_equal_ports_is_their_mean():
    """10 and 10 mm given, 20 and 30 found, each ± 2 from the images and ± 1 from a
    ruler of its own: 2.5 ± 0.2 / sqrt(2) ± 0.1 / sqrt(2)."""
    found = mean_factor(
        np.array([10.0, 10.0]),
        np.array([20.0, 30.0]),
        4.0 * np.eye(2),
        np.eye(2),
    )
    assert found == pytest.approx((2.5, 0.2 / np.sqrt(2), 0.1 / np.sqrt(2)))


def test_a_ruler_error_in_common_is_not_averaged_away():
    given = np.array([10.0, 10.0])
    found = mean_factor(given, given, 1e-6 * np.eye(2), np.ones((2, 2)))
    assert found[2] == pytest.approx(0.1)  # 1 of 10 mm, however many ports


def test_the_factor_lies_between_those_of_the_ports_however_they_are_correlated():
    """Ports of 20 and 40 mm that came out right, but for a common error and 1 mm each:
    generalised least squares gives 0.88 or so, outside of 0.95 to 1.025."""
    given, found = np.array([20.0, 40.0]), np.array([19.0, 41.0])
    both = np.array([3.0, 20.0])
    images = np.outer(both, both) + 0.01 * np.eye(2)
    factor, *_ = mean_factor(given, found, images, 1e-6 * np.eye(2))
    assert 0.95 <= factor <= 1.025
    general = np.linalg.solve(images, given)
    assert not 0.95 <= general @ found / (general @ given) <= 1.025
