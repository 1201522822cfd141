"""Deviations "in all": wrong given numbers by the hundred, priors, scale, coverage."""

from dataclasses import replace

import numpy as np
import pytest
from dense import dense_system, small_scene
from given_changes import scaled_accuracy, with_changes

from uwsfm import InputError, calibrate
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.calibration.given_errors import given_reach, in_all
from uwsfm.calibration.relinearized import reopened
from uwsfm.calibration.scale import scale_slope
from uwsfm.geometry import unit_vector
from uwsfm.residuals import border
from uwsfm.solver.layout import HELD

LENS_REFINED = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
}


def draw(accuracy, rng):
    """Errors (C, BORDER_SIZE) of everything that is given."""
    values, vectors = np.linalg.eigh(accuracy.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return (root @ rng.normal(size=len(root))).reshape(accuracy.assumed.shape)


def scale_error(found, truth):
    """Mean relative error of the distances between points, long ones first."""
    both = np.stack([found.points, truth.points])
    ours, theirs = both[:, np.isfinite(both).all(axis=(0, 2))]
    pairs = [np.linalg.norm(p[:, None] - p, axis=-1) for p in (ours, theirs)]
    return np.sum(pairs[0] * pairs[1]) / np.sum(pairs[1] ** 2) - 1.0


@pytest.mark.parametrize("hold", [{}, {"refine_cam_from_rig": False}])
def test_errors_over_deviations_in_all_are_one(hold, rng):
    """60 dives, each with noise and wrong given numbers of its own."""
    truth = small_scene(6, 80).truth
    accuracy = scaled_accuracy(truth, 0.15)
    scores = []
    for _ in range(60):
        noisy = truth.xy + 0.05 * rng.normal(size=truth.xy.shape)
        wrong = with_changes(replace(truth, xy=noisy), draw(accuracy, rng))
        result = calibrate(wrong, loss="l2", given=accuracy, **hold)
        known = in_all(result, given_reach(result))
        row = [scale_error(result.scene, truth) / known.scale_stddev]
        for port, true, camera in zip(
            result.scene.ports, truth.ports, known.cameras, strict=True
        ):
            row.append((port.distance - true.distance) / camera.distance_stddev_m)
            angle = np.degrees(unit_vector.angle_between(port.normal, true.normal))
            row.append(angle / camera.normal_stddev_deg)
        scores.append(row)
    ratio = np.sqrt(np.mean(np.square(scores), axis=0))
    # 60 draws know a standard deviation to 9 %, an RMS angle a little better.
    assert np.all((ratio > 0.75) & (ratio < 1.3)), ratio


def test_a_focal_length_that_is_too_long_is_in_the_deviation_if_its_accuracy_is():
    """Both lenses 0.5 % too long and known to 1 %: ports 15 mm off, far outside of what
    the images alone promise, and inside in all; lengths as well."""
    dive = small_scene(8, 120, noise_px=0.1)
    focal = slice(border.FIRST_LENS, border.FIRST_LENS + 2)
    changes = np.zeros((2, border.BORDER_SIZE))
    for c, camera in enumerate(dive.scene.cameras):
        changes[c, focal] = 0.005 * camera.lens[:2]
    covariance = 4.0 * np.diag(changes.ravel() ** 2)
    for c in range(2):  # fx and fy of a camera err together
        fx = c * border.BORDER_SIZE + border.FIRST_LENS
        both = 0.99 * np.sqrt(covariance[fx, fx] * covariance[fx + 1, fx + 1])
        covariance[fx, fx + 1] = covariance[fx + 1, fx] = both
    given = GivenAccuracy(covariance=covariance, assumed=np.zeros((2, 25), dtype=bool))
    wrong = with_changes(dive.scene, changes)
    result, budget = with_budget(calibrate(wrong, given=given, loss="l2"))
    known = result.covariance
    for port, true, own, in_all_of in zip(
        result.scene.ports,
        dive.truth.ports,
        known.cameras,
        known.in_all.cameras,
        strict=True,
    ):
        error = abs(port.distance - true.distance)
        assert error > 4.0 * own.distance_stddev_m
        assert error < 2.0 * in_all_of.distance_stddev_m
    error = abs(scale_error(result.scene, dive.truth))
    assert error < 2.0 * known.in_all.scale_stddev
    row = next(r for r in budget if r.name == "focal length, all cameras alike")
    assert row.amount == "+0.995 %" and not row.assumed  # of the lens as given


def correlated(scene):
    """Lenses as a calibration leaves them: strongly correlated, the cameras too."""
    accuracy = scaled_accuracy(scene, 0.1)  # ports stay in front of cameras
    stddevs = accuracy.stddevs
    mixing = np.random.default_rng(3).normal(size=(50, 50))
    mixed = mixing @ mixing.T
    spread = np.sqrt(np.diag(mixed))
    covariance = mixed / np.outer(spread, spread)
    covariance *= np.outer(stddevs.ravel(), stddevs.ravel())
    return replace(accuracy, covariance=covariance, correlated_prior=True)


def test_a_correlated_prior_is_that_of_dense_algebra():
    """Optimum and covariance with lenses refined, against one dense matrix."""
    scene = small_scene(4, 30, noise_px=0.2).scene
    given = correlated(scene)
    result = calibrate(scene, loss="l2", given=given, **LENS_REFINED)
    optimum = reopened(result)
    columns, sigma = optimum.columns, optimum.sigma_px
    jac, residuals = dense_system(result.scene, optimum.layout)
    slots = np.argwhere(columns[:, border.FIRST_LENS :] != HELD)
    slots[:, 1] += border.FIRST_LENS
    assert len(slots) == 16
    information = sigma**2 * np.linalg.inv(given.block(slots))
    at = optimum.layout.num_frame_cols + columns[tuple(slots.T)]
    miss = np.array(
        [
            result.scene.cameras[c].lens[s - 13] - scene.cameras[c].lens[s - 13]
            for c, s in slots
        ]
    )
    normal, gradient = jac.T @ jac, jac.T @ residuals
    normal[np.ix_(at, at)] += information
    gradient[at] += information @ miss
    norms = np.sqrt(np.diag(normal))
    dense = np.linalg.inv(normal / np.outer(norms, norms)) / np.outer(norms, norms)
    inside = slice(
        optimum.layout.num_frame_cols,
        optimum.layout.num_frame_cols + optimum.layout.num_camera_cols,
    )
    expected = sigma**2 * dense[inside, inside]
    spread = np.sqrt(np.diag(expected))
    gap = (result.covariance.border - expected) / np.outer(spread, spread)
    assert np.abs(gap).max() < 1e-5  # a scaled matrix of condition 1e8
    # At the optimum nothing is left to do: steps are far below the deviations. The
    # prior was weighed by the noise of the robust solve, which is a few per cent off.
    step = -(dense @ gradient)[inside]
    assert np.abs(step / spread).max() < 0.1


def test_a_correlated_prior_and_what_is_held_err_together(rng):
    """Focal length with a prior, the rest of the lens held: their errors are drawn
    from one covariance, and the deviation in all counts their correlation."""
    truth = small_scene(6, 80).truth
    given = correlated(truth)
    scores = []
    for _ in range(30):
        noisy = truth.xy + 0.05 * rng.normal(size=truth.xy.shape)
        wrong = with_changes(replace(truth, xy=noisy), draw(given, rng))
        result = calibrate(wrong, loss="l2", given=given, refine_focal=True)
        known = in_all(result, given_reach(result))
        scores.append(
            [
                (port.distance - true.distance) / camera.distance_stddev_m
                for port, true, camera in zip(
                    result.scene.ports, truth.ports, known.cameras, strict=True
                )
            ]
        )
    ratio = np.sqrt(np.mean(np.square(scores), axis=0))
    # 30 draws know a standard deviation to 13 %.
    assert np.all((ratio > 0.65) & (ratio < 1.4)), ratio


def test_a_lens_has_one_prior():
    scene = small_scene(4, 25).scene
    given = correlated(scene)
    with pytest.raises(InputError, match="lens_prior: correlated, which is a prior"):
        calibrate(scene, given=given, refine_focal=True, focal_stddev=1e-3)


def test_the_scale_is_that_of_the_dense_normal_matrix():
    result = calibrate(small_scene(5, 40, noise_px=0.2).scene, loss="l2")
    optimum = reopened(result)
    jac, _ = dense_system(result.scene, optimum.layout)
    norms = np.linalg.norm(jac, axis=0)
    dense = np.linalg.inv((jac / norms).T @ (jac / norms)) / np.outer(norms, norms)
    first = optimum.layout.num_frame_cols + optimum.layout.num_border_cols
    alone = np.array(
        [
            np.linalg.inv(block.T @ block)
            for block in (
                jac[:, first + 3 * p : first + 3 * p + 3]
                for p in range(result.scene.num_points)
            )
        ]
    )
    slope = scale_slope(result.scene.points, alone).ravel()
    expected = optimum.sigma_px * np.sqrt(slope @ dense[first:, first:] @ slope)
    # The reported one is the larger of two; neighbours' errors are independent here,
    # and 20 clusters know their variance to a third.
    assert 0.999 * expected < result.covariance.scale_stddev < 1.6 * expected


def test_the_scale_is_a_property_of_lengths():
    """Turned, moved, and weighed: an error of all lengths alike is one of the scale."""
    points = np.random.default_rng(1).normal(size=(50, 3)) + 7.0
    own = np.random.default_rng(2).uniform(0.1, 5.0, size=50)[:, None, None] * np.eye(3)
    slope = scale_slope(points, own)
    assert np.sum(slope * 0.01 * points) == pytest.approx(0.01)
    assert np.sum(slope, axis=0) == pytest.approx(0.0, abs=1e-12)
    turned = np.cross([0.1, -0.2, 0.3], points)
    assert np.sum(slope * turned) == pytest.approx(0.0, abs=1e-12)


def resting(noise_px, rng, num_copies=6):
    """A rig at rest: copies of one pair of images, each with noise of its own."""
    truth = small_scene(4, 300).truth
    pair, _ = truth.select(truth.frame_idx == 0)
    both = np.bincount(pair.point_idx) == 2  # one camera alone has no parallax here
    pair, _ = pair.select(both[pair.point_idx])
    count = pair.num_observations
    pixels = np.tile(pair.xy, (num_copies, 1))
    return pair, replace(
        pair,
        rig_from_world=np.repeat(pair.rig_from_world[:1], num_copies, axis=0),
        camera_idx=np.tile(pair.camera_idx, num_copies),
        frame_idx=np.repeat(np.arange(num_copies), count),
        point_idx=np.tile(pair.point_idx, num_copies),
        xy=pixels + noise_px * rng.normal(size=pixels.shape),
    )


def test_a_rig_at_rest_has_the_scale_of_its_points(rng):
    """Frames at one place: a distance between two of them would say nothing."""
    hold = {"refine_distances": False, "loss": "l2"}
    errors, reported = [], []
    for _ in range(20):
        pair, scene = resting(0.3, rng)
        result = calibrate(scene, **hold)
        errors.append(scale_error(result.scene, pair))
        reported.append(result.covariance.scale_stddev)
    assert max(reported) < 0.01
    # 20 draws know a standard deviation to 16 %; the reported one is the larger of two.
    assert 0.5 < np.sqrt(np.mean(np.square(errors) / np.square(reported))) < 1.4


def test_the_baselines_accuracy_is_in_the_scale():
    scene = small_scene(6, 60, noise_px=0.2).scene
    given = np.zeros((2, border.BORDER_SIZE))
    given[1, border.LENGTH] = 0.03 * 0.2  # 3 %
    accuracy = GivenAccuracy(
        covariance=np.diag(given.ravel() ** 2), assumed=np.zeros((2, 25), dtype=bool)
    )
    found, budget = with_budget(calibrate(scene, loss="l2", given=accuracy))
    assert found.covariance.in_all.scale_stddev == pytest.approx(0.03, rel=0.02)
    assert budget[0].name.startswith("baseline of") and budget[0].amount == "+6 mm"
    # With a prior of that accuracy, the images' own deviation holds it.
    prior = calibrate(scene, loss="l2", given=accuracy, baseline_stddev_m=0.006)
    assert prior.covariance.scale_stddev == pytest.approx(0.03, rel=0.02)
    assert with_budget(prior)[0].covariance.in_all.scale_stddev == pytest.approx(
        prior.covariance.scale_stddev, rel=1e-6
    )
