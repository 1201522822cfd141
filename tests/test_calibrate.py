"""`calibrate` end to end on synthetic dives: truth, statistics, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from bounds import assert_near_the_bound
from dense import small_scene
from jacobians import camera_from_line

from uwsfm import InputError, RefractiveCamera, calibrate
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import paper_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

RIGS = {"the paper's": paper_rig(), "wide lenses, thick glass": sample_rig()}

# After a perspective reconstruction: poses a degree, a centimetre and some off.
FAR_OFF = Perturbation(
    rotation_stddev_deg=1.0,
    translation_stddev=0.02,
    cam_rotation_stddev_deg=1.0,
    baseline_direction_stddev_deg=1.0,
    point_stddev=0.05,
)


def errors_of(scene, truth):
    """Largest errors: distances, centres and points in metres, angles in radians."""
    lengths, angles = [], []
    for port, true_port in zip(scene.ports, truth.ports, strict=True):
        lengths.append(port.distance - true_port.distance)
        angles.append(unit_vector.angle_between(port.normal, true_port.normal))
    for poses, true_poses in (
        (scene.rig_from_world, truth.rig_from_world),
        (scene.cam_from_rig, truth.cam_from_rig),
    ):
        change = rigid3.compose(poses, rigid3.inverse(true_poses))
        angles.extend(rigid3.rotation_angle(change))
        centres = rigid3.inverse(poses)[:, 4:] - rigid3.inverse(true_poses)[:, 4:]
        lengths.extend(centres.ravel())
    lengths.extend((scene.points - truth.points).ravel())
    return np.abs(lengths).max(), np.max(angles)


@pytest.mark.parametrize("loss", ["cauchy", "l2"])
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_exact_data_return_the_truth_from_the_papers_start(rig, loss):
    options = ObservationOptions(num_points=200)
    truth = simulate_scene(rig, rich_motion(8), Relief(stddev=0.2), options).truth
    start = perturbed(truth, FAR_OFF)  # normals (0, 0, 1), distances halved
    assert start.ports[0].normal == (0.0, 0.0, 1.0)
    assert start.ports[0].distance == pytest.approx(0.01)
    before = start.points.copy(), start.rig_from_world.copy(), start.ports
    result = calibrate(start, loss=loss)
    length, angle = errors_of(result.scene, truth)
    # Pixels are exact to 1e-12 px; distances are the softest, 1 mm per 0.1 px.
    assert length < 1e-9 and angle < 1e-10
    assert result.summary.converged and result.summary.rms_px < 1e-9
    assert result.summary.initial_rms_px > 5.0
    assert result.summary.num_invalid == result.summary.num_outliers == 0
    # Nothing changed in place.
    np.testing.assert_array_equal(start.points, before[0])
    np.testing.assert_array_equal(start.rig_from_world, before[1])
    assert start.ports == before[2]


def test_noise_is_found_and_the_truth_is_within_the_stddevs():
    simulated = simulate_scene(
        paper_rig(),
        rich_motion(10),
        Relief(stddev=0.2),
        ObservationOptions(num_points=400, noise_px=0.4),
    )
    result = calibrate(perturbed(simulated.scene, FAR_OFF))
    summary, truth = result.summary, simulated.truth
    assert summary.converged and summary.num_observations > 0.99 * len(truth.xy)
    num_unknowns = 6 * 9 + 11 + 3 * 400
    share = 1.0 - num_unknowns / (2 * len(truth.xy))
    assert summary.rms_px == pytest.approx(0.4 * np.sqrt(2.0 * share), rel=0.1)
    # 6000 degrees of freedom know sigma to 1 %; pruning at 3.5 sigma takes 0.7 %.
    assert summary.sigma_px == pytest.approx(0.4, rel=0.03)
    # 3.5 sigma is exceeded by exp(-3.5^2 / 2) = 0.2 % of Gaussian errors: 8 of 3700.
    assert 1 <= summary.num_outliers <= 20
    for camera, port in enumerate(truth.ports):
        stddev = result.covariance.cameras[camera]
        found = result.scene.ports[camera]
        assert abs(found.distance - port.distance) < 4 * stddev.distance_stddev_m
        tilt = np.degrees(unit_vector.angle_between(found.normal, port.normal))
        assert tilt < 4 * stddev.normal_stddev_deg
    assert_near_the_bound(result.covariance, truth, 0.4)
    assert len(result.inliers) == len(truth.xy)
    assert np.count_nonzero(~result.inliers) == summary.num_outliers


def test_baseline_is_held_and_is_the_only_source_of_scale():
    rig = paper_rig(thickness=0.0)  # even the known glass would tell a little
    options = ObservationOptions(num_points=150)
    truth = simulate_scene(rig, rich_motion(8), Relief(stddev=0.2), options).truth
    wrong = truth.cam_from_rig.copy()
    wrong[1, 4:] *= 1.01
    result = calibrate(replace(perturbed(truth), cam_from_rig=wrong), loss="l2")
    scene = result.scene
    assert np.linalg.norm(scene.cam_from_rig[1, 4:]) == pytest.approx(0.202, rel=1e-14)
    # Everything is 1 % larger, and no residual shows it.
    assert result.summary.rms_px < 1e-9
    distances = [port.distance for port in scene.ports]
    np.testing.assert_allclose(distances, 0.0202, rtol=1e-7)
    held = rigid3.inverse(scene.rig_from_world[0])[4:]
    np.testing.assert_allclose(
        scene.points - held, 1.01 * (truth.points - held), atol=1e-9
    )


@pytest.mark.parametrize("loss", ["cauchy", "l2"])
def test_baseline_prior_is_the_stddev_of_the_baseline(loss):
    """The images say nothing about it, whatever their noise: here 0.3 px."""
    scene = perturbed(small_scene(8, 150, noise_px=0.3).scene)
    result = calibrate(scene, loss=loss, baseline_stddev_m=0.002)
    covariance = result.covariance
    column = covariance.border_cols[1, 5]
    stddev = np.sqrt(covariance.border[column, column])
    assert stddev == pytest.approx(0.002, rel=1e-3)  # thick glass: a little is known
    assert covariance.cameras[1].translation_stddev_m[0] == pytest.approx(
        0.002, rel=0.01
    )
    assert np.linalg.norm(result.scene.cam_from_rig[1, 4:]) == pytest.approx(
        0.2, rel=1e-3
    )
    held = calibrate(scene, loss=loss)
    growth = np.square(
        [r.covariance.cameras[0].distance_stddev_m for r in (result, held)]
    )
    # 1 % of scale is 1 % of the distance: 0.2 mm, added in squares.
    scaled = 0.01 * held.scene.ports[0].distance
    assert growth[0] - growth[1] == pytest.approx(scaled**2, rel=0.1)


def test_water_index_is_refined_as_one_for_all_ports():
    truth = small_scene(8, 150).truth
    cameras = [c.with_port(replace(c.port, n_water=1.34)) for c in truth.cameras]
    start = perturbed(replace(truth, cameras=tuple(cameras)))
    result = calibrate(start, refine_water_index=True)
    for port in result.scene.ports:
        assert port.n_water == pytest.approx(1.333, abs=1e-9)
    assert errors_of(result.scene, truth)[0] < 1e-8


def test_waters_that_differ_are_refined_one_by_one():
    """A window into a tank beside one into the sea."""
    truth = small_scene(8, 150).truth
    seas = (1.333, 1.342)
    cameras = [
        c.with_port(replace(c.port, n_water=n))
        for c, n in zip(truth.cameras, seas, strict=True)
    ]
    truth = replace(truth, cameras=tuple(cameras))
    truth = replace(truth, xy=truth.projections()[0])
    for water in ((1.336, 1.337), (1.337, 1.337)):
        cameras = [
            c.with_port(replace(c.port, n_water=n))
            for c, n in zip(truth.cameras, water, strict=True)
        ]
        result = calibrate(
            perturbed(replace(truth, cameras=tuple(cameras))),
            refine_water_index=True,
            separate_water_index=water[0] == water[1],
        )
        found = [port.n_water for port in result.scene.ports]
        np.testing.assert_allclose(found, seas, atol=1e-8)


def test_outliers_are_found_and_the_result_is_close_to_the_clean_one():
    clean = small_scene(10, 300, noise_px=0.3)
    dirty = small_scene(10, 300, noise_px=0.3, outlier_ratio=0.15)
    good = calibrate(perturbed(clean.scene))
    result = calibrate(perturbed(dirty.scene))
    gross = np.linalg.norm(dirty.scene.xy - dirty.truth.xy, axis=1) > 10.0
    assert gross.mean() > 0.14
    assert not np.any(result.inliers & gross)
    assert np.mean(result.inliers[~dirty.is_outlier]) > 0.97
    assert result.summary.sigma_px == pytest.approx(0.3, rel=0.05)
    for camera, stddev in enumerate(good.covariance.cameras):
        found, expected = result.scene.ports[camera], good.scene.ports[camera]
        # The same noise on 85 % of the data: about 0.5 of a standard deviation.
        gap = abs(found.distance - expected.distance)
        assert gap < 2.0 * stddev.distance_stddev_m
        angle = unit_vector.angle_between(found.normal, expected.normal)
        assert np.degrees(angle) < 2.0 * stddev.normal_stddev_deg
        # Cramer-Rao with 15 % less data: at most 1.1, as the points lose views.
        spread = result.covariance.cameras[camera]
        ratio = spread.distance_stddev_m / stddev.distance_stddev_m
        assert 0.95 < ratio < 1.2


def test_observations_that_stay_impossible_are_counted_not_lost():
    scene = small_scene(6, 80, noise_px=0.2).scene
    points = scene.points.copy()
    points[7] = [0.0, 0.0, -50.0]  # above the rig, out of reach of any step
    lost = np.count_nonzero(scene.point_idx == 7)
    broken = replace(scene, points=points)
    least = calibrate(broken, loss="l2")
    assert least.summary.num_invalid == lost
    assert least.summary.sigma_px == pytest.approx(0.2, rel=0.1)
    robust = calibrate(broken)
    assert robust.summary.num_invalid == 0
    assert robust.summary.num_outliers >= lost
    assert not np.any(robust.inliers[scene.point_idx == 7])
    assert np.isnan(robust.scene.points[7]).all()
    total = robust.summary.num_observations + robust.summary.num_outliers
    assert total == scene.num_observations


def test_what_is_not_refined_does_not_move():
    scene = small_scene(6, 80, noise_px=0.2).scene
    result = calibrate(
        scene,
        refine_normals=(False, True),
        refine_distances=False,
        refine_cam_from_rig=False,
    )
    assert result.scene.ports[0] == scene.ports[0]
    assert result.scene.ports[1].distance == scene.ports[1].distance
    assert result.scene.ports[1].normal != scene.ports[1].normal
    np.testing.assert_array_equal(result.scene.cam_from_rig, scene.cam_from_rig)
    np.testing.assert_array_equal(
        result.scene.rig_from_world[0], scene.rig_from_world[0]
    )


def one_pair(scene):
    pair, _ = scene.select(scene.frame_idx == 2)
    seen_twice = np.bincount(pair.point_idx)[pair.point_idx] >= 2
    return pair.select(seen_twice)[0]


def test_normals_come_from_a_single_stereo_pair_but_no_distance_does():
    """The paper's first scenario: the rig is known, the distances are not refined."""
    simulated = small_scene(4, 300, noise_px=0.2)
    pair, truth = one_pair(simulated.scene), simulated.truth
    with pytest.raises(InputError, match="from 1 frame"):
        calibrate(pair)
    result = calibrate(pair, refine_distances=False, refine_cam_from_rig=False)
    for camera, stddev in enumerate(result.covariance.cameras):
        angle = unit_vector.angle_between(
            result.scene.ports[camera].normal, truth.ports[camera].normal
        )
        assert np.degrees(angle) < 4 * stddev.normal_stddev_deg < 4.0


