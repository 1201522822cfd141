"""What is known beforehand adds its information, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene
from test_mixed_ports import mixed_rig

from uwsfm import InputError, calibrate
from uwsfm.calibration.problem import PRIORS
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.geometry import unit_vector
from uwsfm.models.lens import param_slots, with_limit
from uwsfm.residuals import border
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.perturbations import perturbed
from uwsfm.simulate.rigs import paper_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

LENSES = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
}
EVERYTHING = {**LENSES, "refine_water_index": True}
KNOWN = {
    "distance_stddev_m": 0.002,
    "normal_stddev_deg": 0.05,
    "water_index_stddev": 5e-4,
    "focal_stddev": 3e-4,
    "principal_point_stddev_px": 0.3,
    "distortion_stddev": 1e-3,
}
OF_FLAT_PORTS = [name for name in PRIORS if name in KNOWN]
"""Those of the glass, which has a prior in any case, are in `test_glass`."""
FX, CX = border.FIRST_LENS, border.FIRST_LENS + 2
COLUMNS = {
    "distance_stddev_m": [border.DISTANCE],
    "normal_stddev_deg": [6, 7],
    "water_index_stddev": [border.WATER_INDEX],
    "focal_stddev": [FX, FX + 1],
    "principal_point_stddev_px": [CX, CX + 1],
    "distortion_stddev": [*range(CX + 2, border.BORDER_SIZE)],
}


def dive(rig, **options):
    observations = ObservationOptions(num_points=150, **options)
    return simulate_scene(rig, rich_motion(8), Relief(stddev=0.2), observations)


def information(covariance):
    """Inverse of the border's covariance, and the scale of its entries (B,)."""
    spread = np.sqrt(np.diag(covariance.border))
    inverse = np.linalg.inv(covariance.border / np.outer(spread, spread))
    inverse /= np.outer(spread, spread)
    return inverse, np.sqrt(np.diag(inverse))


@pytest.mark.parametrize("name", OF_FLAT_PORTS)
@pytest.mark.parametrize("rig", [paper_rig(), sample_rig()], ids=["one f", "fx, fy"])
def test_information_of_a_prior_adds_to_that_of_the_images(rig, name):
    scene = dive(rig).truth
    without = predict_covariance(scene, 0.3, **EVERYTHING)
    stddev = 10.0 * KNOWN[name]
    known = predict_covariance(scene, 0.3, **EVERYTHING, **{name: stddev})
    expected = np.zeros(len(without.border))
    for camera, cols in zip(scene.cameras, known.border_cols, strict=True):
        slots = param_slots(camera.camera.model_name)
        for k in COLUMNS[name]:
            in_model = k < FX or k - FX in slots  # one focal length is known once
            if cols[k] >= 0 and in_model:
                unit = {
                    "normal_stddev_deg": np.radians(1.0) / np.sqrt(2.0),
                    "focal_stddev": camera.lens[0 if k == FX else 1],
                }.get(name, 1.0)
                # The water is one: told to two cameras, it is still known once.
                expected[cols[k]] = 1.0 / (stddev * unit) ** 2
    assert np.any(expected > 0.0) or (name == "distortion_stddev" and len(slots) == 3)
    found, scale = information(known)
    before, _ = information(without)
    # The border's condition is 1e8 once scaled: 1e-16 of it, both ways.
    error = np.abs(found - before - np.diag(expected)) / np.outer(scale, scale)
    assert error.max() < 1e-6


@pytest.mark.parametrize("loss", ["l2", "cauchy"])
def test_estimates_move_to_the_prior_by_its_weight_against_the_noise(loss):
    """A Kalman update of the estimate without the prior; noise is 0.2 px, not 1."""
    scene = dive(sample_rig(), noise_px=0.2).scene
    free = calibrate(scene, loss=loss, prune_sigma=10.0)
    known = calibrate(scene, loss=loss, prune_sigma=10.0, distance_stddev_m=1e-3)
    covariance = free.covariance.border
    cols = free.covariance.border_cols[:, border.DISTANCE]
    stddevs = np.sqrt(np.diag(covariance)[cols])
    assert np.all((stddevs > 1e-3) & (stddevs < 4e-3))  # neither is much the stronger
    found = np.array([port.distance for port in free.scene.ports])
    innovation = covariance[np.ix_(cols, cols)] + 1e-6 * np.eye(2)
    gain = covariance[np.ix_(cols, cols)] @ np.linalg.inv(innovation)
    expected = found + gain @ (0.02 - found)
    updated = np.array([port.distance for port in known.scene.ports])
    assert np.abs(updated - found).max() > 0.3 * stddevs.min()
    # What is not linear over a standard deviation.
    np.testing.assert_allclose(updated, expected, rtol=0, atol=0.02 * stddevs.min())
    after = (
        covariance - covariance[:, cols] @ np.linalg.inv(innovation) @ covariance[cols]
    )
    spread = np.sqrt(np.diag(after))
    error = (known.covariance.border - after) / np.outer(spread, spread)
    assert np.abs(error).max() < 0.03


