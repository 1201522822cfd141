"""Machine code for all kernels of a reconstruction, made before it is needed.

Numba's compiler holds Python's global lock: threads do not help, processes do. Each
does a small simulated job, whose kernels stay in the cache for all that comes later.
"""

from __future__ import annotations

import gc
import logging
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from filelock import FileLock
from numba.core import config

from uwsfm._base.children import module_command
from uwsfm._base.jit import CACHE_DIR
from uwsfm._base.partial import scratch_folder
from uwsfm._base.progress import Progress, silent
from uwsfm.geometry import rigid3
from uwsfm.scene import Scene

if TYPE_CHECKING:
    from uwsfm.rig.rig import Rig
    from uwsfm.solver.layout import Layout

STEP = "compiling kernels (first run only)"
DONE = "compiled"
"""File in the cache that says that nothing is left to compile."""
POLL_SECONDS = 0.2

logger = logging.getLogger(__name__)


def compile_kernels(num_threads: int = 2, progress: Progress = silent) -> float:
    """Compile what the cache lacks; a second process at the same time waits.

    Without a cache, or where compilation is turned off, nothing is done. Nothing
    depends on it either: a kernel that is not in the cache is compiled when it is
    called.

    Args:
        num_threads: Processes to use, one per job at most.
        progress: Called with seconds.

    Returns:
        How long it took, seconds.
    """
    off = config.DISABLE_JIT  # type: ignore[attr-defined]
    if CACHE_DIR is None or off or (CACHE_DIR / DONE).exists():
        return 0.0
    start = time.monotonic()
    with FileLock(CACHE_DIR / f"{DONE}.lock"):
        if (CACHE_DIR / DONE).exists():
            return time.monotonic() - start
        if _run_all(
            max(1, num_threads),
            lambda: progress(STEP, int(time.monotonic() - start), None),
        ):
            (CACHE_DIR / DONE).touch()
    return time.monotonic() - start


def _run_all(num_processes: int, watch: Callable[[], None]) -> bool:
    """Run all jobs in processes; whether all succeeded."""
    waiting, failed = list(JOBS), False
    running: dict[str, subprocess.Popen[str]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < num_processes:
                name = waiting.pop(0)
                running[name] = _start(name)
            watch()
            time.sleep(POLL_SECONDS)
            for name, process in list(running.items()):
                if process.poll() is not None:
                    _, errors = running.pop(name).communicate()
                    if process.returncode != 0:
                        failed = True
                        logger.warning("compiling %s failed: %s", name, errors)
    finally:
        for process in running.values():
            process.kill()
            process.communicate()
    return not failed


def _start(name: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        module_command(__name__, name),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _adjustment() -> None:
    """The kernels of the last adjustment, its errors and its uncertainties."""
    from uwsfm.sfm.refine import refine_scene
    from uwsfm.simulate.rigs import sample_rig
    from uwsfm.solver.inner_iterations import settled
    from uwsfm.solver.losses import L2
    from uwsfm.solver.state import State
    from uwsfm.solver.workspace import Workspace

    rig, scene = sample_rig(), _dive()
    refine_scene(scene, rig)
    # Which only steps that fall short come to.
    work = Workspace(_layout(rig, scene))
    settled(work, State.from_scene(scene), L2, 1.0, 1e-6)


def _elimination() -> None:
    """The kernels that project nothing, on a system that stands for any other."""
    from uwsfm.simulate.rigs import sample_rig
    from uwsfm.solver.covariance import point_covariances, reduced_covariance
    from uwsfm.solver.linear import schur
    from uwsfm.solver.normal_equations import empty_normal_equations

    rig = sample_rig()
    cameras = rig.refractive_cameras()
    point, frame, camera = (i.ravel() for i in np.indices((5, 2, len(cameras))))
    scene = Scene.from_arrays(
        cameras=cameras,
        cam_from_rig=np.tile(rigid3.IDENTITY, (len(cameras), 1)),
        rig_from_world=np.tile(rigid3.IDENTITY, (2, 1)),
        points=np.zeros((5, 3)),
        camera_idx=camera,
        frame_idx=frame,
        point_idx=point,
        xy=np.zeros((len(point), 2)),
    )
    layout = _layout(rig, scene)
    eqs = empty_normal_equations(layout)
    for blocks in (eqs.points, eqs.frames, eqs.border[None]):
        blocks[:] = np.eye(blocks.shape[-1])
    reduced = reduced_covariance(layout, eqs)
    point_covariances(layout, eqs, reduced)
    step = np.zeros(layout.num_frame_cols + layout.num_border_cols)
    schur.substitute_back(layout, reduced.reduction.graph, eqs, reduced.points, step)


def _layout(rig: Rig, scene: Scene) -> Layout:
    from uwsfm.calibration.problem import CalibrateOptions
    from uwsfm.sfm.refine import rig_options
    from uwsfm.solver.layout import build_layout

    options = CalibrateOptions.parsed(rig_options(rig))
    fixed = np.zeros(len(scene.cameras), dtype=bool)
    return build_layout(scene, options.border_columns(scene.cameras, fixed))


def _mapping() -> None:
    """The kernels of poses, then the mapper as a whole.

    First comes what the other job comes to last; meanwhile it compiles the projection,
    and later the adjustment, of which the mapper is made, too.
    """
    _elimination()
    from uwsfm.sfm.options import StartOptions
    from uwsfm.sfm.poses.absolute_pose import estimate_rig_pose
    from uwsfm.sfm.poses.relative_pose import estimate_relative_pose
    from uwsfm.sfm.simulated import frames_of, write_features
    from uwsfm.sfm.start import start_from_matches
    from uwsfm.sfm.steps import Steps
    from uwsfm.simulate.rigs import sample_rig

    rig, scene = sample_rig(), _dive()
    rows = scene.frame_idx == 0
    estimate_rig_pose(
        scene.cameras,
        scene.cam_from_rig,
        scene.camera_idx[rows],
        scene.xy[rows],
        scene.points[scene.point_idx[rows]],
    )
    # Which maps of one camera begin with, and those that are in doubt look for.
    here, there = (
        np.flatnonzero((scene.frame_idx == frame) & (scene.camera_idx == 0))
        for frame in range(2)
    )
    _, a, b = np.intersect1d(
        scene.point_idx[here], scene.point_idx[there], return_indices=True
    )
    camera = scene.cameras[0]
    estimate_relative_pose(camera, camera, scene.xy[here[a]], scene.xy[there[b]])
    with scratch_folder() as folder:
        steps = Steps(folder)
        frames = frames_of(rig, scene.num_frames, steps.work_dir)
        write_features(steps.work_dir / "database.db", scene, frames, wrong=0.1)
        options = StartOptions(mapper="refractive", num_threads=1)
        start_from_matches(rig, frames, steps, "", options)


def _dive() -> Scene:
    from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
    from uwsfm.simulate.rigs import sample_rig
    from uwsfm.simulate.trajectories import rich_motion

    return simulate_scene(
        sample_rig(),
        rich_motion(8),
        Relief(stddev=0.15, correlation_length=0.4),
        ObservationOptions(num_points=500, noise_px=0.3),
    ).scene


JOBS: dict[str, Callable[[], None]] = {"adjustment": _adjustment, "mapping": _mapping}

if __name__ == "__main__":
    gc.disable()  # a compiler makes much that refers to itself: a twentieth of the time
    JOBS[sys.argv[1]]()
