"""`calibrate` against another solver, its own statistics, and far starts."""

from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from uwsfm import calibrate
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.residuals.border import BORDER_SIZE, WATER_INDEX
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion


def _own_residuals(start):
    """The problem written anew: rotation vectors, angles, public cameras only."""
    num_frames, num_points = start.num_frames, start.num_points
    frames0 = Rotation.from_quat(start.rig_from_world[:, :4])
    baseline = np.linalg.norm(start.cam_from_rig[1, 4:])

    def scene_of(x):
        turns, shifts, rig, normals, dists, points = np.split(
            x, np.cumsum([3 * num_frames - 3, 3 * num_frames - 3, 5, 4, 2])
        )
        frames = start.rig_from_world.copy()
        frames[1:, :4] = (
            frames0[1:] * Rotation.from_rotvec(turns.reshape(-1, 3))
        ).as_quat()
        frames[1:, 4:] = shifts.reshape(-1, 3)
        azimuth, height = rig[3:]
        direction = [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth)]
        shift = baseline * np.array([*direction, np.sin(height)])
        cams = start.cam_from_rig.copy()
        cams[1] = [*Rotation.from_rotvec(rig[:3]).as_quat(), *shift]
        cameras = tuple(
            camera.with_port(
                replace(
                    camera.port,
                    normal=(a, b, np.sqrt(1.0 - a * a - b * b)),
                    distance=distance,
                )
            )
            for camera, (a, b), distance in zip(
                start.cameras, normals.reshape(2, 2), dists, strict=True
            )
        )
        return replace(
            start,
            cameras=cameras,
            cam_from_rig=cams,
            rig_from_world=frames,
            points=points.reshape(num_points, 3),
        )

    shift = start.cam_from_rig[1, 4:]
    x0 = np.concatenate(
        [
            np.zeros(3 * num_frames - 3),
            start.rig_from_world[1:, 4:].ravel(),
            Rotation.from_quat(start.cam_from_rig[1, :4]).as_rotvec(),
            [np.arctan2(shift[1], shift[0]), np.arcsin(shift[2] / baseline)],
            np.ravel([port.normal[:2] for port in start.ports]),
            [port.distance for port in start.ports],
            start.points.ravel(),
        ]
    )
    return scene_of, x0


def test_scipy_reaches_the_same_optimum():
    scene = small_scene(4, 30, noise_px=0.2).scene
    start = perturbed(scene, Perturbation(distance_scale=0.8))
    result = calibrate(start, loss="l2")
    scene_of, x0 = _own_residuals(start)
    other = least_squares(
        lambda x: scene_of(x).residuals().ravel(),
        x0,
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-14,
        gtol=1e-12,
    )
    ours = 0.5 * np.sum(result.scene.residuals() ** 2)
    # Both stop where the cost falls by less than 1e-9 of itself.
    assert ours == pytest.approx(other.cost, rel=1e-8)
    found = scene_of(other.x)
    for camera, stddev in enumerate(result.covariance.cameras):
        gap = result.scene.ports[camera].distance - found.ports[camera].distance
        # A cost 1e-9 above the minimum is 1e-4 of a standard deviation away.
        assert abs(gap) < 1e-3 * stddev.distance_stddev_m
        angle = unit_vector.angle_between(
            result.scene.ports[camera].normal, found.ports[camera].normal
        )
        assert np.degrees(angle) < 1e-3 * stddev.normal_stddev_deg


def _border_errors(result, truth):
    """Errors of the border's parameters in their tangents, in its column order."""
    cols = result.covariance.border_cols
    errors = np.zeros(cols.max() + 1)
    for c in range(len(cols)):
        pose, true_pose = result.scene.cam_from_rig[c], truth.cam_from_rig[c]
        port, true_port = result.scene.ports[c], truth.ports[c]
        turn = rigid3.compose(pose, rigid3.inverse(true_pose))[:4]
        true_dir = true_pose[4:] / 0.2
        values = [
            *rigid3.rotvec_from_quat(turn),
            *(
                unit_vector.tangent_basis(true_dir if c else (0, 0, 1)).T
                @ pose[4:]
                / 0.2
            ),
            0.0,
            *(unit_vector.tangent_basis(true_port.normal).T @ port.normal),
            port.distance - true_port.distance,
            *np.zeros(BORDER_SIZE - WATER_INDEX),
        ]
        free = cols[c] >= 0
        errors[cols[c][free]] = np.array(values)[free]
    return errors


