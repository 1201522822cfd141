"""Triangulation, gaps and angles of rays."""

import numpy as np
from naive import nearest_point

from uwsfm.geometry.rays import closest_points, max_ray_angles, triangulate_tracks


def rays_through(rng, points, per_point, noise=0.0):
    index = np.repeat(np.arange(len(points)), per_point)
    origins = points[index] + rng.normal(size=(len(index), 3))
    dirs = points[index] - origins + noise * rng.normal(size=(len(index), 3))
    return index, origins, dirs / np.linalg.norm(dirs, axis=1, keepdims=True)


def test_exact_rays_meet_in_their_point_even_far_from_the_origin(rng):
    points = rng.normal(size=(50, 3)) + [1e6, -2e6, 1e5]  # a map grid in metres
    index, origins, dirs = rays_through(rng, points, 3)
    # Coordinates of 2e6 m are rounded to 2e-10 m; near-parallel rays magnify it.
    found = triangulate_tracks(origins, dirs, index, 50)
    assert np.abs(found - points).max() < 1e-7


def test_noisy_rays_give_the_least_squares_point(rng):
    points = rng.normal(size=(20, 3))
    index, origins, dirs = rays_through(rng, points, 4, noise=0.01)
    shuffled = rng.permutation(len(index))  # the order of observations is free
    index, origins, dirs = index[shuffled], origins[shuffled], dirs[shuffled]
    found = triangulate_tracks(origins, dirs, index, 20)
    for p, point in enumerate(found):
        expected = nearest_point(origins[index == p], dirs[index == p])
        np.testing.assert_allclose(point, expected, atol=1e-10)  # both well conditioned


def test_points_without_two_distinct_rays_are_nan(rng):
    index, origins, dirs = rays_through(rng, rng.normal(size=(4, 3)), 2)
    dirs[1] = dirs[0]  # point 0: parallel
    dirs[3] = np.nan  # point 1: one ray is left
    found = triangulate_tracks(origins, dirs, index, 5)  # point 4: no rays
    assert np.isnan(found[[0, 1, 4]]).all()
    assert np.isfinite(found[[2, 3]]).all()


def test_closest_points_of_crossing_skew_and_parallel_rays():
    origins_a = np.zeros((3, 3))
    dirs_a = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])
    origins_b = np.array([[1.0, 0, 2], [1, 0.5, -3], [1, 0, 0]])
    dirs_b = np.array([[-1.0, 0, 0], [-1, 0, 0], [0, 0, 1]])
    middle, ranges, gaps = closest_points(origins_a, dirs_a, origins_b, dirs_b)
    np.testing.assert_allclose(middle[:2], [[0, 0, 2], [0, 0.25, -3]], atol=1e-15)
    # The second pair meets behind the first camera: its range says so.
    np.testing.assert_allclose(ranges[:2], [[2, 1], [-3, 1]], atol=1e-15)
    np.testing.assert_allclose(gaps[:2], [0, 0.5], atol=1e-15)
    assert np.isnan(middle[2]).all() and np.isnan(gaps[2])


def test_widest_angle_of_a_point_is_measured_from_its_first_ray():
    angles = np.radians([0.0, 1e-7, 30.0, 10.0])
    dirs = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    found = max_ray_angles(dirs, [0, 0, 1, 1], 3)
    # Tiny angles keep their digits: arctan2, not arccos.
    np.testing.assert_allclose(found, np.radians([1e-7, 20.0, 0.0]), rtol=1e-8)
