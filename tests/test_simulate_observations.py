"""Simulated observations: exact without noise, and as noisy as asked for."""

import numpy as np
import pytest

from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import (
    nominal_rig,
    paper_rig,
    sample_rig,
    tilted_normal,
)
from uwsfm.simulate.trajectories import (
    lawn_mower,
    level_poses,
    rich_motion,
    straight_strip,
)

TRAJECTORIES = [
    pytest.param(straight_strip(), id="straight_strip"),
    pytest.param(lawn_mower(), id="lawn_mower"),
    pytest.param(rich_motion(), id="rich_motion"),
]


@pytest.mark.parametrize("rig_from_world", TRAJECTORIES)
@pytest.mark.parametrize("stddev", [0.0, 0.2])
def test_water_ray_of_a_noise_free_observation_passes_its_point(rig_from_world, stddev):
    simulated = simulate_scene(paper_rig(), rig_from_world, Relief(stddev=stddev))
    scene = simulated.truth
    origins, dirs = scene.water_rays()
    offsets = scene.points[scene.point_idx] - origins
    gaps = np.linalg.norm(np.cross(offsets, dirs), axis=1)
    assert gaps.max() < 1e-11  # metres; the projection is solved to about 1e-13
    assert np.all(np.sum(offsets * dirs, axis=1) > 0.0)


@pytest.mark.parametrize("rig_from_world", TRAJECTORIES)
def test_every_frame_and_camera_sees_points_inside_its_image(rig_from_world):
    scene = simulate_scene(paper_rig(), rig_from_world).scene
    assert np.all((scene.xy >= 0) & (scene.xy <= [1200, 900]))
    views = np.zeros((len(rig_from_world), 2), dtype=int)
    np.add.at(views, (scene.frame_idx, scene.camera_idx), 1)
    assert views.min() > 50
    assert np.bincount(scene.point_idx).min() >= 2
    assert scene.num_points == 800


def test_noise_and_outliers_are_as_asked():
    options = ObservationOptions(noise_px=0.4, outlier_ratio=0.15, num_points=2000)
    simulated = simulate_scene(paper_rig(), rich_motion(), options=options)
    error = simulated.scene.xy - simulated.truth.xy
    assert np.mean(simulated.is_outlier) == pytest.approx(0.15, abs=1e-4)
    inliers = error[~simulated.is_outlier]
    assert inliers.std() == pytest.approx(0.4, rel=0.03)  # 4 sigma of 20,000 values
    outliers = np.linalg.norm(error[simulated.is_outlier], axis=1)
    assert np.median(outliers) > 300  # anywhere in a 1200x900 image


def test_same_seed_same_scene_and_another_seed_another():
    first, same, other = (
        simulate_scene(
            paper_rig(),
            straight_strip(),
            options=ObservationOptions(noise_px=0.5, seed=seed, num_points=100),
        ).scene
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.xy, same.xy)
    np.testing.assert_array_equal(first.points, same.points)
    assert not np.array_equal(first.points, other.points)


def test_detection_rate_thins_the_tracks():
    full, thin = (
        simulate_scene(
            paper_rig(), rich_motion(), options=ObservationOptions(detection_rate=rate)
        ).scene
        for rate in (1.0, 0.5)
    )
    # More than half: points that lost all but one observation were replaced.
    assert 0.5 < thin.num_observations / full.num_observations < 0.65


def test_a_rig_that_looks_away_from_the_floor_is_an_error():
    # Level, but below the floor (z points down): the floor is behind the cameras.
    with pytest.raises(UwsfmError, match="does the rig look at the sea floor"):
        simulate_scene(
            paper_rig(),
            level_poses([[0.0, 0.0, 1.0]]),
            options=ObservationOptions(num_points=10),
        )


@pytest.mark.parametrize(
    ("build", "names"),
    [
        (lambda: ObservationOptions(outlier_ratio=1.5), "outlier_ratio"),
        (lambda: ObservationOptions(num_points=0), "num_points"),
        (lambda: ObservationOptions(noise_px=float("nan")), "noise_px"),
        (lambda: ObservationOptions(noise_px=float("inf")), "noise_px"),
        (lambda: ObservationOptions(seed=-1), "seed"),
        (lambda: Relief(stddev=-0.1), "stddev"),
        (lambda: Relief(stddev=float("inf")), "stddev"),
        (lambda: Relief(seed=-1), "seed"),
        (lambda: simulate_scene(paper_rig(), np.full((2, 7), np.nan)), "rig_from_wor"),
        (lambda: Relief(correlation_length=0.0), "correlation_length"),
    ],
)
def test_options_out_of_range_are_refused(build, names):
    with pytest.raises(InputError, match=names):
        build()