def _spread(covariance, errors):
    """Mean of e^T C^-1 e over the degrees of freedom: one, if the covariance holds."""
    whitened = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.sum(errors * whitened, axis=-1).mean() / errors.shape[-1]


def test_covariances_are_the_spread_of_the_estimates():
    truth = small_scene(8, 150).truth
    rng = np.random.default_rng(2011)
    runs, z, border, frames, points, crb = 100, [], [], [], [], []
    for _ in range(runs):
        noisy = replace(truth, xy=truth.xy + 0.3 * rng.normal(size=truth.xy.shape))
        result = calibrate(perturbed(noisy), loss="l2")
        covariance, errors = result.covariance, _border_errors(result, truth)
        stddevs = np.sqrt(np.diag(covariance.border))
        z.append(errors / stddevs)
        crb.append(stddevs)
        border.append(_spread(covariance.border, errors))
        change = rigid3.compose(
            result.scene.rig_from_world, rigid3.inverse(truth.rig_from_world)
        )
        tangents = np.concatenate(
            [rigid3.rotvec_from_quat(change[:, :4]), change[:, 4:]], axis=1
        )
        frames.append(_spread(covariance.frames[1:], tangents[1:]))
        points.append(_spread(covariance.points, result.scene.points - truth.points))
    z, num = np.array(z), len(z[0])
    assert num == 11
    # Standard errors of 100 runs: of a mean 0.1, of a standard deviation 0.07.
    assert np.abs(z.mean(axis=0)).max() < 0.35
    assert z.std(axis=0).min() > 0.78 and z.std(axis=0).max() < 1.25
    # RMSE over the Cramer-Rao bound.
    ratio = np.sqrt(np.mean(z**2))
    assert 0.9 < ratio < 1.1
    # chi^2 with 11 degrees of freedom, 100 times: 3 sqrt(2 / 1100) = 0.13. Frames and
    # points share the border's errors: about 100 independent runs of a few freedoms.
    assert abs(np.mean(border) - 1.0) < 0.13
    assert abs(np.mean(frames) - 1.0) < 0.15
    assert abs(np.mean(points) - 1.0) < 0.05


def start_off(scene, degrees, distance_scale, rng):
    """Normals off by an angle in a random direction, distances by a factor."""
    cameras = []
    for camera in scene.cameras:
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        step = np.radians(degrees) * np.array([np.cos(azimuth), np.sin(azimuth)])
        port = replace(
            camera.port,
            normal=tuple(unit_vector.plus(camera.port.normal, step)),
            distance=distance_scale * camera.port.distance,
        )
        cameras.append(camera.with_port(port))
    return replace(scene, cameras=tuple(cameras))


def _check_basin(scene, degrees, damping, rng):
    """All starts end in the optimum that the true start ends in."""
    best = calibrate(scene)
    off = Perturbation(
        straight_ports=False,
        distance_scale=1.0,
        rotation_stddev_deg=1.0,
        translation_stddev=0.02,
        cam_rotation_stddev_deg=1.0,
        baseline_direction_stddev_deg=1.0,
        point_stddev=0.05,
    )
    for distance_scale in (0.1, 1.0, 10.0):
        start = start_off(perturbed(scene, off), degrees, distance_scale, rng)
        result = calibrate(start, initial_damping=damping)
        for camera, stddev in enumerate(best.covariance.cameras):
            gap = (
                result.scene.ports[camera].distance - best.scene.ports[camera].distance
            )
            # A few observations at the edge of pruning may differ.
            assert abs(gap) < 0.2 * stddev.distance_stddev_m
        assert result.summary.rms_px == pytest.approx(best.summary.rms_px, rel=0.01)


def test_normals_20_degrees_off_and_distances_tenfold_converge(rng):
    for seed in range(2):
        scene = small_scene(8, 150, noise_px=0.3, seed=seed).scene
        _check_basin(scene, 20.0, 1e-4, rng)


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "damping"), [(20.0, 1e-4), (30.0, 1e-2)])
def test_basin_of_convergence(degrees, damping, rng):
    for seed in range(20):
        scene = simulate_scene(
            paper_rig(),
            rich_motion(15),
            Relief(stddev=0.2, seed=seed),
            ObservationOptions(num_points=300, noise_px=0.3, seed=seed),
        ).scene
        _check_basin(scene, degrees, damping, rng)
