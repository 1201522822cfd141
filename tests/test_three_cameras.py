"""Rigs of more than two cameras, each behind a port of its own."""

from dataclasses import replace

import numpy as np
from bounds import assert_near_the_bound

from uwsfm import FlatPort, calibrate
from uwsfm.colmap.model import Model, from_reconstruction, to_reconstruction
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.rig.rig import Rig
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def three_camera_rig() -> Rig:
    """The sample's rig, and a third camera 0.15 m below the reference, turned."""
    stereo = sample_rig()
    turn = rigid3.quat_from_rotvec([0.05, -0.02, 0.1])
    center = np.array([0.02, 0.15, 0.01])
    pose = np.concatenate([turn, -rigid3.rotate([*turn, 0, 0, 0], center)])
    third = replace(
        stereo.cameras[0],
        name="down",
        images="down",
        port=FlatPort((0.0, 0.02, np.sqrt(1 - 4e-4)), 0.03, 0.008, 1.49, 1.333),
    )
    return replace(
        stereo,
        cameras=(*stereo.cameras, third),
        cam_from_rig=np.vstack([stereo.cam_from_rig, pose]),
    )


def dive(noise_px: float = 0.0):
    return simulate_scene(
        three_camera_rig(),
        rich_motion(8),
        Relief(stddev=0.2),
        ObservationOptions(num_points=150, noise_px=noise_px),
    )


def test_three_housings_come_back_from_the_papers_start():
    simulated = dive()
    start = perturbed(simulated.scene, Perturbation(rotation_stddev_deg=0.5))
    result = calibrate(start, loss="l2")
    truth = simulated.truth
    for port, true_port in zip(result.scene.ports, truth.ports, strict=True):
        # Exact data: what the solver's last step leaves, as with two cameras.
        assert abs(port.distance - true_port.distance) < 1e-9
        assert unit_vector.angle_between(port.normal, true_port.normal) < 1e-9
    np.testing.assert_allclose(result.scene.cam_from_rig, truth.cam_from_rig, atol=1e-9)


def test_every_camera_has_its_own_uncertainty():
    simulated = dive(noise_px=0.3)
    result = calibrate(simulated.scene, loss="l2")
    ports = zip(result.scene.ports, simulated.truth.ports, strict=True)
    for (port, true_port), known in zip(ports, result.covariance.cameras, strict=True):
        # Four standard deviations: one in 16,000 by chance.
        error = abs(port.distance - true_port.distance)
        assert error < 4.0 * known.distance_stddev_m
    assert_near_the_bound(result.covariance, simulated.truth, 0.3)


def test_three_cameras_survive_colmap():
    scene = dive().scene
    keypoints = [[None] * scene.num_frames for _ in range(3)]
    keypoint_idx = np.zeros(scene.num_observations, dtype=np.int64)
    for camera in range(3):
        for frame in range(scene.num_frames):
            rows = np.nonzero(
                (scene.camera_idx == camera) & (scene.frame_idx == frame)
            )[0]
            keypoints[camera][frame] = scene.xy[rows]
            keypoint_idx[rows] = np.arange(len(rows))
    model = Model(
        rig=three_camera_rig(),
        scene=scene,
        frame_names=tuple(f"{i}.png" for i in range(scene.num_frames)),
        keypoints=tuple(map(tuple, keypoints)),
        keypoint_idx=keypoint_idx,
        colors=np.zeros((scene.num_points, 3), dtype=np.uint8),
    )
    again = from_reconstruction(to_reconstruction(model), model.rig)
    np.testing.assert_allclose(again.scene.cam_from_rig, scene.cam_from_rig, atol=1e-15)
    assert np.nanmax(again.errors_px()) < 1e-9  # the simulated data are exact
