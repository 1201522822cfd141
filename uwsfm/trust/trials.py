"""One experiment: a rig adjusted to observations, from a fresh start.

Ports, lenses and placement start from the rig of the trial, never from a result, which
a wrong rig has bent; only the poses of the frames are taken from there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.solves import Run
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.refine import rig_options
from uwsfm.sfm.scene_points import retriangulated

TRIMMED = 0.9
"""Share of the observations that an RMS is of, the best ones: wrong matches must not
decide between rigs."""
MAX_START_PX = 300.0
"""A start may be so far off; what is farther waits for the second round."""
UNEXPLAINED_PX = 1e3
"""Counts for an observation that cannot be projected at all."""
ROUNDS = ((1e-2, 12), (1e-3, 25))
"""Damping and iterations: the first is from far away."""
MAX_POINTS, MAX_FRAMES = 400, 40
MIN_OBSERVATIONS = 60


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How well a rig explains observations."""

    scene: Scene
    """Adjusted; points are those of the part that was tried."""
    squares: Array
    """(N,) squared errors, px^2; `UNEXPLAINED_PX` squared where there is none."""
    unknowns: int
    """Coordinates of points and poses that were adjusted to them."""
    turn_deg: float
    """The largest turn of a camera from the placement of the trial's rig."""
    swing_deg: float
    """The largest turn of a baseline from there."""
    focals: tuple[Array, Array] | None = None
    """(C,) each, px: before and after a change of zoom."""

    @property
    def rms_px(self) -> float:
        """Root mean square error of the best `TRIMMED` observations, corrected for the
        number of unknowns: tracks that are cut in two fit better, right or wrong."""
        count = 2 * len(self.squares)
        share = max(count - self.unknowns, 0.05 * count) / count
        best = np.sort(self.squares)[: max(int(TRIMMED * len(self.squares)), 1)]
        return float(np.sqrt(np.mean(best) / share))

    def distances_m(self) -> list[float]:
        """Of the flat ports."""
        return [p.distance for p in self.scene.ports if isinstance(p, PlanePort)]

    def tilts_deg(self) -> list[float]:
        """Of the flat ports, against the optical axis."""
        normals = [p.normal for p in self.scene.ports if isinstance(p, PlanePort)]
        return [float(np.degrees(np.arccos(min(n[2], 1.0)))) for n in normals]


def adjusted(scene: Scene, rig: Rig, **options: Any) -> Fit | None:
    """Adjust a rig to observations.

    Args:
        scene: observations, and poses of the frames to start from; neither its points
            nor its cameras are used.
        rig: lenses, ports and placement to start from, and what to refine.
        **options: further fields of `CalibrateOptions`.

    Returns:
        None where the adjustment comes to no end that is physical.
    """
    placement = scene.cam_from_rig if rig.cam_from_rig is None else rig.cam_from_rig
    start = replace(
        _at_length(scene, placement),
        cameras=rig.refractive_cameras(),
        cam_from_rig=placement,
        points=np.full_like(scene.points, np.nan),
    )
    everything = np.ones(scene.num_observations, dtype=bool)
    try:
        for damping, iterations in ROUNDS:
            settings = CalibrateOptions.parsed(
                {
                    **rig_options(without_accuracy(rig)),
                    **options,
                    "initial_damping": damping,
                    "max_iterations": iterations,
                }
            )
            start = _solved(retriangulated(start, everything), settings, rig)
    except (UwsfmError, np.linalg.LinAlgError):
        return None
    return fit_of(retriangulated_where_lost(start), placement)


def fit_of(scene: Scene, placement: Array) -> Fit:
    """How well a scene fits its observations, and a placement (C, 7) its own."""
    squares = np.sum(scene.residuals() ** 2, axis=1)
    squares = np.where(np.isfinite(squares), squares, UNEXPLAINED_PX**2)
    turns = rigid3.compose(scene.cam_from_rig, rigid3.inverse(placement))
    a, b = (rigid3.inverse(poses)[1:, 4:] for poses in (scene.cam_from_rig, placement))
    swing = np.arctan2(
        np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ci,ci->c", a, b)
    )
    return Fit(
        scene=scene,
        squares=np.minimum(squares, UNEXPLAINED_PX**2),
        unknowns=3 * len(np.unique(scene.point_idx)) + 6 * scene.num_frames,
        turn_deg=float(np.degrees(rigid3.rotation_angle(turns)).max()),
        swing_deg=float(np.degrees(swing).max(initial=0.0)),
    )


