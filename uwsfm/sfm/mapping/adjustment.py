"""Bundle adjustment of a map that still grows: some frames, or all and the housings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uwsfm._base.indices import renumbered
from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.models.ports.port import DomePort, PlanePort, behind_camera
from uwsfm.models.ports.row import DISTANCE
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.mapping.growing_map import GrowingMap, Mask
from uwsfm.sfm.refine import rig_options
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.levenberg_marquardt import LevenbergMarquardtOptions, minimize
from uwsfm.solver.state import State

MIN_LOSS_SCALE_PX = 1.0
"""Cauchy's c is the median error, but not below this."""
NORMAL_STDDEV_DEG = 10.0
"""Of the start's normals: much weaker than what ten frames tell."""
MIN_STDDEV_M = 0.01
"""Of the start's port distances; they are good to themselves, or to this."""
CENTER_SHARE = 0.2
"""Of a dome's radius: how well its centre is known at the start."""
LOCAL_FRAMES = 6
"""Adjusted with a new one."""
GLOBAL_ITERATIONS = 20
LOCAL_ITERATIONS = 8
MIN_RELATIVE_DECREASE = 1e-3
"""The map changes again anyway; `refine_scene` is there for the last digits."""


@dataclass(frozen=True, kw_only=True)
class Housings:
    """What is refined beside poses and points once there are enough frames."""

    settings: CalibrateOptions
    """With weak priors, which hold what few frames do not determine."""
    known: Scene
    """Has the cameras and the rig that the priors are around."""

    @classmethod
    def of(cls, rig: Rig, growing: GrowingMap) -> Housings | None:
        """What a rig lets the images refine; None: nothing.

        The baseline is held: what is known of its length matters at the end only. So is
        the place of a single camera's port, which scales with everything else.
        """
        ports = [camera.port for camera in rig.cameras]
        distances = [port.distance for port in ports if isinstance(port, PlanePort)]
        radii = [port.radius for port in ports if isinstance(port, DomePort)]
        distance = float(np.mean(distances)) if distances else 0.0
        single = {"refine_distances": False, "refine_centers": False}
        settings = CalibrateOptions.parsed(
            {
                **rig_options(rig),
                **(single if len(rig.cameras) == 1 else {}),
                "baseline_stddev_m": 0.0,
                "normal_stddev_deg": NORMAL_STDDEV_DEG,
                "distance_stddev_m": max(distance, MIN_STDDEV_M),
                "center_stddev_m": CENTER_SHARE * min(radii) if radii else None,
            }
        )
        housings = cls(settings=settings, known=growing.scene()[0])
        free = housings.columns(np.zeros(len(rig.cameras), dtype=bool)) != HELD
        return housings if np.any(free) else None

    def columns(self, at_zero: Mask) -> IndexArray:
        return self.settings.border_columns(self.known.cameras, at_zero)


def neighbours(growing: GrowingMap, frame: int) -> IndexArray:
    """A frame and those that share most points with it, without the first of all,
    which holds the place of the world."""
    of = growing.correspondences
    near = growing.chains.of_points(growing.points_of(np.array([frame])))
    counts = np.bincount(of.frame[near], minlength=of.num_frames)
    counts[np.flatnonzero(growing.registered)[0]] = 0
    order = np.argsort(-counts, kind="stable")[: LOCAL_FRAMES + 1]
    return np.union1d(order[counts[order] > 0], [frame])


def adjust_locally(growing: GrowingMap, free: IndexArray) -> IndexArray:
    """Move some frames and the points (n,) they see, which are returned; all else is
    held."""
    points = growing.points_of(free)
    scene = growing.scene_of(growing.chains.of_points(points))
    frames, frame_idx = renumbered(scene.frame_idx, scene.num_frames)
    part = replace(
        scene,
        points=growing.points[points],
        point_idx=np.searchsorted(points, scene.point_idx),
        rig_from_world=growing.rig_from_world[frames],
        frame_idx=frame_idx.reshape(-1),
    )
    state = _minimized(part, None, ~np.isin(frames, free), LOCAL_ITERATIONS)
    growing.points[points] = state.points
    growing.rig_from_world[frames] = state.rig_from_world
    growing.place(free, growing.rig_from_world)
    return points


def adjust_globally(growing: GrowingMap, housings: Housings | None) -> None:
    """Move all frames and points but the first frame; and the housings, if given."""
    scene, _ = growing.scene()
    part, points = scene.select(np.ones(scene.num_observations, dtype=bool))
    state = _minimized(part, housings, None, GLOBAL_ITERATIONS)
    growing.points[points] = state.points
    growing.rig_from_world = state.rig_from_world
    moved = state.to_scene(scene)
    growing.set_cameras(moved.cameras, moved.cam_from_rig)


def _minimized(
    scene: Scene,
    housings: Housings | None,
    held_frames: Mask | None,
    max_iterations: int,
) -> State:
    """Robust least squares. No port is behind its camera: it is held at zero then."""
    options = LevenbergMarquardtOptions(
        loss="cauchy",
        loss_scale_px=loss_scale_px(scene),
        max_iterations=max_iterations,
        min_relative_decrease=MIN_RELATIVE_DECREASE,
    )
    start = State.from_scene(scene)
    at_zero = np.zeros(len(scene.cameras), dtype=bool)
    while True:
        columns = np.full((len(scene.cameras), BORDER_SIZE), HELD, dtype=np.int64)
        priors = None
        if housings is not None:
            columns = housings.columns(at_zero)
            priors = border_priors(housings.known, housings.settings, columns, 1.0)
        layout = build_layout(scene, columns, held_frames)
        state = minimize(layout, start, options, priors).state
        negative = behind_camera(state.ports)
        if housings is None or not np.any(negative):
            return state
        at_zero |= negative
        ports = state.ports.copy()
        ports[at_zero, DISTANCE] = 0.0
        start = replace(state, ports=ports)


def loss_scale_px(scene: Scene) -> float:
    """Where the robust loss sets in: wide while the ports are still guesses."""
    errors = np.linalg.norm(scene.residuals(), axis=1)
    return max(float(np.nanmedian(errors)), MIN_LOSS_SCALE_PX)
