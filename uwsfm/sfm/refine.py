"""From the perspective start to the refractive optimum."""

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.clicks import check_clicks, with_click_noise
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.scaling import scaled, start_scale
from uwsfm.errors import UwsfmError
from uwsfm.models.ports.dispatch import scalar_nouns
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.scene_points import agreeing_points, good_observations
from uwsfm.sfm.second_start import better_start

logger = logging.getLogger(__name__)

# The start's ports are guesses: an error this large is a wrong match all the same.
MAX_START_ERROR_PX = 50.0

# Solves after the first: one, as a rule; more while each brings in many observations.
MAX_ROUNDS = 4
WORTH_ANOTHER = 1.3

# After the first solve the model is right, and an inlier has the error of a feature.
MAX_ERROR_PX = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Refined:
    """A refractive optimum over the observations that were kept."""

    scene: Scene
    kept: IndexArray
    """(N',) index of each kept observation among those given."""
    calibration: CalibrationResult
    """Of ``scene``: its masks and covariances use ``scene``'s indices."""
    start_rms_px: float
    """True error of the kept observations before the first solve, px."""
    num_tested: int
    """Observations given, within what the calibrations in air covered."""


def rig_options(rig: Rig) -> dict[str, Any]:
    """What a rig file says of the calibration, as fields of `CalibrateOptions`."""
    return {
        "refine_normals": tuple(camera.refine_normal for camera in rig.cameras),
        "refine_distances": tuple(camera.refine_distance for camera in rig.cameras),
        "refine_centers": tuple(camera.refine_center for camera in rig.cameras),
        "refine_cam_from_rig": rig.refine_cam_from_rig,
        "baseline_stddev_m": rig.baseline_stddev_m,
        "given": rig.given_accuracy(),
    }


def refine_scene(
    scene: Scene,
    rig: Rig,
    progress: Progress = silent,
    *,
    known: Scene | None = None,
    lengths: Lengths | None = None,
    **options: Any,
) -> Refined:
    """Refractive bundle adjustment, twice: the second with all tracks tested again; and
    again where the start was so far off that many more agree each time.

    Points are triangulated from the water rays before each solve, so that a pinhole's
    points are never kept; observations are tested by their true pixel errors.

    Args:
        scene: cameras with the ports' initial values, poses and tracks of the
            perspective start; its points are not used.
        rig: what to refine, and how well the baseline is known.
        progress: called as the solver iterates.
        known: has the cameras and the rig that priors are around; default: ``scene``.
        lengths: what is known beside the baselines; what was clicked for it is no part
            of the result.
        **options: further fields of `CalibrateOptions`.

    Raises:
        UwsfmError: nothing is left to adjust, or the result is not physical.
    """
    for noun in scalar_nouns(scene.ports):
        logger.info(
            "%s: this kind of port has no vectorised kernels; the adjustment computes "
            "its points one by one, which takes longer",
            noun,
        )
    given = lengths or Lengths()
    calibrated = within_valid_radius(scene, rig)
    calibrated[given.clicked] = True
    start = agreeing_points(scene, calibrated, MAX_START_ERROR_PX)
    start = _at_scale(start, given, calibrated)
    solver = _Solver(
        known=known or start,
        lengths=lengths,
        calibrated=calibrated,
        options={**rig_options(rig), **options},
        progress=progress,
    )
    last, keep = solver.solved_in_rounds(start)
    clicks = np.isin(np.nonzero(keep)[0], given.clicked)
    found = last.inliers & ~clicks
    kept = np.nonzero(keep)[0][found]
    final, still = last.scene.select(found)
    before = start.residuals()[kept]
    return Refined(
        scene=final,
        kept=kept,
        calibration=_compact(last, final, still, clicks),
        start_rms_px=float(np.sqrt(np.nanmean(np.sum(before**2, axis=1)))),
        num_tested=int(np.count_nonzero(calibrated)),
    )


