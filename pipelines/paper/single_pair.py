"""Figure 6, left and right: port normals from one stereo pair, its distances assumed.

Rig and poses are known, the distances of the ports as well (left) or assumed wrongly
(right): points and normals are estimated, from normals along the optical axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from monte_carlo import (
    normal_errors_deg,
    rms,
    rms_ratio,
    run_all,
    straight_ports,
    warm_up,
)
from tables import Row, column, select

import uwsfm
from uwsfm._base.tasks import Workers
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.simulate import (
    ObservationOptions,
    Relief,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import level_poses

ERRORS = ("reprojection", "virtual_camera", "virtual_camera_tangential")
"""The error in space says nothing of one pair: for any ports, a point that is where its
two rays are nearest has no error at all. `uwsfm.calibrate` refuses it."""
NOISES_PX = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0)
TRUE_DISTANCE_MM = 20.0
DISTANCES_MM = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 60.0, 70.0)
NOISE_PX = 0.5
"""Of the runs with a wrong distance."""
NUM_POINTS = 300
CAMERAS = ("left", "right")
HELD: dict[str, Any] = {"refine_distances": False, "refine_cam_from_rig": False}
"""Only the normals and the points move."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One noisy stereo pair."""

    noise_px: float
    seed: int
    distances_mm: Sequence[float] = (TRUE_DISTANCE_MM,)
    num_points: int = NUM_POINTS


def simulate(task: Task) -> SimulatedScene:
    """One pair, 1.5 m above a floor between about 0.8 and 2.2 m away."""
    return simulate_scene(
        paper_rig(),
        level_poses([[0.0, 0.0, -1.5]]),
        Relief(stddev=0.25, seed=task.seed),
        ObservationOptions(
            num_points=task.num_points, noise_px=task.noise_px, seed=task.seed
        ),
    )


def solve(task: Task) -> list[Row]:
    """The errors of the normals, for each assumed distance and error function."""
    pair = simulate(task)
    unit_bound = predict_covariance(pair.truth, 1.0, **HELD)
    rows = []
    for distance_mm, error in product(task.distances_mm, ERRORS):
        options = {"error": error, "loss": "l2", **HELD}
        warm_up(**options)
        result = uwsfm.calibrate(straight_ports(pair.scene, distance_mm), **options)
        angles = normal_errors_deg(result.scene, pair.truth.ports)
        for camera, name in enumerate(CAMERAS):
            rows.append(
                {
                    "noise_px": task.noise_px,
                    "assumed_mm": distance_mm,
                    "error_function": error,
                    "camera": name,
                    "angle_deg": angles[camera],
                    "bound_deg": task.noise_px
                    * unit_bound.cameras[camera].normal_stddev_deg,
                    "converged": result.summary.converged,
                    "seconds": result.summary.solve_s,
                }
            )
    return rows


def noise_table(
    runs: int,
    workers: Workers,
    noises_px: Sequence[float] = NOISES_PX,
    num_points: int = NUM_POINTS,
) -> list[Row]:
    """Figure 6, left: per noise level, error function and camera."""
    tasks = [
        Task(noise_px=noise, seed=seed, num_points=num_points)
        for seed, (noise, _) in enumerate(product(noises_px, range(runs)))
    ]
    found = sum(run_all(solve, tasks, workers, "fig. 6 left"), [])
    rows = []
    for noise, error in product(noises_px, ERRORS):
        both = select(found, noise_px=noise, error_function=error)
        ratio, ratio_error = _pooled_ratio(both)
        for name in CAMERAS:
            mine = select(both, camera=name)
            angles = column(mine, "angle_deg")
            rows.append(
                {
                    "noise_px": noise,
                    "error_function": error,
                    "camera": name,
                    "mean_deg": float(np.mean(angles)),
                    "sd_deg": float(np.std(angles, ddof=1)),
                    "rmse_deg": rms(angles),
                    "max_deg": max(angles),
                    "bound_deg": rms(column(mine, "bound_deg")),
                    "rmse_over_bound_both": ratio,
                    "ratio_error": ratio_error,
                    "converged_percent": 100.0
                    * float(np.mean(column(mine, "converged"))),
                    "solve_median_s": float(np.median(column(mine, "seconds"))),
                    "runs": len(mine),
                }
            )
    return rows


def _pooled_ratio(rows: list[Row]) -> tuple[float | None, float | None]:
    """RMSE over bound of both cameras; the bound of exact data is zero."""
    if rows[0]["noise_px"] == 0.0:
        return None, None
    errors = np.reshape(column(rows, "angle_deg"), (-1, len(CAMERAS)))
    bounds = np.reshape(column(rows, "bound_deg"), (-1, len(CAMERAS)))
    return rms_ratio(errors, bounds)


def distance_table(
    runs: int,
    workers: Workers,
    distances_mm: Sequence[float] = DISTANCES_MM,
    num_points: int = NUM_POINTS,
) -> list[Row]:
    """Figure 6, right: both cameras together, per noise, error and distance."""
    tasks = [
        Task(
            noise_px=noise, seed=seed, distances_mm=distances_mm, num_points=num_points
        )
        for seed, (noise, _) in enumerate(product((0.0, NOISE_PX), range(runs)))
    ]
    found = sum(run_all(solve, tasks, workers, "fig. 6 right"), [])
    rows = []
    for noise, error, distance in product((0.0, NOISE_PX), ERRORS, distances_mm):
        mine = select(found, noise_px=noise, error_function=error, assumed_mm=distance)
        angles = column(mine, "angle_deg")
        rows.append(
            {
                "noise_px": noise,
                "error_function": error,
                "assumed_distance_mm": distance,
                "mean_deg": float(np.mean(angles)),
                "sd_deg": float(np.std(angles)),
                "max_deg": max(angles),
                "converged_percent": 100.0 * float(np.mean(column(mine, "converged"))),
                "runs": len(mine) // len(CAMERAS),
            }
        )
    return rows
