"""Figure 7: normals and distances of both ports from many pairs, and how often.

As in the paper, the start is made by a perspective bundle adjustment of the noisy
observations; then the ports start straight and at 10 mm, and everything moves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from uwsfm._base.tasks import Workers
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.scene import Scene
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    SimulatedScene,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion

NOISES_PX = (0.0, 0.1, 0.25, 0.5, 1.0)
NUM_FRAMES = 15
NUM_POINTS = 800
STRATEGIES: dict[str, dict] = {"joint": {}, "nested": {"strategy": "nested"}}
ERRORS = ("reprojection", "virtual_camera", "virtual_camera_tangential", "point_3d")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One block of the table."""

    name: str
    methods: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: {"joint": {}}
    )
    """Name -> options of `uwsfm.calibrate`."""
    thickness_mm: float = 5.0
    outlier_ratio: float = 0.0
    distances_known: bool = False
    noises_px: Sequence[float] = NOISES_PX
    num_frames: int = NUM_FRAMES
    num_points: int = NUM_POINTS

    @property
    def loss(self) -> str:
        """Least squares are optimal for Gaussian noise, and lost with outliers."""
        return "cauchy" if self.outlier_ratio > 0.0 else "l2"

    @property
    def held(self) -> dict[str, Any]:
        return {"refine_distances": False} if self.distances_known else {}


CASES = (
    Case(name="glass 5 mm", methods=STRATEGIES),
    Case(name="glass 30 mm", thickness_mm=30.0),
    Case(name="15 % outliers", outlier_ratio=0.15, noises_px=(0.5,)),
    Case(
        name="distances known",
        distances_known=True,
        noises_px=(0.1, 0.5),
        methods={error: {"error": error} for error in ERRORS},
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


def start(scene: Scene, case: Case) -> tuple[Scene, float]:
    """What perspective Structure from Motion leaves, and its pinholes' RMS error, px.

    The ports are straight, and at 10 mm unless their distances are known.
    """
    adjusted, summary = perspective_adjustment(scene, loss=case.loss)
    # A point whose observations were all rejected but one has no place.
    placed = finite_rows(adjusted.points)[adjusted.point_idx]
    adjusted, _ = adjusted.select(placed)
    ports = Perturbation(distance_scale=1.0 if case.distances_known else 0.5)
    return perturbed(adjusted, ports), summary.rms_px


def solve(task: Task) -> list[Row]:
    """All that is measured of one dive, a row per method."""
    case, dive = task.case, simulate(task)
    # Of all observations, those that became outliers included: the clean bound.
    unit_bound = predict_covariance(dive.truth, 1.0, **case.held).cameras
    begin, pinhole_px = start(dive.scene, case)
    rows = []
    for method, chosen in case.methods.items():
        options = {"loss": case.loss, **case.held, **chosen}
        warm_up(**options)
        result = uwsfm.calibrate(begin, **options)
        normal_z, distance_z = z_scores(result, dive.truth)
        rows.append(
            {
                "case": case.name,
                "noise_px": task.noise_px,
                "method": method,
                "normal_deg": normal_errors_deg(result.scene, dive.truth.ports),
                "normal_bound_deg": [
                    task.noise_px * camera.normal_stddev_deg for camera in unit_bound
                ],
                "normal_z": normal_z,
                "distance_mm": distance_errors_mm(result.scene, dive.truth),
                "distance_bound_mm": [
                    1e3 * task.noise_px * camera.distance_stddev_m
                    for camera in unit_bound
                ],
                "distance_z": distance_z,
                "pinhole_px": pinhole_px,
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


def table(runs: int, workers: Workers, cases: Sequence[Case] = CASES) -> list[Row]:
    """Figure 7: a row per case, noise level and method."""
    tasks = [
        Task(case=case, noise_px=noise, seed=seed)
        for case in cases
        for seed, (noise, _) in enumerate(product(case.noises_px, range(runs)))
    ]
    found = sum(run_all(solve, tasks, workers, "fig. 7"), [])
    return [
        _summary(select(found, case=case.name, noise_px=noise, method=method), case)
        for case in cases
        for noise, method in product(case.noises_px, case.methods)
    ]


def _summary(runs: list[Row], case: Case) -> Row:
    """One line of the table from its runs."""
    exact = runs[0]["noise_px"] == 0.0
    row: Row = {name: runs[0][name] for name in ("case", "noise_px", "method")}
    row |= {"runs": len(runs), "points": case.num_points}
    row["observations"] = float(np.mean(column(runs, "observations")))
    for name in ("pinhole_px", "start_rotation_deg", "start_px"):
        row[name] = rms(column(runs, name))
    row |= _accuracy(runs, "normal", "deg", compared=not exact)
    known = case.distances_known
    row |= _accuracy(runs, "distance", "mm", compared=not exact and not known)
    row["converged_percent"] = 100.0 * float(np.mean(column(runs, "converged")))
    iterations, seconds = column(runs, "iterations"), column(runs, "seconds")
    row["iterations_mean"] = float(np.mean(iterations))
    row["iterations_max"] = max(iterations)
    row["solve_median_s"] = float(np.median(seconds))
    row["solve_max_s"] = max(seconds)
    return row


def _accuracy(runs: list[Row], what: str, unit: str, *, compared: bool) -> Row:
    """Errors of both cameras, their bound, and their scores if there is a bound."""
    errors = np.array(column(runs, f"{what}_{unit}"))  # (runs, cameras)
    bounds = np.array(column(runs, f"{what}_bound_{unit}"))
    ratio, ratio_error = rms_ratio(errors, bounds) if compared else (None, None)
    z = np.array(column(runs, f"{what}_z"))
    return {
        f"{what}_mean_{unit}": float(np.mean(errors)),
        f"{what}_sd_{unit}": float(np.std(errors)),
        f"{what}_max_{unit}": float(np.max(np.abs(errors))),
        f"{what}_rmse_{unit}": rms(errors),
        f"{what}_bound_{unit}": rms(bounds),
        f"{what}_ratio": ratio,
        f"{what}_ratio_error": ratio_error,
        f"{what}_z_mean": float(np.mean(z)) if compared else None,
        f"{what}_z_sd": float(np.std(z)) if compared else None,
    }
