"""The same scenes with other solvers: scipy, COLMAP's pinholes, Refractive COLMAP."""

import re
import resource
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import surveys
from child import peak_memory_mb
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from solver import Solve, cpu_per_observation
from threadpoolctl import threadpool_limits

from uwsfm.colmap.model import to_reconstruction
from uwsfm.export.refractive_colmap import export_refractive_colmap
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.threads import limited

ITERATIONS = 10
TURNS = 3
REFERENCE_US = {"pinhole, CPU": (2.9, 4.8), "refractive, CPU": (18.0, 22.0)}
"""Per observation and iteration, COLMAP 4.2 and Refractive COLMAP, where there is no
binary. Measured on another day, on a machine of two cores, on other scenes, as CPU time
of a whole call: 10 iterations of 200 images with 219,000 observations in 40 s, 5 of 500
images with 750,000 in 84 s (COLMAP's pinholes 6.3 s and 18 s)."""


def pinhole_colmap(num_frames: int, folder: str) -> dict[str, Any]:
    """COLMAP's bundle adjustment of rig, poses and points, without any water.

    The observations are those of pinholes, so that it has no model error to fight. Only
    its minimiser's share of the CPU time counts, not how it sets its problem up. It
    takes turns with ours: the speed of a machine that is shared changes by the second.
    """
    return beside_pinholes(surveys.load(num_frames, folder))


def beside_pinholes(scene: Scene) -> dict[str, Any]:
    """The same of any scene."""
    truth = surveys.as_pinholes(scene)
    start = to_reconstruction(surveys.as_model(surveys.start_of(truth)))
    before = peak_memory_mb()
    theirs, ours = [], []
    for _ in range(TURNS):
        theirs.append(_adjust_pinholes(pycolmap.Reconstruction(start)))
        if not ours:
            peak = peak_memory_mb()
            solve = Solve(surveys.start_of(scene))
            with limited(1):
                solve(1)  # loads the kernels
        with limited(1), threadpool_limits(1):
            ours.append(cpu_per_observation(solve))
    one, count = theirs[0], truth.num_observations
    unit = 1e6 / one.iterations / count
    return {
        "observations": count,
        "iterations": one.iterations,
        "us_per_observation": unit * float(np.mean([run.cpu_s for run in theirs])),
        "whole_us_per_observation": unit
        * float(np.mean([run.whole_s for run in theirs])),
        "ours_us_per_observation": 1e6 * float(np.mean(ours)),
        "rms_px": float(np.sqrt(2.0 * one.cost / count)),
        "linear_solver": one.linear_solver,
        "peak_mb": peak,
        "peak_before_mb": before,
    }


class _Adjustment(NamedTuple):
    iterations: int
    cost: float
    linear_solver: str
    cpu_s: float
    """Of the iterations."""
    whole_s: float
    """CPU, with the set-up of the problem."""


def _adjust_pinholes(reconstruction: pycolmap.Reconstruction) -> _Adjustment:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_sensor_from_rig = True
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, ITERATIONS
    solver.function_tolerance = solver.gradient_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    clock = time.process_time()
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    setup = time.process_time() - clock
    found = adjuster.solve().ceres_summary
    cpu = time.process_time() - clock - setup
    share = found.minimizer_time_in_seconds / found.total_time_in_seconds
    return _Adjustment(
        # The evaluation of the start counts as a step there.
        found.num_successful_steps + found.num_unsuccessful_steps - 1,
        found.final_cost,
        found.linear_solver_type_used.name,
        share * cpu,
        setup + cpu,
    )


