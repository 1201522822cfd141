"""How far off the ports may start: the basin of the joint adjustment."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from many_pairs import Case, at_optimum, simulate
from many_pairs import Task as Dive
from monte_carlo import run_all, warm_up
from tables import Row, column, select

import uwsfm
from uwsfm._base.tasks import Workers
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.geometry.unit_vector import plus
from uwsfm.scene import Scene

ANGLES_DEG = (5.0, 10.0, 20.0)
DISTANCE_SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)
NOISE_PX = 0.5
CASE = Case(name="basin")
OPTIONS = {"loss": "l2"}


@dataclass(frozen=True, kw_only=True)
class Task:
    """Starts of one dive."""

    case: Case
    seed: int


def solve(task: Task) -> list[Row]:
    """Every start of one dive: whether and how fast the adjustment comes back."""
    dive = simulate(Dive(case=task.case, noise_px=NOISE_PX, seed=task.seed))
    begin, _ = perspective_adjustment(dive.scene)
    rng = np.random.default_rng(task.seed)
    warm_up(**OPTIONS)
    rows = []
    for angle, scale in product(ANGLES_DEG, DISTANCE_SCALES):
        try:
            result = uwsfm.calibrate(_moved(begin, angle, scale, rng), **OPTIONS)
            converged = at_optimum(result, NOISE_PX)
            iterations = result.summary.num_iterations
        except uwsfm.UwsfmError:  # the normal turned away from the water
            converged, iterations = False, 0
        rows.append(
            {
                "normal_off_deg": angle,
                "distance_scale": scale,
                "converged": converged,
                "iterations": iterations,
            }
        )
    return rows


def _moved(scene: Scene, angle_deg: float, scale: float, rng) -> Scene:
    """The scene with its true ports turned anywhere and moved along."""
    cameras = []
    for camera in scene.cameras:
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        step = np.radians(angle_deg) * np.array([np.cos(azimuth), np.sin(azimuth)])
        port = replace(
            camera.port,
            normal=tuple(plus(camera.port.normal, step).tolist()),
            distance=scale * camera.port.distance,
        )
        cameras.append(camera.with_port(port))
    return replace(scene, cameras=tuple(cameras))


def table(runs: int, workers: Workers, case: Case = CASE) -> list[Row]:
    """A row per angle and factor."""
    tasks = [Task(case=case, seed=seed) for seed in range(runs)]
    found = sum(run_all(solve, tasks, workers, "basin"), [])
    rows = []
    for angle, scale in product(ANGLES_DEG, DISTANCE_SCALES):
        mine = select(found, normal_off_deg=angle, distance_scale=scale)
        iterations = column(mine, "iterations")
        rows.append(
            {
                "normal_off_deg": angle,
                "distance_scale": scale,
                "converged_percent": 100.0 * float(np.mean(column(mine, "converged"))),
                "iterations_mean": float(np.mean(iterations)),
                "iterations_max": int(np.max(iterations)),
                "runs": len(mine),
            }
        )
    return rows
