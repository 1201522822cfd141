"""The error functions and strategies of `calibrate`: what each of them finds."""

from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene
from test_calibrate import FAR_OFF, one_pair

from uwsfm import CalibrateOptions, InputError, calibrate
from uwsfm.calibration.strategies import NestedLoops
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.geometry import unit_vector
from uwsfm.residuals import border
from uwsfm.simulate import Perturbation, perturbed
from uwsfm.solver import levenberg_marquardt as lm
from uwsfm.solver.layout import build_layout
from uwsfm.solver.state import State

SHEETS = ("virtual_camera", "virtual_camera_tangential")
METRIC = (*SHEETS, "point_3d")
OFF = Perturbation(
    distance_scale=1.0,
    rotation_stddev_deg=0.3,
    translation_stddev=0.005,
    cam_rotation_stddev_deg=0.2,
    baseline_direction_stddev_deg=0.3,
    point_stddev=0.01,
)


@pytest.mark.parametrize("error", METRIC)
def test_joint_with_known_distances_returns_the_true_normals(error):
    truth = small_scene(8, 100).truth
    start = perturbed(truth, OFF)
    result = calibrate(
        start, error=error, refine_distances=False, loss="l2", max_iterations=100
    )
    assert result.summary.converged and result.summary.initial_rms_px > 5.0
    # Distances in space bend: it creeps, and stops at 1e-9 of what is left.
    for port, true_port in zip(result.scene.ports, truth.ports, strict=True):
        assert port.distance == pytest.approx(true_port.distance, abs=1e-15)
        assert unit_vector.angle_between(port.normal, true_port.normal) < 1e-9
    assert result.summary.rms_px < 1e-6


@pytest.mark.parametrize("factor", [0.0, 0.5, 10.0])
@pytest.mark.parametrize("error", SHEETS)
def test_nested_loops_return_the_truth_from_far_distances(error, factor):
    """A long first step would pass zero, behind which other, false roots are."""
    truth = small_scene(8, 100).truth
    start = perturbed(truth, replace(FAR_OFF, distance_scale=factor))
    result = calibrate(start, strategy="nested", error=error, loss="l2")
    assert result.summary.converged
    for port, true_port in zip(result.scene.ports, truth.ports, strict=True):
        assert port.distance == pytest.approx(true_port.distance, rel=2e-5)
        # Of the wrong distance, 2e-5 of 20 mm, in a view 2 m deep.
        assert unit_vector.angle_between(port.normal, true_port.normal) < 1e-6


@pytest.mark.parametrize("error", SHEETS)
def test_nested_loops_end_near_the_joint_optimum_where_plain_repetition_would(error):
    gaps = []
    for seed in range(4):
        scene = small_scene(8, 150, noise_px=0.3, seed=seed).scene
        best = calibrate(perturbed(scene), loss="l2")
        found = calibrate(perturbed(scene), strategy="nested", error=error, loss="l2")
        assert found.summary.converged
        covariance = best.covariance
        stddevs = np.sqrt(np.diag(covariance.border))
        for camera, cols in enumerate(covariance.border_cols):
            ports = [r.scene.ports[camera] for r in (found, best)]
            gap = ports[0].distance - ports[1].distance
            gaps.append(gap / stddevs[cols[border.DISTANCE]])
            angle = unit_vector.angle_between(ports[0].normal, ports[1].normal)
            assert angle < 0.5 * np.linalg.norm(stddevs[cols[border.NORMAL]])
    # Measured over 40 runs: 0.16 (axis) and 0.22 (other sheet), none above 0.6.
    assert np.sqrt(np.mean(np.square(gaps))) < 0.35

    settings = CalibrateOptions(strategy="nested", error=error, loss="l2")
    columns = settings.border_columns(scene.cameras, np.zeros(2, dtype=bool))
    options = lm.LevenbergMarquardtOptions(error=error)
    loops = NestedLoops(build_layout(scene, columns), options)
    end = State.from_scene(found.scene)
    again, _ = loops.one_pass(end)
    # It is known to 1e-5, of which a pass takes half a per cent.
    np.testing.assert_allclose(again.ports[:, 3], end.ports[:, 3], rtol=1e-7)
    for factor in (0.9, 1.1):
        ports = end.ports.copy()
        ports[:, 3] *= factor
        nearer, _ = loops.one_pass(replace(end, ports=ports))
        left = (nearer.ports[:, 3] / end.ports[:, 3] - 1.0) / (factor - 1.0)
        assert 0.98 < left.mean() < 1.0