def without_accuracy(rig: Rig) -> Rig:
    """The rig with the accuracy that is assumed: a trial may exchange the lens or the
    port that a stated one is of."""
    cameras = tuple(replace(c, accuracy=CameraAccuracy()) for c in rig.cameras)
    return replace(rig, cameras=cameras, accuracy=RigAccuracy())


def _at_length(scene: Scene, placement: Array) -> Scene:
    """The scene with its frames as far apart as a baseline of another length has it."""
    if len(placement) < 2:
        return scene
    lengths = [float(np.linalg.norm(p[1, 4:])) for p in (placement, scene.cam_from_rig)]
    poses = scene.rig_from_world.copy()
    poses[:, 4:] *= lengths[0] / lengths[1]
    return replace(scene, rig_from_world=poses)


def retriangulated_where_lost(scene: Scene) -> Scene:
    """The scene with points for the tracks that took no part in a solve."""
    lost = ~finite_rows(scene.points)
    if not lost.any():
        return scene
    anew = retriangulated(scene, np.ones(scene.num_observations, dtype=bool))
    points = np.where(lost[:, None], anew.points, scene.points)
    return replace(scene, points=points)


def _solved(scene: Scene, settings: CalibrateOptions, rig: Rig) -> Scene:
    keep = _usable(scene)
    if np.count_nonzero(keep) < MIN_OBSERVATIONS:
        raise UwsfmError("too few observations start near their points")
    used, renumber = np.unique(scene.point_idx[keep], return_inverse=True)
    part = replace(
        scene,
        points=scene.points[used],
        camera_idx=scene.camera_idx[keep],
        frame_idx=scene.frame_idx[keep],
        point_idx=renumber.astype(np.int64),
        xy=scene.xy[keep],
    )
    # What is known beforehand is known of the rig's numbers, not of the first round's.
    known = replace(part, cameras=rig.refractive_cameras())
    if rig.cam_from_rig is not None:
        known = replace(known, cam_from_rig=rig.cam_from_rig)
    run = Run(part, known, settings, Outside(part, Lengths()), None)
    every = np.ones(part.num_observations, dtype=bool)
    solved = run.solve(run.outside.start(part), every, "cauchy")
    result = solved.state.to_scene(part)
    points = np.full_like(scene.points, np.nan)
    points[used] = result.points
    return replace(
        scene,
        cameras=result.cameras,
        cam_from_rig=result.cam_from_rig,
        rig_from_world=result.rig_from_world,
        points=points,
    )


def _usable(scene: Scene) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(scene.residuals(), axis=1) <= MAX_START_PX
    counts = np.bincount(scene.point_idx[near], minlength=scene.num_points)
    return near & (counts[scene.point_idx] >= 2)


def thinned(scene: Scene, seed: int = 0) -> tuple[Scene, IndexArray]:
    """A part of a scene that shows as much: neighbouring frames, points seen often.

    Returns:
        The part, and which frames it has.
    """
    used = np.unique(scene.frame_idx)
    if len(used) > MAX_FRAMES:
        first = (len(used) - MAX_FRAMES) // 2
        used = used[first : first + MAX_FRAMES]
    inside = np.isin(scene.frame_idx, used)
    counts = np.bincount(scene.point_idx[inside], minlength=scene.num_points)
    rng = np.random.default_rng(seed)
    weight = np.minimum(counts, 8) * rng.uniform(0.5, 1.0, len(counts))
    chosen = np.argsort(-weight, kind="stable")[:MAX_POINTS]
    chosen = chosen[counts[chosen] >= 2]
    smaller, _ = scene.select(inside & np.isin(scene.point_idx, chosen))
    frames, frame_idx = np.unique(smaller.frame_idx, return_inverse=True)
    part = replace(
        smaller,
        rig_from_world=smaller.rig_from_world[frames],
        frame_idx=frame_idx.astype(np.int64),
    )
    return part, frames