def values(scene):
    """What priors are about, per camera: distances, normals, water, lenses."""
    return {
        "distance_stddev_m": [port.distance for port in scene.ports],
        "normal_stddev_deg": [port.normal for port in scene.ports],
        "water_index_stddev": [port.n_water for port in scene.ports],
        "focal_stddev": [camera.lens[:2] / 600.0 for camera in scene.cameras],
        "principal_point_stddev_px": [camera.lens[2:4] for camera in scene.cameras],
        "distortion_stddev": [camera.lens[4:12] for camera in scene.cameras],
    }


@pytest.fixture(scope="module")
def noisy_start():
    """Everything off by some of the stddevs of KNOWN, in a dive with noise."""
    scene = small_scene(8, 150, noise_px=0.3).scene
    cameras = []
    for camera in scene.cameras:
        lens = camera.lens.copy()
        lens[:8] += [0.6, -0.6, 0.5, -0.5, 2e-3, 1e-3, 1e-4, 1e-4]
        port = replace(
            camera.port,
            normal=tuple(unit_vector.plus(camera.port.normal, [1e-3, 1e-3])),
            distance=0.022,
            n_water=1.3335,
        )
        cameras.append(camera.with_lens(with_limit(lens)).with_port(port))
    return replace(scene, cameras=tuple(cameras))


@pytest.mark.parametrize("name", OF_FLAT_PORTS)
def test_tight_priors_hold_and_loose_ones_do_nothing(noisy_start, name):
    # Water and lenses together are all but degenerate: see test_lens_refinement.
    water = name == "water_index_stddev"
    options = {"loss": "l2"} | ({"refine_water_index": True} if water else LENSES)
    free = calibrate(noisy_start, **options)
    start, found = values(noisy_start)[name], values(free.scene)[name]
    moved = np.abs(np.subtract(found, start)).max()
    stddev = np.degrees(moved) if name == "normal_stddev_deg" else moved
    tight = calibrate(noisy_start, **options, **{name: 1e-5 * stddev})
    loose = calibrate(noisy_start, **options, **{name: 1e4 * stddev})
    for result in (free, tight, loose):
        assert result.summary.converged and result.covariance.determined
    held = np.abs(np.subtract(values(tight.scene)[name], start)).max()
    assert held < 1e-6 * moved
    # Both stop at 1e-9 of their cost: 1e-3 of a standard deviation, about.
    gap = np.abs(np.subtract(values(loose.scene)[name], found)).max()
    assert gap < 1e-3 * moved


def test_priors_of_what_is_held_do_nothing(noisy_start):
    options = {"loss": "l2", "refine_normals": False, "refine_distances": False}
    plain = calibrate(noisy_start, **options)
    known = calibrate(noisy_start, **options, **KNOWN)
    assert known.summary.num_iterations == plain.summary.num_iterations
    assert known.summary.rms_px == plain.summary.rms_px
    np.testing.assert_array_equal(known.scene.points, plain.scene.points)
    np.testing.assert_array_equal(known.covariance.border, plain.covariance.border)


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_impossible_priors_are_refused(name, value):
    with pytest.raises(
        InputError, match=f"{name} must be positive and finite, got"
    ) as refused:
        predict_covariance(small_scene().scene, 0.3, **{name: value})
    assert "\n" not in str(refused.value)


def test_prior_of_a_dome_is_of_its_centre_only():
    """Slots of the centre are those of normal and distance: priors must not mix."""
    simulated = simulate_scene(
        mixed_rig(),
        rich_motion(8),
        Relief(stddev=0.2),
        ObservationOptions(num_points=150, noise_px=0.5),
    )
    start = perturbed(simulated.scene)  # the dome concentric, the flat port off
    free = calibrate(start, loss="l2")
    flat = {"distance_stddev_m": 1e-7, "normal_stddev_deg": 1e-4}
    tight = calibrate(start, loss="l2", center_stddev_m=1e-7)
    other = calibrate(start, loss="l2", **flat)
    centers = [np.array(r.scene.ports[1].center) for r in (free, tight, other)]
    assert np.linalg.norm(centers[0]) > 0.01
    assert np.linalg.norm(centers[1]) < 1e-5
    # The flat port held half as far away as it is pulls a little on the dome.
    assert np.linalg.norm(centers[2] - centers[0]) < 0.3 * np.linalg.norm(centers[0])
    distances = [r.scene.ports[0].distance for r in (tight, other)]
    assert abs(distances[1] - start.ports[0].distance) < 1e-5
    assert abs(distances[0] - start.ports[0].distance) > 1e-3
