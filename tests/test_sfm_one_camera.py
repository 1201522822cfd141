"""One camera, domes, and mixed rigs: the mappers find every frame."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive
from test_mixed_ports import mixed_rig
from test_sfm_mapping import center_errors

from uwsfm import DomePort, InputError, calibrate
from uwsfm.geometry import rigid3
from uwsfm.jobs.finish import start_scene
from uwsfm.rig.rig import Rig
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.perspective import StartArrays, read_start
from uwsfm.sfm.refine import refine_scene
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import nominal_rig, sample_rig

NUM_FRAMES = 6


def single(camera_idx: int = 0, rig: Rig | None = None) -> Rig:
    camera = (rig or sample_rig()).cameras[camera_idx]
    return Rig(cameras=(camera,), cam_from_rig=None, baseline_m=None)


def arrays_of(rig: Rig, truth_rig: Rig, work_dir, options: StartOptions) -> StartArrays:
    simulated = simulated_dive(truth_rig, num_frames=NUM_FRAMES)
    frames = frames_of(rig, NUM_FRAMES, work_dir)
    write_features(work_dir / "database.db", simulated.scene, frames, wrong=0.1)
    start = start_from_matches(rig, frames, Steps(work_dir), "", options)
    assert start.summary["num_registered_frames"] == NUM_FRAMES
    assert start.summary["warnings"] == []
    return read_start(start)


def shape_error(arrays: StartArrays, truth_rig: Rig) -> float:
    """RMS of the rig centres after the best similarity, by their extent."""
    truth = simulated_dive(truth_rig, num_frames=NUM_FRAMES).truth
    found = rigid3.inverse(arrays.rig_from_world)[:, 4:]
    true = rigid3.inverse(truth.rig_from_world)[:, 4:]
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = np.sum(values * np.diag(flip)) / np.sum(a * a)
    gap = scale * a @ (u @ flip @ vt).T - b
    return float(np.linalg.norm(gap) / np.linalg.norm(b))


@pytest.mark.parametrize("kind", ["flat", "dome"])
def test_one_camera_at_a_given_distance(tmp_path, kind):
    rig = single() if kind == "flat" else single(1, mixed_rig())
    options = StartOptions(num_threads=2, scene_distance_m=2.0, mapper="pinhole")
    arrays = arrays_of(nominal_rig(rig), rig, tmp_path, options)
    # Refraction at tilted ports bends the shape by a few per cent, no more.
    assert shape_error(arrays, rig) < 0.06
    depths = rigid3.transform(
        arrays.rig_from_world[arrays.frame_idx], arrays.points[arrays.point_idx]
    )[:, 2]
    # Set so by median depth; the virtual centre is some millimetres off the lens.
    assert np.median(depths) == pytest.approx(2.0, rel=0.02)


def test_domes_make_a_metric_start(tmp_path):
    rig = sample_rig()
    dome = DomePort((0.003, -0.002, 0.01), 0.06, 0.008, 1.5, 1.333)
    cameras = tuple(
        replace(camera, port=dome, refine_center=True) for camera in rig.cameras
    )
    rig = replace(rig, cameras=cameras)
    arrays = arrays_of(
        nominal_rig(rig), rig, tmp_path, StartOptions(num_threads=2, mapper="pinhole")
    )
    truth = simulated_dive(rig, num_frames=NUM_FRAMES).truth.rig_from_world
    moved = rigid3.compose(rigid3.inverse(truth[0]), arrays.rig_from_world[0])
    centers = rigid3.transform(moved, rigid3.inverse(arrays.rig_from_world)[:, 4:])
    gaps = np.linalg.norm(centers - rigid3.inverse(truth)[:, 4:], axis=1)
    assert gaps.max() < 0.06  # of a dive of 1.4 m, with domes 10 mm off their place


def test_scene_distance_is_a_length():
    for value in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="scene_distance_m must be positive"):
            StartOptions(scene_distance_m=value)


def test_a_rig_of_a_flat_port_a_dome_and_a_bare_lens_from_its_matches(tmp_path):
    """From a straight port at half its distance and a concentric dome, 10 mm off."""
    rig = mixed_rig()
    simulated = simulated_dive(rig, num_frames=NUM_FRAMES)
    start_rig = nominal_rig(rig)
    frames = frames_of(start_rig, NUM_FRAMES, tmp_path)
    write_features(tmp_path / "database.db", simulated.scene, frames, wrong=0.2)
    options = StartOptions(num_threads=2, mapper="refractive")
    start = start_from_matches(start_rig, frames, Steps(tmp_path), "", options)
    arrays = start.arrays()
    assert arrays.frame_names == frames.names
    found = refine_scene(start_scene(start_rig, start, arrays), start_rig)
    best = calibrate(simulated.scene, loss="l2")
    truth = simulated.truth.rig_from_world
    # Half of the wrong matches break a track; the rest of the data are the same.
    errors = [
        np.sqrt(np.mean(center_errors(scene.rig_from_world, truth) ** 2))
        for scene in (found.scene, best.scene)
    ]
    assert errors[0] < 2.0 * errors[1] < 0.01
    center, known = found.scene.ports[1].center, found.calibration.covariance.cameras[1]
    gap = np.array(center) - rig.cameras[1].port.center
    assert np.all(np.abs(gap) < 4.0 * np.array(known.center_stddev_m))
