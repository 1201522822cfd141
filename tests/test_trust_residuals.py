"""Residuals in bins, and the pinhole that they are compared with."""

from dataclasses import replace

import numpy as np
from sfm_scenes import simulated_dive

from uwsfm import NoPort
from uwsfm.simulate.rigs import sample_rig
from uwsfm.trust.central import fit_central
from uwsfm.trust.residuals import FEWEST, camera_residuals


def bare(scene):
    """The scene with lenses in the water, and observations that fit them exactly."""
    cameras = tuple(camera.with_port(NoPort()) for camera in scene.cameras)
    scene = replace(scene, cameras=cameras)
    pixels, valid = scene.projections()
    assert np.all(valid)
    return replace(scene, xy=pixels)


def test_a_port_without_refraction_is_a_pinhole():
    scene = simulated_dive(num_frames=3, num_points=300).scene
    port = replace(scene.ports[0], n_glass=1.0, n_water=1.0)
    camera = scene.cameras[0].with_port(port)
    mine = scene.camera_idx == 0
    points = scene.points_in_cam()[mine]
    xy, valid = camera.img_from_point(points)
    fit = fit_central(camera, points[valid], xy[valid])
    # What MINPACK's relative tolerance of 1e-8 leaves of a start that is exact.
    assert np.abs(fit.residuals(points[valid], xy[valid])).max() < 1e-5


def test_the_pattern_of_a_pinhole_vanishes_behind_the_port():
    scene = simulated_dive(num_frames=6, num_points=2000).truth
    noisy = replace(
        scene, xy=scene.xy + np.random.default_rng(0).normal(0.0, 0.3, scene.xy.shape)
    )
    for found in camera_residuals(noisy, ["left", "right"]):
        ours, theirs = found.refractive, found.pinhole
        # sqrt(2) 0.3 px of noise, known to 1 / sqrt(observations) of about a thousand.
        assert 0.40 < ours.rms_px < 0.45
        # Nothing but noise: its excess is the root of a difference around zero.
        assert ours.systematic_px < 0.06
        assert theirs.systematic_px > 2.0 * max(ours.systematic_px, 0.03)
        rms, most = found.least_central_px
        assert 0.0 < rms < most
        # Any pinhole with distortion is one of the cameras with a single centre.
        assert theirs.systematic_px > 0.5 * rms
        assert found.counts.sum() == np.count_nonzero(
            scene.camera_idx == ["left", "right"].index(found.name)
        )


def test_a_shift_of_all_pixels_is_systematic_and_noise_is_not(rng):
    scene = bare(simulated_dive(num_frames=6, num_points=2000).truth)
    shift = np.array([0.1, -0.05])
    noise = rng.normal(0.0, 0.3, scene.xy.shape)
    (found, _) = camera_residuals(replace(scene, xy=scene.xy - shift + noise), "ab")
    assert found.pinhole is None and found.least_central_px is None
    known = np.isfinite(found.refractive.cells_px[..., 0])
    assert np.all(found.counts[known] >= FEWEST)
    mean = found.refractive.cells_px[known].mean(axis=0)
    # Cells of about 25 observations, more than a hundred of them: 0.3 / sqrt(2500).
    np.testing.assert_allclose(mean, shift, atol=0.025)
    np.testing.assert_allclose(
        found.refractive.systematic_px, np.hypot(*shift), atol=0.04
    )


def test_profiles_are_positive_where_the_model_projects_too_far_out():
    """By 0.1, 0.2 and 0.3 px in the near, middle and far third of a camera's
    observations, and so much too far in for the other camera."""
    scene = bare(simulated_dive(num_frames=6, num_points=2000).truth)
    depth, xy = scene.points_in_cam()[:, 2], scene.xy.copy()
    by = np.zeros(len(xy))
    for c, sign in ((0, 1.0), (1, -1.0)):
        mine = scene.camera_idx == c
        limits = np.quantile(depth[mine], [1.0 / 3.0, 2.0 / 3.0])
        by[mine] = 0.1 * (1 + np.searchsorted(limits, depth[mine]))
        outwards = xy[mine] - scene.cameras[c].lens[2:4]
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        xy[mine] -= sign * by[mine][:, None] * outwards
    found = camera_residuals(replace(scene, xy=xy), ["left", "right"])
    for camera, sign in zip(found, (1.0, -1.0), strict=True):
        thirds = camera.refractive.by_radius
        assert [part.name for part in thirds] == ["near", "middle", "far"]
        for part, px in zip(thirds, (0.1, 0.2, 0.3), strict=True):
            known = np.isfinite(part.mean_px)
            # One or two observations at the limit of two thirds may be in the other.
            np.testing.assert_allclose(part.mean_px[known], sign * px, atol=0.01)
            assert known.any() and np.all(np.diff(part.at[known]) > 0.0)
        for half in camera.refractive.by_depth:
            known = np.isfinite(half.mean_px)
            at, mean = half.at[known], sign * half.mean_px[known]
            assert np.all(np.diff(at) > 0.0) and np.all(np.diff(mean) > -0.01)
            near, far = np.percentile(depth, [1.0, 99.0])
            assert near < at[0] < at[-1] < far  # metres
            assert mean[0] < 0.15 and mean[-1] > 0.25


def test_the_sample_rig_has_no_camera_without_observations():
    scene = simulated_dive(num_frames=3, num_points=300).scene
    only_left, _ = scene.select(scene.camera_idx == 0)
    found = camera_residuals(only_left, [c.name for c in sample_rig().cameras])
    assert [camera.name for camera in found] == ["left"]


def test_a_wrong_lens_is_told_from_a_wrong_port():
    scene = simulated_dive(num_frames=6, num_points=2000).truth
    (right, _) = camera_residuals(scene, ["left", "right"])
    assert right.freed is None and right.refractive.systematic_px < 1e-6
    lens = scene.cameras[0].lens.copy()
    lens[0] *= 1.003
    wrong = replace(scene, cameras=(scene.cameras[0].with_lens(lens), scene.cameras[1]))
    (found, _) = camera_residuals(wrong, ["left", "right"])
    # 0.3 % of an image whose corners are half its focal length away from its centre.
    assert 0.3 < found.refractive.systematic_px < 1.5
    assert found.refractive.systematic_px > found.pinhole.systematic_px
    # Exact but for the tolerance of the fit, as above.
    assert found.freed.rms_px < 1e-4
