"""Standard deviations that hold when the errors of neighbouring features are shared."""

from dataclasses import replace

import numpy as np

from uwsfm import calibrate
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

RUNS = 24


def dive(noise_px=0.0):
    """Twelve frames: 96 quarters of images, which is enough to learn from."""
    options = ObservationOptions(num_points=300, noise_px=noise_px)
    return simulate_scene(sample_rig(), rich_motion(12), Relief(stddev=0.2), options)


def test_shared_errors_are_seen(rng):
    """Errors of 0.1 px alone, and 0.1 px shared by each quarter of each image.

    Taken for independent noise, they would promise far too much.
    """
    truth = dive().truth
    half = np.array([[c.width, c.height] for c in truth.cameras])[truth.camera_idx] / 2
    tile = (truth.xy > half).astype(np.int64)
    errors, alone, reported = [], [], []
    for _ in range(RUNS):
        shared = rng.normal(0.0, 0.1, (2, truth.num_frames, 2, 2, 2))
        noise = rng.normal(0.0, 0.1, truth.xy.shape)
        noise += shared[truth.camera_idx, truth.frame_idx, tile[:, 0], tile[:, 1]]
        result = calibrate(replace(truth, xy=truth.xy + noise), loss="l2")
        for camera in (0, 1):
            col = result.covariance.border_cols[camera, 8]
            found = result.scene.ports[camera].distance
            errors.append(found - truth.ports[camera].distance)
            alone.append(np.sqrt(result.covariance.border[col, col]))
            reported.append(result.covariance.cameras[camera].distance_stddev_m)
    spread = np.sqrt(np.mean(np.square(errors)))
    # 48 errors, correlated in pairs: their RMS is known to about 15 %.
    assert spread > 1.5 * np.mean(alone)
    assert 0.6 < spread / np.mean(reported) < 1.5


def test_independent_errors_are_not_inflated():
    """The larger of two estimates of one number is larger by their own scatter only."""
    result = calibrate(dive(noise_px=0.2).scene, loss="l2")
    for camera in (0, 1):
        col = result.covariance.border_cols[camera, 8]
        alone = np.sqrt(result.covariance.border[col, col])
        reported = result.covariance.cameras[camera].distance_stddev_m
        assert alone <= reported < 1.4 * alone


def test_what_poses_took_of_shared_errors_is_given_back(rng):
    """Four frames: 24 numbers of poses against 64 of the quarters of images.

    Poses follow what their own quarters have in common. From the residuals alone, the
    spread is 1.14 times what is reported; 1.02 as it is (means of three such tests).
    """
    options = ObservationOptions(num_points=250)
    truth = simulate_scene(
        sample_rig(), rich_motion(4), Relief(stddev=0.2), options
    ).truth
    half = np.array([[c.width, c.height] for c in truth.cameras])[truth.camera_idx] / 2
    tile = (truth.xy > half).astype(np.int64)
    errors = []
    for _ in range(80):
        shared = rng.normal(0.0, 0.1, (2, truth.num_frames, 2, 2, 2))
        noise = rng.normal(0.0, 0.05, truth.xy.shape)
        noise += shared[truth.camera_idx, truth.frame_idx, tile[:, 0], tile[:, 1]]
        result = calibrate(replace(truth, xy=truth.xy + noise), loss="l2")
        for port, true, known in zip(
            result.scene.ports, truth.ports, result.covariance.cameras, strict=True
        ):
            angle = np.degrees(angle_between(port.normal, true.normal))
            errors.append(angle / known.normal_stddev_deg)
    # 160 angles, correlated in pairs: known to 6 %.
    assert 0.88 < np.sqrt(np.mean(np.square(errors))) < 1.13


def test_a_frame_that_one_quarter_holds_alone_has_finite_deviations():
    """Its pose hangs on the features of one quarter of one image."""
    truth = dive(noise_px=0.2).scene
    last = truth.frame_idx == truth.num_frames - 1
    corner = (truth.camera_idx == 0) & np.all(truth.xy < [400.0, 300.0], axis=1)
    part, _ = truth.select(~last | corner)
    counts = np.bincount(part.point_idx, minlength=part.num_points)
    part, _ = part.select(counts[part.point_idx] >= 2)
    assert 6 < np.count_nonzero(part.frame_idx == truth.num_frames - 1) < 100
    result, whole = calibrate(part, loss="l2"), calibrate(truth, loss="l2")
    for one, other in zip(
        result.covariance.cameras, whole.covariance.cameras, strict=True
    ):
        # 11 of 12 frames, and more of a chance to be raised.
        ratio = one.distance_stddev_m / other.distance_stddev_m
        assert 0.7 < ratio < 1.5