@dataclass(kw_only=True, eq=False)
class _Solver:
    """Solves a scene as often as that brings in observations."""

    known: Scene
    """Has the cameras and the rig that priors are around."""
    lengths: Lengths | None
    calibrated: NDArray[np.bool_]
    """(N,) observations that the calibrations in air covered, and clicks."""
    options: dict[str, Any]
    progress: Progress
    steps: int = 0
    """Of all solves together."""

    def solved_in_rounds(
        self, scene: Scene
    ) -> tuple[CalibrationResult, NDArray[np.bool_]]:
        """The last solve, with the history of all, and which observations it had."""
        keep = good_observations(scene, MAX_START_ERROR_PX) & self.calibrated
        last, keep = self._solved(scene, keep)
        solves = last.summary.solves
        for number in range(MAX_ROUNDS):
            trusted = self._trusted(scene, last, keep)
            scene = _with_result(scene, last)
            scene = agreeing_points(scene, trusted, MAX_START_ERROR_PX)
            agreeing = good_observations(scene, MAX_ERROR_PX) & self.calibrated
            num_used = np.count_nonzero(last.inliers)
            if number and np.count_nonzero(agreeing) < WORTH_ANOTHER * num_used:
                break
            check_clicks(self.lengths or Lengths(), scene)
            last, keep = self._solved(scene, agreeing)
            solves += last.summary.solves
        return replace(last, summary=replace(last.summary, solves=solves)), keep

    def _trusted(
        self, scene: Scene, last: CalibrationResult, keep: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """(N,) observations that shape the points of the next solve."""
        trusted = np.zeros_like(keep)
        trusted[np.nonzero(keep)[0][last.inliers]] = True
        # Points that the start was too far off for get another chance, as a whole.
        lost = np.bincount(scene.point_idx[trusted], minlength=scene.num_points) < 2
        return trusted | (lost[scene.point_idx] & self.calibrated)

    def _solved(
        self, scene: Scene, keep: NDArray[np.bool_]
    ) -> tuple[CalibrationResult, NDArray[np.bool_]]:
        found = self._once(scene, keep)
        return better_start(found, scene, keep, self.known.ports, self._once)

    def _once(
        self, scene: Scene, keep: NDArray[np.bool_], **more: Any
    ) -> CalibrationResult:
        inside = None
        if self.lengths is not None:
            keep[self.lengths.clicked] = True
        part, used = scene.select(_require(keep, scene))
        if self.lengths is not None:
            inside = with_click_noise(self.lengths, scene).in_part(keep, used)
        how = {**self.options, **more}
        return calibrate(
            part, known=self.known, lengths=inside, report=self._report, **how
        )

    def _report(self, iteration: int, cost: float) -> None:
        self.steps += 1
        self.progress("refractive bundle adjustment", self.steps, None)


def without_empty_frames(refined: Refined) -> tuple[Refined, IndexArray]:
    """Without the frames that no observation is left of, and which frames are left."""
    scene, calibration = refined.scene, refined.calibration
    frames, frame_idx = np.unique(scene.frame_idx, return_inverse=True)
    smaller = replace(
        scene,
        rig_from_world=scene.rig_from_world[frames],
        frame_idx=frame_idx.astype(np.int64),
    )
    covariance = replace(
        calibration.covariance, frames=calibration.covariance.frames[frames]
    )
    positions, entered = calibration.positions, calibration.entered
    bars = calibration.bars
    calibration = replace(
        calibration,
        scene=smaller,
        covariance=covariance,
        positions=None if positions is None else positions.in_frames(frames),
        entered=None if entered is None else entered.in_frames(frames),
        bars=None if bars is None else _in_frames(bars, frames),
    )
    return replace(refined, scene=smaller, calibration=calibration), frames


def _in_frames(bars: Scene, frames: IndexArray) -> Scene:
    """Clicks in some frames only, numbered as they are there; every point stays."""
    there = np.isin(bars.frame_idx, frames)
    return replace(
        bars,
        rig_from_world=bars.rig_from_world[frames],
        camera_idx=bars.camera_idx[there],
        frame_idx=np.searchsorted(frames, bars.frame_idx[there]),
        point_idx=bars.point_idx[there],
        xy=bars.xy[there],
    )


def _at_scale(scene: Scene, lengths: Lengths, calibrated: NDArray[np.bool_]) -> Scene:
    """The scene of one camera, at the scale of its lengths."""
    if len(scene.cameras) > 1 or not lengths.give_scale:
        return scene
    larger = scaled(scene, start_scale(scene, lengths))
    return agreeing_points(larger, calibrated, MAX_START_ERROR_PX)


def _with_result(scene: Scene, result: CalibrationResult) -> Scene:
    """The whole scene with the cameras and poses of a result over a part of it."""
    return replace(
        scene,
        cameras=result.scene.cameras,
        cam_from_rig=result.scene.cam_from_rig,
        rig_from_world=result.scene.rig_from_world,
    )


def within_valid_radius(scene: Scene, rig: Rig) -> NDArray[np.bool_]:
    """Mask (N,) of the observations that the calibrations in air covered."""
    covered = np.ones(scene.num_observations, dtype=bool)
    for index, camera in enumerate(rig.cameras):
        rows = scene.camera_idx == index
        covered[rows] = camera.covers(scene.xy[rows])
    return covered


def _require(keep: NDArray[np.bool_], scene: Scene) -> NDArray[np.bool_]:
    if np.count_nonzero(keep) < 100 or len(np.unique(scene.frame_idx[keep])) < 2:
        raise UwsfmError(
            f"only {np.count_nonzero(keep)} observations agree with the rig after "
            "triangulation: check cam_from_rig and the ports in the rig file"
        )
    return keep


def _compact(
    result: CalibrationResult,
    scene: Scene,
    used: IndexArray,
    clicks: NDArray[np.bool_],
) -> CalibrationResult:
    """A result in the numbering of the scene that kept its inliers only.

    Args:
        result: of the larger scene.
        scene: which has only features.
        used: (P',) index of each of its points in the larger one.
        clicks: (N,) observations of the larger one that are ends of scale bars.
    """
    covariance = replace(result.covariance, points=result.covariance.points[used])
    entered, bars = result.entered, None
    if entered is not None and entered.between_points is not None and clicks.any():
        bars, ends = result.scene.select(clicks)
        known = entered.between_points
        first = scene.num_points + np.searchsorted(ends, known.ends)
        entered = replace(
            entered,
            between_points=replace(known, ends=first),
            clicked=np.empty(0, dtype=np.int64),
            click_stddevs_px=None,
        )
    return replace(
        result,
        scene=scene,
        inliers=np.ones(scene.num_observations, dtype=bool),
        covariance=covariance,
        entered=entered,
        bars=bars,
    )
