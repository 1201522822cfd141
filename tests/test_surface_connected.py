"""The surface that a cloud is about: connected by its own spacing, strays left out."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist, squareform

from uwsfm.surface.connected import LINK_SPACINGS, main_parts
from uwsfm.surface.height_map import point_spacing


def floor(rng, count=3000, shift=(0.0, 0.0, 0.0)):
    """Points of a wavy square metre."""
    xy = rng.uniform(0.0, 1.0, (count, 2))
    return np.column_stack([xy, 0.1 * np.sin(6.0 * xy[:, 0])]) + shift


def test_strays_are_left_out_however_far(rng):
    """A few points beside, below, and so far off that whole numbers would overflow."""
    surface = floor(rng)
    strays = [[0.5, 0.5, -3.0], [40.0, 0.0, 0.0], [1e300, -1e300, 2.0]]
    clump = 0.01 * rng.normal(size=(250, 3)) + [5.0, 5.0, 0.0]
    found = main_parts(np.concatenate([surface, strays, clump]))
    assert found.main[:3000].all() and not found.main[3000:].any()
    assert (found.num_kept, found.num_left_out) == (1, 4)
    assert found.link == pytest.approx(LINK_SPACINGS * point_spacing(surface), rel=0.2)


def test_two_objects_of_a_size_are_no_strays(rng):
    """A quarter of the points two metres beside: kept; a twentieth: left out."""
    for count, kept in ((750, 2), (150, 1)):
        second = floor(rng, count, (3.0, 0.0, 0.0)) * [0.2, 0.2, 1.0]
        found = main_parts(np.concatenate([floor(rng), second + [3.0, 0.0, 0.0]]))
        assert found.num_kept == kept
        assert found.main[3000:].all() == (kept == 2)


def test_what_is_nearer_than_the_link_is_joined_and_much_farther_is_not(rng):
    """Against single linkage by all distances: two points nearer than the link are of
    one part; no step within a part is longer than 3.5 links."""
    points = rng.uniform(0.0, 1.0, (400, 3)) ** 2
    link = 0.03
    found = main_parts(points, link)
    distances = squareform(pdist(points))
    near = (distances < link).any(axis=1, where=~np.eye(400, dtype=bool))
    inside, outside = found.main, ~found.main
    assert 0 < np.count_nonzero(inside) < 400
    across = distances[np.ix_(inside, outside)]
    assert across.min() >= link
    np.fill_diagonal(distances, np.inf)
    alone = distances[np.ix_(inside, inside)].min(axis=1)
    assert alone.max() <= 3.5 * link and near[inside].any()


def test_few_points_are_kept(rng):
    found = main_parts(rng.normal(size=(5, 3)))
    assert found.main.all() and found.num_kept == 1
