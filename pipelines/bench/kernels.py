"""Nanoseconds per observation on one core: lanes, scalar loops and plain numpy."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy_port
import pycolmap
import scalar_loops
import surveys

import uwsfm
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.geometry.rigid3 import Array
from uwsfm.models import projection
from uwsfm.models.lens import SUPPORTED_MODELS
from uwsfm.scene import Scene
from uwsfm.solver.error_models import error_model
from uwsfm.solver.layout import build_layout
from uwsfm.solver.levenberg_marquardt import LevenbergMarquardtOptions, Problem
from uwsfm.solver.state import State
from uwsfm.solver.threads import limited

FLAT = uwsfm.FlatPort((0.0348995, 0.0, 0.9993908), 0.02, 0.005)
PORTS: dict[str, uwsfm.FlatPort | uwsfm.DomePort | uwsfm.NoPort] = {
    "flat": FLAT,
    "dome, 34 mm off": uwsfm.DomePort((0.01, 0.01, 0.03), 0.06, 0.01),
    "dome, 3 mm off": uwsfm.DomePort((0.001, 0.001, 0.003), 0.06, 0.01),
    "dome, concentric": uwsfm.DomePort((0.0, 0.0, 0.0), 0.06, 0.01),
    "none": uwsfm.NoPort(),
}
DISTORTIONS = {
    "SIMPLE_RADIAL": [-0.05],
    "RADIAL": [-0.05, 0.018],
    "OPENCV": [-0.05, 0.018, 2e-4, -1e-4],
    "FULL_OPENCV": [-0.05, 0.018, 2e-4, -1e-4, 0.002, 0.01, -0.004, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [-0.02],
    "RADIAL_FISHEYE": [-0.02, 0.006],
    "OPENCV_FISHEYE": [-0.02, 0.006, -0.002, 0.0005],
    "THIN_PRISM_FISHEYE": [-0.02, 0.006, 2e-4, -1e-4, -0.002, 0.0005, 1e-4, -1e-4],
    "FOV": [0.6],
    "EUCM": [0.55, 1.05],
}
ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
STAGES = (
    "unproject",
    "project",
    "project + Jacobian",
    "normal equations",
    "trial cost",
)
AGREEMENT_PX = 1e-7
"""Times are compared of what gives the same pixels."""

Times = dict[str, float]


def measure(folder: str, num_points: int, num_frames: int, passes: int) -> Any:
    """A row per port, lens and implementation: ns per observation of each stage.

    Args:
        folder: For the survey.
        num_points: For projections.
        num_frames: Of the survey, for normal equations and costs.
        passes: Of which the best counts.
    """
    scene = surveys.load(num_frames, folder)
    rows = []
    with limited(1):
        for name, port in PORTS.items():
            camera = uwsfm.RefractiveCamera(lens_of("PINHOLE"), port)
            times = of_camera(camera, num_points, passes)
            times |= of_scene(camera, scene, passes)
            rows.append(_row("lanes", name, "PINHOLE", times))
        for model in SUPPORTED_MODELS:
            if model != "PINHOLE":
                camera = uwsfm.RefractiveCamera(lens_of(model), FLAT)
                times = of_camera(camera, num_points, passes)
                times |= of_scene(camera, scene, passes)
                rows.append(_row("lanes", "flat", model, times))
        for name in ("flat", "dome, 34 mm off"):
            camera = uwsfm.RefractiveCamera(lens_of("PINHOLE"), PORTS[name])
            times = of_camera(camera, num_points, passes, scalar=True)
            times |= of_scene(camera, scene, passes, scalar=True)
            rows.append(_row("scalar", name, "PINHOLE", times))
        times = in_numpy(num_points, scene, passes)
        rows.append(_row("numpy", "flat", "PINHOLE", times))
    return {"rows": rows, "num_points": num_points, "observations": len(scene.xy)}


def _row(kind: str, port: str, lens: str, times: Times) -> dict[str, Any]:
    return {"kind": kind, "port": port, "lens": lens, "ns": times}


def lens_of(model: str) -> pycolmap.Camera:
    focal = [1000.0] if model in ONE_FOCAL else [1000.0, 1000.0]
    params = [*focal, 600.0, 450.0, *DISTORTIONS.get(model, [])]
    return pycolmap.Camera(model=model, width=1200, height=900, params=params)


def nanoseconds(call: Callable[[], Any], count: int, passes: int) -> float:
    """CPU time of this thread per item, the best of several passes."""
    call()  # compilation, and memory that is touched first
    best = np.inf
    for _ in range(passes):
        clock = time.thread_time()
        call()
        best = min(best, time.thread_time() - clock)
    return float(1e9 * best / count)


def water_points(camera: uwsfm.RefractiveCamera, count: int) -> tuple[Array, Array]:
    """Pixels all over the image (N, 2), and points (N, 3) on their rays."""
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, 0], [1200, 900], (count, 2))
    origins, dirs = camera.ray_from_img(xy)
    return xy, origins + rng.uniform(0.5, 3.0, (count, 1)) * dirs


def of_camera(
    camera: uwsfm.RefractiveCamera, count: int, passes: int, scalar: bool = False
) -> Times:
    """The first three stages."""
    lens, row = camera.lens, camera.port.row
    xy, points = water_points(camera, count)
    rays, pixels = np.empty((count, 6)), np.empty((count, 2))
    jac = np.empty((count, 2, projection.JAC_SIZE))
    status = np.empty(count, dtype=np.uint8)
    batches = (
        projection.unproject_batch,
        projection.project_batch,
        projection.project_with_jac_batch,
    )
    if scalar:
        batches = (
            scalar_loops.unproject_loop,
            scalar_loops.project_loop,
            scalar_loops.project_with_jac_loop,
        )
    calls = (
        lambda: batches[0](xy, lens, row, rays, status),
        lambda: batches[1](points, lens, row, pixels, status),
        lambda: batches[2](points, lens, row, pixels, jac, status),
    )
    times = [nanoseconds(call, count, passes) for call in calls]
    _check(f"{camera}, scalar={scalar}", pixels, xy)
    return dict(zip(STAGES, times, strict=False))


def of_scene(
    camera: uwsfm.RefractiveCamera, scene: Scene, passes: int, scalar: bool = False
) -> Times:
    """The last two stages; scalar: Jacobians, but no sums."""
    scene = surveys.with_cameras(scene, (camera,) * len(scene.cameras))
    columns = CalibrateOptions(loss="l2").border_columns(
        scene.cameras, np.zeros(len(scene.cameras), dtype=bool)
    )
    layout, state = build_layout(scene, columns), State.from_scene(scene)
    error = error_model("reprojection", layout, state)
    problem = Problem(layout, error, LevenbergMarquardtOptions(), None)
    kernel_state, count = state.kernel_state(), len(layout.xy)
    calls: tuple[Callable[[], Any], ...] = (
        lambda: problem.linearize(state),
        lambda: problem.cost(state),
    )
    if scalar:
        calls = (
            lambda: scalar_loops.jacobian_loop(layout, kernel_state),
            lambda: scalar_loops.cost_loop(layout, kernel_state),
        )
    times = [nanoseconds(call, count, passes) for call in calls]
    return dict(zip(STAGES[3:], times, strict=True))


def in_numpy(count: int, scene: Scene, passes: int) -> Times:
    """Plain numpy; normal equations are left out."""
    camera = uwsfm.RefractiveCamera(lens_of("PINHOLE"), FLAT)
    pinhole, (xy, points) = camera.lens[:4], water_points(camera, count)
    scene = surveys.with_cameras(scene, (camera,) * len(scene.cameras))
    found, jac = numpy_port.project_with_jac(points, pinhole, FLAT)
    _check("numpy", found, xy)
    exact = camera.img_from_point_with_jac(points)[1][..., :3]
    _check("numpy, Jacobian", 1e-3 * jac, 1e-3 * exact)  # px per mm
    origins, dirs = numpy_port.unproject(xy, pinhole, FLAT)
    _check(
        "numpy, rays", np.hstack([origins, dirs]), np.hstack(camera.ray_from_img(xy))
    )
    calls: dict[str, tuple[Callable[[], Any], int]] = {
        "unproject": (lambda: numpy_port.unproject(xy, pinhole, FLAT), count),
        "project": (lambda: numpy_port.project(points, pinhole, FLAT), count),
        "project + Jacobian": (
            lambda: numpy_port.project_with_jac(points, pinhole, FLAT),
            count,
        ),
        "trial cost": (lambda: numpy_port.cost(scene), len(scene.xy)),
    }
    return {
        stage: nanoseconds(call, number, passes)
        for stage, (call, number) in calls.items()
    }


def _check(what: str, found: Array, expected: Array) -> None:
    worst = float(np.max(np.abs(found - expected)))
    if not worst < AGREEMENT_PX:
        raise RuntimeError(f"{what} is {worst:.2g} off: its time means nothing")
