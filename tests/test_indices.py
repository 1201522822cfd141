"""Sets of indices: what `numpy.unique` finds by sorting."""

import numpy as np
import pytest

from uwsfm._base.indices import distinct, renumbered


@pytest.mark.parametrize("size", [40, 100_000])  # many of them occur, and few
@pytest.mark.parametrize("shape", [(0,), (30,), (25, 2)])
def test_renumbered_is_what_sorting_finds(rng, size, shape):
    indices = rng.integers(0, size, shape)
    used, place = renumbered(indices, size)
    expected, sorted_place = np.unique(indices, return_inverse=True)
    np.testing.assert_array_equal(used, expected)
    np.testing.assert_array_equal(place, sorted_place.reshape(shape))
    np.testing.assert_array_equal(used[place], indices)


@pytest.mark.parametrize("size", [0, 1, 500])
def test_distinct_is_what_hashing_finds(rng, size):
    indices = rng.integers(0, 200, size)
    np.testing.assert_array_equal(distinct(indices), np.unique(indices))
