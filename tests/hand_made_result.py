"""A calibration result made by hand: a small scene, and covariances that are chosen."""

import math
from dataclasses import replace

import numpy as np
from sfm_scenes import model_of

from uwsfm.calibration.lengths import LengthFit, PositionFit
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import (
    CalibrateSummary,
    CalibrationResult,
    CameraCovariance,
    Covariance,
    InAll,
    SolveHistory,
)
from uwsfm.colmap.model import Model
from uwsfm.models.ports.port import DomePort, FlatPort
from uwsfm.residuals import border
from uwsfm.scene import Scene
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

FRAMES, POINTS = 3, 12


def small_model(*, dome: bool = False) -> Model:
    """Three frames of a stereo rig with tilted ports, or with a dome on the right."""
    rig = sample_rig()
    if dome:
        left, right = rig.cameras
        port = DomePort(center=(0.002, -0.003, 0.004), radius=0.05, thickness=0.007)
        right = replace(right, port=port, refine_center=True, refine_normal=False)
        rig = replace(rig, cameras=(left, replace(right, refine_distance=False)))
    simulated = simulate_scene(
        rig,
        rich_motion(FRAMES),
        Relief(stddev=0.1),
        ObservationOptions(num_points=POINTS, noise_px=0.0),
    )
    return model_of(rig, simulated.truth)


def camera_covariance(start: float, **more) -> CameraCovariance:
    """Standard deviations that are all other numbers."""
    return CameraCovariance(
        **{
            "normal_stddev_deg": 0.041 * start,
            "distance_stddev_m": 0.00052 * start,
            "rotation_stddev_deg": 0.0163 * start,
            "translation_stddev_m": (7.1e-5 * start, 8.2e-5 * start, 9.3e-5 * start),
            "center_stddev_m": (1.4e-5 * start, 2.5e-5 * start, 3.6e-5 * start),
            "distance_at_zero": False,
            **more,
        }
    )


def result_of(scene: Scene, **more) -> CalibrationResult:
    """A result whose tilts and distances were refined, and nothing else."""
    columns = np.full((2, border.BORDER_SIZE), -1, dtype=np.int64)
    columns[0, border.NORMAL], columns[1, border.NORMAL] = (0, 1), (3, 4)
    columns[0, border.DISTANCE], columns[1, border.DISTANCE] = 2, 5
    variances = np.array([1.0, 4.0, 9.0, 16.0, 25.0, 36.0]) * 1e-8
    count = 2 * border.BORDER_SIZE
    in_all = InAll(
        cameras=(camera_covariance(3.0), camera_covariance(5.0)),
        border=np.diag(variances) + 3e-8 * np.eye(6),
        given=np.zeros((count, count)),
        frames=np.stack(
            [f * np.diag([1, 2, 3, 4, 5, 6]) * 1e-8 for f in range(FRAMES)]
        ),
        scale_stddev=0.021,
    )
    covariance = Covariance(
        border=np.diag(variances),
        border_cols=columns,
        frames=0.25 * in_all.frames,
        points=np.tile(np.diag([1e-6, 4e-6, 9e-6]), (scene.num_points, 1, 1)),
        cameras=(camera_covariance(2.0), camera_covariance(4.0)),
        determined=True,
        scale_stddev=0.013,
        in_all=in_all,
    )
    return CalibrationResult(
        **{
            "scene": scene,
            "inliers": np.ones(scene.num_observations, dtype=bool),
            "summary": solved(),
            "covariance": covariance,
            "options": CalibrateOptions(),
            **more,
        }
    )


def solved() -> CalibrateSummary:
    """What happened, each number another one."""
    history = SolveHistory(
        error="reprojection", loss="l2", num_observations=61, costs=(3.0, 2.0)
    )
    return CalibrateSummary(
        num_frames=3,
        num_points=12,
        num_observations=61,
        num_outliers=4,
        num_invalid=2,
        num_iterations=17,
        solves=(history,),
        converged=True,
        initial_rms_px=4.56,
        rms_px=0.54,
        mean_error_px=0.43,
        sigma_px=0.38,
        solve_s=1.5,
    )


def bars() -> LengthFit:
    """Two known lengths, of which the second came out 40 of its deviations too long."""
    return LengthFit(
        given_m=np.array([0.5003, 2.314]),
        stddevs_m=np.array([0.0004, 0.001]),
        found_m=np.array([0.4993, 2.354]),
    )


def positions() -> PositionFit:
    """Four positions, one of them left out; the rest miss by 3, 4 and 12 cm."""
    turn = np.diag([1e-4, 4e-4, 1e-4])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn
    covariance[3:, 3:] = np.diag([0.01, 0.04, 0.09]) ** 2
    return PositionFit(
        frame_idx=np.array([0, 1, 2, 3]),
        misses_m=np.array(
            [[0.03, 0, 0], [0, 0.04, 0], [9.0, 9.0, 9.0], [0, 0, 0.12]], dtype=float
        ),
        inliers=np.array([True, True, False, True]),
        scatter=1.5,
        covariance=covariance,
    )


def leaning(x, y):
    parts = [math.sin(math.radians(angle)) for angle in (x, y)]
    return (*parts, math.sqrt(1.0 - sum(part**2 for part in parts)))


PORTS = (
    FlatPort(
        normal=leaning(2.0, -3.0),
        distance=0.02345,
        thickness=0.0081,
        n_glass=1.517,
        n_water=1.341,
    ),
    FlatPort(
        normal=leaning(-1.0, 4.0),
        distance=0.0317,
        thickness=0.0092,
        n_glass=1.492,
        n_water=1.342,
    ),
)


STEEP = FlatPort(normal=leaning(-40.0, 25.0), distance=0.03)


def with_ports(scene: Scene, ports=PORTS) -> Scene:
    pairs = zip(scene.cameras, ports, strict=True)
    return replace(scene, cameras=tuple(c.with_port(port) for c, port in pairs))
