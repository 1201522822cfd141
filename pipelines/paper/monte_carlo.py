"""Many independent runs on all cores, or a cluster, and what they say together."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

import uwsfm
from uwsfm._base.signals import BEGINS_AGAIN
from uwsfm._base.tasks import Workers
from uwsfm.calibration.result import CalibrationResult
from uwsfm.cli.console import ProgressBars
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between, tangent_basis
from uwsfm.models.ports.port import FlatPort
from uwsfm.residuals.border import DISTANCE, NORMAL
from uwsfm.scene import Scene
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion

Task = TypeVar("Task")
Result = TypeVar("Result")


def run_all(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    workers: Workers,
    label: str,
) -> list[Result]:
    """``[function(task) for task in tasks]``, by workers.

    Args:
        function: Of a module, so that another process can import it.
        tasks: Each with its own seed; picklable.
        workers: Who run them.
        label: Of the progress bar.
    """
    # Kernels are compiled here once; the workers load them.
    warm_up()
    with ProgressBars(BEGINS_AGAIN) as progress:
        return workers.run(function, [(task,) for task in tasks], label, progress)


@cache
def warm_up(**options: Any) -> None:
    """Load the kernels of one way to calibrate, so that no timed solve has to."""
    scene = simulate_scene(
        paper_rig(),
        rich_motion(4),
        Relief(stddev=0.2),
        ObservationOptions(num_points=60, noise_px=0.1),
    ).scene
    uwsfm.calibrate(scene, max_iterations=2, **options)


def straight_ports(scene: Scene, distance_mm: float) -> Scene:
    """Ports along the optical axes at a distance, points where their rays meet."""
    cameras = tuple(
        camera.with_port(
            replace(camera.port, normal=(0.0, 0.0, 1.0), distance=1e-3 * distance_mm)
        )
        for camera in scene.cameras
    )
    scene = replace(scene, cameras=cameras)
    points = triangulate_tracks(*scene.water_rays(), scene.point_idx, scene.num_points)
    return replace(scene, points=points)


def normal_errors_deg(found: Scene, truth: Sequence[FlatPort]) -> list[float]:
    """Angle between the estimated and the true port normal, per camera."""
    return [
        float(np.degrees(angle_between(port.normal, true.normal)))
        for port, true in zip(found.ports, truth, strict=True)
    ]


def distance_errors_mm(found: Scene, truth: Scene) -> list[float]:
    """Estimated minus true port distance, per camera."""
    return [
        1e3 * (port.distance - true.distance)
        for port, true in zip(found.ports, truth.ports, strict=True)
    ]


def z_scores(result: CalibrationResult, truth: Scene) -> tuple[Array, Array]:
    """Errors over the standard deviations of `Covariance.border`.

    Those that are reported are never smaller: they allow for neighbours that err
    together, which simulated noise does not.

    Returns:
        Of two components of each normal (C, 2), and of the distances (C,).
    """
    columns = result.covariance.border_cols
    # What is held has column -1: the zero at the end.
    stddevs = np.sqrt(np.append(np.diag(result.covariance.border), 0.0))
    normals, distances = [], []
    for camera, true in enumerate(truth.ports):
        found = result.scene.ports[camera]
        offset = -tangent_basis(found.normal).T @ true.normal
        normals.append(offset / stddevs[columns[camera, NORMAL]])
        stddev = stddevs[columns[camera, DISTANCE]]
        error = found.distance - true.distance
        distances.append(error / stddev if stddev > 0.0 else 0.0)
    return np.array(normals), np.array(distances)


def rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def rms_ratio(errors: ArrayLike, bounds: ArrayLike) -> tuple[float, float]:
    """RMS of errors over their bounds, and the Monte-Carlo error of that ratio.

    Args:
        errors, bounds: (runs, C). The cameras of a run are correlated: the runs count.
    """
    squares = np.mean(np.square(np.asarray(errors) / np.asarray(bounds)), axis=1)
    ratio = float(np.sqrt(np.mean(squares)))
    error = np.std(squares, ddof=1) / np.sqrt(len(squares)) / (2.0 * ratio)
    return ratio, float(error)