def test_relief_normals_are_the_gradient_of_its_depth(rng):
    relief = Relief(stddev=0.15, correlation_length=0.4, seed=3)
    xy, step = rng.uniform(-2, 2, size=(100, 2)), 1e-6
    slope = np.column_stack(
        [
            (relief.depth(xy + step * e) - relief.depth(xy - step * e)) / (2 * step)
            for e in np.eye(2)
        ]
    )
    normals = relief.normals(xy)
    # Central differences of values near 0.1 with a 1e-6 step are good to 1e-10.
    np.testing.assert_allclose(-normals[:, :2] / normals[:, 2:], slope, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_relief_has_its_standard_deviation_and_correlation():
    reliefs = [
        Relief(stddev=0.1, correlation_length=0.5, seed=seed) for seed in range(400)
    ]
    pairs = np.array([relief.depth([[0.0, 0.0], [0.5, 0.0]]) for relief in reliefs])
    # Of 400 samples, the standard error is 3.5 % of the stddev and 0.03-0.05 of the
    # correlation.
    np.testing.assert_allclose(pairs.std(axis=0), 0.1, rtol=0.12)
    assert np.corrcoef(pairs.T)[0, 1] == pytest.approx(np.exp(-0.5), abs=0.13)


def test_rich_motion_turns_tilts_and_changes_altitude():
    poses = rich_motion(14, altitude=1.2)
    height = -rigid3.inverse(poses)[:, 6]
    assert 1.8 < height.max() / height.min() <= 2.0
    axes = rigid3.rotate(rigid3.inverse(poses), [0.0, 0.0, 1.0])
    tilts = np.degrees(np.arccos(axes[:, 2]))
    assert tilts.max() > 15
    rolls = np.degrees(rigid3.rotation_angle(poses))
    assert np.histogram(rolls, bins=4, range=(0, 180))[0].min() >= 1


def test_a_level_rig_has_the_axes_of_the_world():
    pose = level_poses([[1.0, 2.0, -3.0]])[0]
    np.testing.assert_allclose(pose, [0, 0, 0, 1, -1, -2, 3], atol=1e-15)


def test_paper_rig_has_the_tilts_and_the_baseline_of_the_paper():
    rig = paper_rig(thickness=0.03)
    left, right = (np.array(item.port.normal) for item in rig.cameras)
    axis = np.array([0.0, 0.0, 1.0])
    assert np.degrees(angle_between(left, axis)) == pytest.approx(2.0)
    assert np.degrees(angle_between(right, axis)) == pytest.approx(1.0)
    assert np.degrees(np.arctan2(left[1], left[0])) == pytest.approx(40.0)
    assert np.degrees(np.arctan2(right[1], right[0])) == pytest.approx(-10.0)
    np.testing.assert_allclose(tilted_normal(2, 40), left, atol=1e-12)
    assert rig.baseline_m == 0.2
    np.testing.assert_allclose(
        rigid3.inverse(rig.cam_from_rig)[1, 4:], [0.2, 0, 0], atol=1e-15
    )


def test_nominal_rig_is_straight_at_half_the_distance_and_nothing_else():
    true, nominal = sample_rig(), nominal_rig(sample_rig())
    np.testing.assert_array_equal(true.cam_from_rig, nominal.cam_from_rig)
    for a, b in zip(true.cameras, nominal.cameras, strict=True):
        assert b.port.normal == (0.0, 0.0, 1.0)
        assert b.port.distance == 0.5 * a.port.distance == 0.01
        assert b.port.thickness == a.port.thickness
        np.testing.assert_array_equal(a.camera.params, b.camera.params)


def test_perturbed_keeps_gauge_and_baseline_and_moves_the_rest():
    scene = simulate_scene(paper_rig(), rich_motion()).scene
    start = perturbed(
        scene,
        Perturbation(
            rotation_stddev_deg=1.0,
            translation_stddev=0.02,
            cam_rotation_stddev_deg=0.5,
            baseline_direction_stddev_deg=2.0,
            point_stddev=0.05,
        ),
    )
    np.testing.assert_array_equal(start.rig_from_world[0], scene.rig_from_world[0])
    np.testing.assert_array_equal(start.cam_from_rig[0], rigid3.IDENTITY)
    assert np.linalg.norm(start.cam_from_rig[1, 4:]) == pytest.approx(0.2, abs=1e-15)
    assert angle_between(start.cam_from_rig[1, 4:], scene.cam_from_rig[1, 4:]) > 0.001
    turned = rigid3.compose(start.rig_from_world, rigid3.inverse(scene.rig_from_world))
    assert 0.5 < np.degrees(rigid3.rotation_angle(turned[1:])).mean() < 3.0
    moved = start.points - scene.points
    assert moved.std() == pytest.approx(0.05, rel=0.1)
    for port in start.ports:
        assert (port.normal, port.distance) == ((0.0, 0.0, 1.0), 0.01)