def least_squares_scipy(num_frames: int, folder: str, steps: int) -> dict[str, Any]:
    """`scipy.optimize.least_squares` with differences in the sparse pattern.

    The residuals come from this package's kernels, the parameters and the start are
    the same: what differs is the solver.
    """
    start = surveys.start_of(surveys.load(num_frames, folder))
    solve = Solve(start)
    layout, state = solve.layout, solve.state
    offset = layout.num_frame_cols + layout.num_border_cols

    def residuals(x: Array) -> Array:
        moved = state.moved(layout, x[:offset], x[offset:].reshape(-1, 3))
        errors = moved.to_scene(start).residuals()
        return np.nan_to_num(errors[layout.order], nan=100.0).ravel()

    clock = time.process_time()
    found = least_squares(
        residuals,
        np.zeros(offset + 3 * start.num_points),
        jac_sparsity=_pattern(layout),
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=steps,
    )
    cpu = time.process_time() - clock
    return {
        "observations": start.num_observations,
        "iterations": int(found.nfev),
        "us_per_observation": 1e6 * cpu / found.nfev / start.num_observations,
        "rms_px": float(np.sqrt(2.0 * found.cost / start.num_observations)),
    }


def _pattern(layout: Layout) -> csr_matrix:
    """Which unknown moves which residual."""
    count = len(layout.xy)
    cell = np.repeat(np.arange(len(layout.cell_frame)), np.diff(layout.cell_start))
    frame_col = layout.frame_col[layout.cell_frame[cell]]
    point_of_cell = np.repeat(
        np.arange(len(layout.point_start) - 1), np.diff(layout.point_start)
    )
    offset = layout.num_frame_cols + layout.num_border_cols
    border = layout.border_col[layout.camera]
    columns = np.hstack(
        [
            np.where(frame_col[:, None] == HELD, HELD, frame_col[:, None] + range(6)),
            np.where(border == HELD, HELD, border + layout.num_frame_cols),
            offset + 3 * point_of_cell[cell][:, None] + range(3),
        ]
    )
    columns = np.repeat(columns, 2, axis=0)
    rows = np.broadcast_to(np.arange(2 * count)[:, None], columns.shape)
    free = columns != HELD
    entries = (np.ones(np.count_nonzero(free)), (rows[free], columns[free]))
    num_points = len(layout.point_start) - 1
    return csr_matrix(entries, shape=(2 * count, offset + 3 * num_points))


def refractive_colmap(num_frames: int, folder: str, binary: str) -> dict[str, Any]:
    """`bundle_adjuster` of a Refractive COLMAP binary, on the scene as exported.

    The CPU time of its process with many iterations less that with few: reading and
    writing are left out. Its command may lack the switch for refraction; then its time
    is that of pinholes, and the result says so.
    """
    start = surveys.start_of(surveys.load(num_frames, folder))
    usage = subprocess.run(
        [binary, "bundle_adjuster", "--help"], capture_output=True, text=True
    )
    flags = {"refine_focal_length": 0, "refine_extra_params": 0}
    refractive = "BundleAdjustment.enable_refraction" in usage.stdout + usage.stderr
    if refractive:
        flags |= {"enable_refraction": 1, "refine_refrac_params": 1}
    with tempfile.TemporaryDirectory() as name:
        model = Path(name) / "start"
        export_refractive_colmap(surveys.as_model(start), model)
        few, many = (
            _seconds(binary, model, flags, iterations)
            for iterations in (1, 1 + ITERATIONS)
        )
    return {
        "observations": start.num_observations,
        "iterations": ITERATIONS,
        "refractive": refractive,
        "us_per_observation": 1e6 * (many - few) / ITERATIONS / start.num_observations,
    }


def _seconds(binary: str, model: Path, flags: dict[str, int], iterations: int) -> float:
    """CPU seconds of one run.

    Raises:
        RuntimeError: the binary failed, or did not do as many iterations as asked.
    """
    out = model.parent / "adjusted"
    out.mkdir(exist_ok=True)
    command = [binary, "bundle_adjuster", "--input_path", str(model)]
    command += ["--output_path", str(out)]
    for name, value in {**flags, "max_num_iterations": iterations}.items():
        command += [f"--BundleAdjustment.{name}", str(value)]
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = subprocess.run(command, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    said = run.stdout + run.stderr
    if run.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed: {said[-500:]}")
    done = re.search(r"Iterations\s*:\s*(\d+)", said)
    if done and int(done[1]) < iterations:
        raise RuntimeError(f"{binary} stopped after {done[1]} of {iterations} steps")
    return after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
