"""Figure 7: normals and distances of both ports from many pairs, and how often.

As in the paper, the start is made by a perspective bundle adjustment of the noisy
observations; then the ports start straight and at 10 mm, and everything moves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from monte_carlo import (
    distance_errors_mm,
    normal_errors_deg,
    rms,
    rms_ratio,
    run_all,
    warm_up,
    z_scores,
)
from tables import Row, column, select

import uwsfm
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.calibration.problem import CalibrationResult
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.geometry import rigid3
from uwsfm.scene import Scene
from uwsfm.simulate import (
    ObservationOptions,
    Relief,
    SimulatedScene,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion

NOISES_PX = (0.0, 0.1, 0.25, 0.5, 1.0)
STRATEGIES = ("joint", "nested")
NUM_FRAMES = 15
NUM_POINTS = 800


@dataclass(frozen=True, kw_only=True)
class Case:
    """One block of the table."""

    name: str
    thickness_mm: float = 5.0
    outlier_ratio: float = 0.0
    noises_px: Sequence[float] = NOISES_PX
    strategies: Sequence[str] = STRATEGIES
    num_frames: int = NUM_FRAMES
    num_points: int = NUM_POINTS

    @property
    def loss(self) -> str:
        """Least squares are optimal for Gaussian noise, and lost with outliers."""
        return "cauchy" if self.outlier_ratio > 0.0 else "l2"


CASES = (
    Case(name="glass 5 mm"),
    Case(name="glass 30 mm", thickness_mm=30.0, strategies=("joint",)),
    Case(
        name="15 % outliers",
        outlier_ratio=0.15,
        noises_px=(0.5,),
        strategies=("joint",),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One dive over a sea floor of its own, with noise of its own."""

    case: Case
    noise_px: float
    seed: int


def simulate(task: Task) -> SimulatedScene:
    """15 pairs of a rich motion, 0.9 to 3.3 m from the floor."""
    case = task.case
    return simulate_scene(
        paper_rig(thickness=1e-3 * case.thickness_mm),
        rich_motion(case.num_frames),
        Relief(stddev=0.2, seed=task.seed),
        ObservationOptions(
            num_points=case.num_points,
            noise_px=task.noise_px,
            outlier_ratio=case.outlier_ratio,
            seed=task.seed,
        ),
    )


def start(scene: Scene) -> Scene:
    """What perspective Structure from Motion leaves, ports straight and at 10 mm."""
    return perturbed(perspective_adjustment(scene))


def solve(task: Task) -> list[Row]:
    """All that is measured of one dive, a row per strategy."""
    dive = simulate(task)
    # Of all observations, those that became outliers included: the clean bound.
    unit_bound = predict_covariance(dive.truth, 1.0)
    begin = start(dive.scene)
    rows = []
    for strategy in task.case.strategies:
        options = {"strategy": strategy, "loss": task.case.loss}
        warm_up(**options)
        result = uwsfm.calibrate(begin, **options)
        normal_z, distance_z = z_scores(result, dive.truth)
        rows.append(
            {
                "case": task.case.name,
                "noise_px": task.noise_px,
                "strategy": strategy,
                "normal_deg": normal_errors_deg(result.scene, dive.truth),
                "normal_bound_deg": [
                    task.noise_px * camera.normal_stddev_deg
                    for camera in unit_bound.cameras
                ],
                "normal_z": normal_z,
                "distance_mm": distance_errors_mm(result.scene, dive.truth),
                "distance_bound_mm": [
                    1e3 * task.noise_px * camera.distance_stddev_m
                    for camera in unit_bound.cameras
                ],
                "distance_z": distance_z,
                "start_rotation_deg": _rotation_error_deg(begin, dive.truth),
                "start_px": result.summary.initial_rms_px,
                "converged": at_optimum(result, task.noise_px),
                "iterations": result.summary.num_iterations,
                "seconds": result.summary.solve_s,
                "observations": dive.scene.num_observations,
            }
        )
    return rows


def at_optimum(result: CalibrationResult, noise_px: float) -> bool:
    """Whether the solver stopped by itself, with residuals of the noise's size."""
    # 10000 observations and more: their sigma is known to a per cent.
    level = abs(result.summary.sigma_px - noise_px)
    return result.summary.converged and level <= max(0.1 * noise_px, 1e-3)


def _rotation_error_deg(found: Scene, truth: Scene) -> float:
    difference = rigid3.compose(
        found.rig_from_world, rigid3.inverse(truth.rig_from_world)
    )
    return float(np.degrees(rms(rigid3.rotation_angle(difference))))


def table(runs: int, processes: int, cases: Sequence[Case] = CASES) -> list[Row]:
    """Figure 7: a row per case, noise level and strategy."""
    tasks = [
        Task(case=case, noise_px=noise, seed=seed)
        for case in cases
        for seed, (noise, _) in enumerate(product(case.noises_px, range(runs)))
    ]
    found = sum(run_all(solve, tasks, processes, "fig. 7"), [])
    return [
        _summary(
            select(found, case=case.name, noise_px=noise, strategy=strategy),
            case.num_points,
        )
        for case in cases
        for noise, strategy in product(case.noises_px, case.strategies)
    ]


def _summary(runs: list[Row], num_points: int) -> Row:
    """One line of the table from its runs."""

    def stack(name: str) -> np.ndarray:
        return np.array(column(runs, name))

    normal, distance = stack("normal_deg"), stack("distance_mm")
    normal_bound, distance_bound = stack("normal_bound_deg"), stack("distance_bound_mm")
    exact = runs[0]["noise_px"] == 0.0
    no_ratio: tuple[Any, Any] = (None, None)
    normal_ratio = no_ratio if exact else rms_ratio(normal, normal_bound)
    distance_ratio = no_ratio if exact else rms_ratio(distance, distance_bound)
    seconds, iterations = stack("seconds"), stack("iterations")
    return {
        "case": runs[0]["case"],
        "noise_px": runs[0]["noise_px"],
        "strategy": runs[0]["strategy"],
        "runs": len(runs),
        "points": num_points,
        "observations": float(np.mean(stack("observations"))),
        "start_rotation_deg": rms(stack("start_rotation_deg")),
        "start_px": rms(stack("start_px")),
        "normal_mean_deg": float(np.mean(normal)),
        "normal_sd_deg": float(np.std(normal)),
        "normal_max_deg": float(np.max(normal)),
        "normal_rmse_deg": rms(normal),
        "normal_bound_deg": rms(normal_bound),
        "normal_ratio": normal_ratio[0],
        "normal_ratio_error": normal_ratio[1],
        "distance_mean_error_mm": float(np.mean(distance)),
        "distance_sd_mm": float(np.std(distance)),
        "distance_max_error_mm": float(np.max(np.abs(distance))),
        "distance_rmse_mm": rms(distance),
        "distance_bound_mm": rms(distance_bound),
        "distance_ratio": distance_ratio[0],
        "distance_ratio_error": distance_ratio[1],
        "z_normal_mean": None if exact else float(np.mean(stack("normal_z"))),
        "z_normal_sd": None if exact else float(np.std(stack("normal_z"))),
        "z_distance_mean": None if exact else float(np.mean(stack("distance_z"))),
        "z_distance_sd": None if exact else float(np.std(stack("distance_z"))),
        "converged_percent": 100.0 * float(np.mean(stack("converged"))),
        "iterations_mean": float(np.mean(iterations)),
        "iterations_max": int(np.max(iterations)),
        "solve_median_s": float(np.median(seconds)),
        "solve_max_s": float(np.max(seconds)),
    }