def test_nested_loops_leave_a_camera_without_observations_alone():
    scene = small_scene(6, 80, noise_px=0.3).scene
    idle = replace(
        scene,
        cameras=(*scene.cameras, scene.cameras[1]),
        cam_from_rig=np.vstack([scene.cam_from_rig, [0, 0, 0, 1, 0.1, 0.1, 0]]),
    )
    with_it = calibrate(idle, strategy="nested", loss="l2").scene
    without = calibrate(scene, strategy="nested", loss="l2").scene
    assert with_it.ports[2] == scene.ports[1]
    for port, expected in zip(with_it.ports, without.ports, strict=False):
        # Either search stops within 1e-5 of its own root.
        assert port.distance == pytest.approx(expected.distance, rel=1e-4)


@pytest.mark.parametrize("error", ["reprojection", *SHEETS])
def test_a_single_pair_reaches_the_bound_whatever_the_error(error):
    """The paper's fig. 6: normals from one stereo pair, all else known."""
    pair = one_pair(small_scene(4, 400).truth)
    assert 100 < pair.num_points < 300
    known = {"refine_distances": False, "refine_cam_from_rig": False}
    bound = predict_covariance(pair, 0.2, **known)
    rng = np.random.default_rng(2011)
    squares = []
    for _ in range(40):
        noisy = replace(pair, xy=pair.xy + 0.2 * rng.normal(size=pair.xy.shape))
        start = perturbed(noisy, Perturbation(distance_scale=1.0))
        found = calibrate(start, error=error, loss="l2", **known).scene
        squares.append(
            [
                unit_vector.angle_between(port.normal, true_port.normal) ** 2
                for port, true_port in zip(found.ports, pair.ports, strict=True)
            ]
        )
    rmse = np.degrees(np.sqrt(np.mean(squares, axis=0)))
    ratio = rmse / [camera.normal_stddev_deg for camera in bound.cameras]
    # 300 runs: 1.00 +- 0.03 for each. Here 80 numbers each: 0.08, up to 3.5 of them.
    assert np.all((ratio > 0.72) & (ratio < 1.3))


def test_error_in_space_leaves_out_what_one_camera_sees():
    scene = small_scene(6, 80).truth
    alone = scene.point_idx == 7  # seen by either camera, but never at the same time
    drop = alone & (scene.camera_idx != scene.frame_idx % 2)
    twice = np.flatnonzero(alone & ~drop)[:1]  # nor do two matches in an image help
    rows = np.append(np.flatnonzero(~drop), twice)
    columns = ("camera_idx", "frame_idx", "point_idx", "xy")
    scene = replace(scene, **{name: getattr(scene, name)[rows] for name in columns})
    start = perturbed(scene, replace(OFF, point_stddev=0.0))
    result = calibrate(start, error="point_3d", refine_distances=False, loss="l2")
    cells = scene.point_idx * scene.num_frames + scene.frame_idx
    shared = (np.bincount(cells)[cells] == 2) & (scene.point_idx != 7)
    assert 0 < np.count_nonzero(~shared) < 0.2 * len(shared)
    np.testing.assert_array_equal(result.inliers, shared)
    summary = result.summary
    assert summary.num_outliers == np.count_nonzero(~shared)
    assert summary.num_observations == np.count_nonzero(shared)
    assert np.isnan(result.scene.points[7]).all()
    assert np.isnan(result.covariance.points[7]).all()
    assert np.isfinite(np.delete(result.scene.points, 7, axis=0)).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"error": "point_3d", "strategy": "nested"}, "nested loops anywhere"),
        ({"error": "pixels"}, "error must be one of .*point_3d, got 'pixels'"),
        ({"strategy": "both"}, "strategy must be one of joint, nested, got 'both'"),
        *(({"error": name}, "hold the distances") for name in METRIC),
        ({"strategy": "nested", "refine_focal": True}, "refine_focal needs the repro"),
        (
            {
                "error": "point_3d",
                "refine_distances": False,
                "refine_distortion": True,
            },
            "refine_distortion needs the reprojection error",
        ),
        (
            {
                "error": "point_3d",
                "refine_distances": False,
                "baseline_stddev_m": 0.002,
            },
            "a free baseline shrinks: give baseline_stddev_m=0",
        ),
    ],
)
def test_what_an_error_cannot_determine_is_refused(options, words):
    with pytest.raises(InputError, match=words) as refused:
        calibrate(small_scene().scene, **options)
    assert "\n" not in str(refused.value)


def test_scenes_in_which_an_error_says_nothing_are_refused():
    scene = small_scene().scene
    known = {"refine_distances": False, "refine_cam_from_rig": False}
    with pytest.raises(InputError, match="'point_3d' tells nothing from 1 frame"):
        calibrate(one_pair(scene), error="point_3d", **known)
    bare = [replace(port, distance=0.0, thickness=0.0) for port in scene.ports]
    flat = tuple(c.with_port(p) for c, p in zip(scene.cameras, bare, strict=True))
    for error in SHEETS:
        with pytest.raises(InputError, match="camera 0 has no distance and no glass"):
            calibrate(replace(scene, cameras=flat), error=error, **known)
