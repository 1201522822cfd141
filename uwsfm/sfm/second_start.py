"""A second start for ports that moved far away, which may be a second minimum.

On a straight, level track port distances, relief and tilts can be traded against each
other, and the cost has minima at distances of some millimetres and of some decimetres.
From there each looks like the optimum, with a standard deviation of its own curvature.
A handful of outliers decide which of them the robust solve falls into. With the
distances held where they were given, the same solve finds the outliers; without those,
and from there, everything together ends in the minimum near the given ports, if there
is one. The better of both is kept.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.result import CalibrationResult
from uwsfm.errors import UwsfmError
from uwsfm.models.ports.port import PlanePort, Port
from uwsfm.scene import Scene

FAR_FACTOR, FAR_M = 3.0, 0.02
"""A distance that has changed by both is worth a second start, which takes about twice
as long as the first."""

Keep = NDArray[np.bool_]
Solve = Callable[..., CalibrationResult]


def better_start(
    result: CalibrationResult,
    scene: Scene,
    keep: Keep,
    ports: Sequence[Port],
    solve: Solve,
) -> tuple[CalibrationResult, Keep]:
    """The better of a result and of what a second start finds, and its observations.

    Args:
        result: Over the observations of ``scene`` that were kept.
        scene: What it started from.
        keep: (N,) mask of them.
        ports: As given, one per camera.
        solve: Called with a scene, a mask of its observations, and options by name.
    """
    pairs = zip(ports, result.scene.ports, strict=True)
    if not any(_moved_far(before, after) for before, after in pairs):
        return result, keep
    try:
        held = solve(_with_ports(scene, ports), keep, refine_distances=False)
        inside = keep.copy()
        inside[np.flatnonzero(keep)[~held.inliers]] = False
        points = scene.points.copy()
        seen = np.unique(scene.point_idx[keep])
        known = np.isfinite(held.scene.points).all(axis=1)
        points[seen[known]] = held.scene.points[known]
        nearer = replace(
            scene,
            cameras=held.scene.cameras,
            cam_from_rig=held.scene.cam_from_rig,
            rig_from_world=held.scene.rig_from_world,
            points=points,
        )
        other = solve(nearer, inside)
    except UwsfmError:  # nothing is there to be found
        return result, keep
    limit = (result.options.prune_sigma * result.summary.sigma_px) ** 2
    count = int(np.count_nonzero(keep))
    if _cost(other, count, limit) < _cost(result, count, limit):
        return other, inside
    return result, keep


def _moved_far(before: Port, after: Port) -> bool:
    if not (isinstance(before, PlanePort) and isinstance(after, PlanePort)):
        return False
    low, high = sorted((before.distance, after.distance))
    return high > FAR_FACTOR * low and high - low > FAR_M


def _with_ports(scene: Scene, ports: Sequence[Port]) -> Scene:
    pairs = zip(scene.cameras, ports, strict=True)
    return replace(
        scene, cameras=tuple(camera.with_port(port) for camera, port in pairs)
    )


def _cost(result: CalibrationResult, count: int, limit: float) -> float:
    """Squared residuals, and for each of ``count`` observations that was left out what
    an outlier has at least."""
    kept = result.summary.num_observations
    return kept * result.summary.rms_px**2 + (count - kept) * limit