def test_a_distance_that_comes_out_negative_is_held_at_zero_and_said_so():
    """A camera on its port: noise puts some estimates behind the camera."""
    held = 0
    for seed in range(4):
        scene = simulate_scene(
            paper_rig(distance=1e-5),
            rich_motion(6),
            Relief(stddev=0.2),
            ObservationOptions(num_points=80, noise_px=0.5, seed=seed),
        ).scene
        result = calibrate(scene, loss="l2")
        bounded = [stddev.distance_at_zero for stddev in result.covariance.cameras]
        for port, stddev in zip(
            result.scene.ports, result.covariance.cameras, strict=True
        ):
            assert stddev.distance_at_zero == (port.distance == 0.0)
            assert stddev.distance_at_zero == (stddev.distance_stddev_m == 0.0)
            assert port.distance >= 0.0
        if any(bounded):
            held += 1
            free = tuple(not zero for zero in bounded)
            again = calibrate(result.scene, loss="l2", refine_distances=free)
            # It is the optimum of the problem with those distances known to be zero.
            assert again.summary.rms_px == pytest.approx(
                result.summary.rms_px, rel=1e-9
            )
    assert held > 1  # of 4, each with 3 in 4 for one of two distances


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"robust": True}, "calibrate: .*'robust'"),
        ({"loss": "huber"}, "loss must be one of l2, cauchy, got 'huber'"),
        ({"loss_scale_px": 0.0}, "loss_scale_px must be positive"),
        ({"prune_sigma": -1}, "prune_sigma must be positive"),
        ({"initial_damping": np.nan}, "initial_damping must be positive"),
        ({"max_iterations": 0}, "max_iterations must be >= 1"),
        ({"baseline_stddev_m": -0.1}, "baseline_stddev_m must be >= 0"),
        ({"refine_normals": (True,)}, "refine_normals has 1 entries for 2 cameras"),
    ],
)
def test_unusable_options_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        calibrate(small_scene().scene, **options)


def test_unusable_scenes_are_refused():
    scene = small_scene().scene
    mono, _ = scene.select(scene.camera_idx == 0)
    mono = replace(mono, cameras=scene.cameras[:1], cam_from_rig=scene.cam_from_rig[:1])
    with pytest.raises(InputError, match="1 frame of one camera: there is no depth"):
        calibrate(mono.select(mono.frame_idx == 0)[0])
    together = replace(scene, cam_from_rig=np.stack([rigid3.IDENTITY] * 2))
    with pytest.raises(InputError, match=r"cam_from_rig\[1\] has no translation"):
        calibrate(together)
    unknown = replace(scene, points=np.where(np.arange(25)[:, None] == 3, np.nan, 1.0))
    with pytest.raises(InputError, match=r"points\[3\] is not finite"):
        calibrate(unknown)
    fisheye = camera_from_line("FISHEYE 800 600 400 401 400 300")
    odd = RefractiveCamera(fisheye, scene.ports[1])
    with pytest.raises(InputError, match="FISHEYE has no projection"):
        calibrate(replace(scene, cameras=(scene.cameras[0], odd)))
    few, _ = scene.select(scene.point_idx < 3)
    with pytest.raises(InputError, match="too few"):
        calibrate(few, loss="l2")
