"""Points of tracks that hold observations of other points."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.refine import MAX_ERROR_PX, MAX_START_ERROR_PX, refine_scene
from uwsfm.sfm.scene_points import (
    agreeing_points,
    good_observations,
    retriangulated,
)
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import straight_strip


@pytest.fixture(scope="module")
def truth() -> Scene:
    """Exact observations, at the true points."""
    return simulated_dive(num_points=300).truth


def counts_of(scene: Scene) -> np.ndarray:
    return np.bincount(scene.point_idx, minlength=scene.num_points)


def first_observations(scene: Scene, points: np.ndarray) -> np.ndarray:
    return np.array([np.flatnonzero(scene.point_idx == p)[0] for p in points])


def moved(scene: Scene, rows: np.ndarray, pixels: float) -> Scene:
    xy = scene.xy.copy()
    # Towards the middle, so that the pixel stays in its image.
    middle = np.array([(c.width, c.height) for c in scene.cameras]) / 2.0
    xy[rows] += pixels * np.sign(middle[scene.camera_idx[rows]] - xy[rows])
    return replace(scene, xy=xy)


def test_one_wrong_ray_does_not_move_the_point_of_its_track(truth):
    several = np.flatnonzero(counts_of(truth) >= 4)[:40]
    scene = moved(truth, first_observations(truth, several), 120.0)
    everything = np.ones(scene.num_observations, dtype=bool)
    found = agreeing_points(scene, everything, MAX_START_ERROR_PX)
    apart = np.linalg.norm(found.points - truth.points, axis=1)
    # Exact observations: what is left are steps of the refinement below 1e-6 of its
    # cost, which is a nearly exact zero.
    assert np.max(apart[several]) < 1e-6
    spoiled = retriangulated(scene, everything)
    assert np.min(np.linalg.norm(spoiled.points - truth.points, axis=1)[several]) > 1e-3


def test_a_track_of_two_halves_stays_as_it_is_intersected(truth):
    """As a late camera leaves it: to take one half would hide what is wrong."""
    four = np.flatnonzero(counts_of(truth) == 4)[:20]
    rows = np.concatenate([np.flatnonzero(truth.point_idx == p)[:2] for p in four])
    scene = moved(truth, rows, 120.0)
    everything = np.ones(scene.num_observations, dtype=bool)
    found = agreeing_points(scene, everything, MAX_ERROR_PX)
    intersected = retriangulated(scene, everything)
    np.testing.assert_array_equal(found.points[four], intersected.points[four])


def test_two_images_may_not_see_what_no_three_do(truth):
    """A wrong match along the epipolar line fits, at a distance that nothing has."""
    counts = counts_of(truth)
    wrong, right = np.flatnonzero(counts >= 3)[:40].reshape(2, -1)
    keep = np.ones(truth.num_observations, dtype=bool)
    for point in (*wrong, *right):  # two observations each are left
        keep[np.flatnonzero(truth.point_idx == point)[2:]] = False
    part, used = truth.select(keep)
    assert len(used) == truth.num_points
    # Half way to the rig that sees it first, as a disparity twice as large has it.
    points = part.points.copy()
    rows = first_observations(part, wrong)
    origins, _ = part.water_rays()
    points[wrong] = 0.5 * (points[wrong] + origins[rows])
    part = replace(part, points=points)
    pixels, valid = part.projections()
    assert np.all(valid)
    part = replace(part, xy=pixels)  # every observation fits its point exactly
    good = good_observations(part, MAX_ERROR_PX)
    mine = np.isin(part.point_idx, wrong)
    assert not np.any(good[mine])
    # Points of two images on the sea floor stay, but for those without parallax.
    assert np.mean(good[np.isin(part.point_idx, right)]) > 0.9


def test_few_points_show_no_range_of_distances(truth):
    """Where hardly any point has three images, two are believed as they are."""
    first = np.concatenate(
        [np.flatnonzero(truth.point_idx == p)[:2] for p in range(truth.num_points)]
    )
    keep = np.zeros(truth.num_observations, dtype=bool)
    keep[first] = True
    part, _ = truth.select(keep & (counts_of(truth)[truth.point_idx] >= 2))
    far = part.points.copy()
    origins, _ = part.water_rays()
    rows = first_observations(part, np.arange(10))
    far[:10] = 0.5 * (far[:10] + origins[rows])
    part = replace(part, points=far)
    pixels, _ = part.projections()
    good = good_observations(replace(part, xy=pixels), MAX_ERROR_PX)
    # Nearer points have more parallax, not less.
    assert np.all(good[np.isin(part.point_idx, np.arange(10))])


def strip() -> tuple[Scene, Rig, np.ndarray]:
    """A straight strip; 15 % of the observations are of another point."""
    rig = sample_rig()
    clean = simulate_scene(
        rig,
        straight_strip(10),
        Relief(stddev=0.1, correlation_length=0.4, seed=3),
        ObservationOptions(num_points=500, noise_px=0.4, detection_rate=0.6, seed=3),
    ).scene
    rng = np.random.default_rng(3)
    wrong = np.flatnonzero(rng.random(clean.num_observations) < 0.15)
    point_idx = clean.point_idx.copy()
    point_idx[wrong] = np.roll(point_idx[wrong], 1)
    is_wrong = point_idx != clean.point_idx
    # One point once in an image: of two, the later one is left out.
    image = 2 * clean.frame_idx + clean.camera_idx
    key = np.column_stack([image, point_idx])
    once = np.sort(np.unique(key, axis=0, return_index=True)[1])
    given = nominal_rig(rig)
    scene = replace(
        clean,
        cameras=given.refractive_cameras(),
        camera_idx=clean.camera_idx[once],
        frame_idx=clean.frame_idx[once],
        point_idx=point_idx[once],
        xy=clean.xy[once],
    )
    return scene, given, is_wrong[once]


def test_wrong_observations_of_a_strip_take_no_right_ones_with_them():
    scene, rig, wrong = strip()
    refined = refine_scene(scene, rig)
    kept = np.zeros(scene.num_observations, dtype=bool)
    kept[refined.kept] = True
    # A wrong one is within 4 px of an epipolar line that crosses 480 rows once in 60
    # times; of points of two images alone, which are an eighth.
    assert np.count_nonzero(kept & wrong) <= 0.01 * np.count_nonzero(wrong)
    right = np.bincount(scene.point_idx[~wrong], minlength=scene.num_points)
    most = right >= 0.75 * np.bincount(scene.point_idx, minlength=scene.num_points)
    usable = ~wrong & (most & (right >= 3))[scene.point_idx]
    # Of right ones, those beyond three standard deviations are pruned, and tracks of
    # four or fewer have a wrong one within their tolerance now and then.
    assert np.mean(kept[usable]) > 0.97
