"""Housing calibration: one joint bundle adjustment of everything that is unknown.

Rig poses, cam_from_rig, port normals and distances (or domes' centres) and the points
move together on the reprojection error in true pixels. Staging (normals first, then
distances) converges less often, and the nested scheme of Sedlazeck & Koch (BMVC 2011,
fig. 5), which is `strategies.minimize_nested`, reaches no better optimum, far slower.
"""

import time
from dataclasses import replace

import numpy as np

from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import CalibrateSummary, CalibrationResult
from uwsfm.calibration.scaling import moved
from uwsfm.calibration.solves import MIN_SIGMA_PX, Run, Solved
from uwsfm.calibration.uncertainty import posterior_covariance
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.scene import Scene
from uwsfm.solver.levenberg_marquardt import Report, Stop

# Of the positions that are believed, after the first choice.
MAX_SELECTIONS = 4


def calibrate(
    scene: Scene,
    *,
    known: Scene | None = None,
    lengths: Lengths | None = None,
    report: Report | None = None,
    **options,
) -> CalibrationResult:
    """Refine the housing, the rig, the poses and the points of a scene.

    Nothing changes in place. The first observed frame and the baseline lengths are
    held: they fix place and scale. One camera has no baseline: its scale comes from
    ``lengths``, or from a housing that is known so well that refraction tells it; if
    neither does, the start's is kept and ``covariance.scale_stddev`` is None. With
    positions among the lengths, the result is in their frame.

    Args:
        scene: the start values, at least two frames.
        known: a scene with the values that priors are around; default: the start.
        lengths: scale bars, distances between frames, positions.
        report: called with (0, cost) at the start of every solve, and with
            (iteration, cost) after every step.
        **options: fields of `CalibrateOptions`.

    Raises:
        InputError: an unknown option, or a scene that cannot determine what is asked.
        UwsfmError: the solver ended where nothing is physical.
    """
    settings = CalibrateOptions.parsed(options)
    _check(scene, settings, lengths)
    began = time.perf_counter()
    everything = np.ones(scene.num_observations, dtype=bool)
    outside = Outside(scene, lengths or Lengths())
    run = Run(scene, scene if known is None else known, settings, outside, report)
    solved = run.solve(outside.start(scene), everything, settings.loss)
    keep, sigma = everything, None
    if settings.loss != "l2":
        sigma = solved.robust_sigma()
        keep = run.prune(solved.state, sigma)
    elif run.has_priors:  # they were weighed for a noise of 1 px
        sigma = solved.sigma()
    if sigma is not None:
        outside.select(solved.state)
        solved = run.solve(solved.state, keep, "l2", sigma)
        for _ in range(MAX_SELECTIONS):
            if not outside.select(solved.state):
                break
            solved = run.solve(solved.state, keep, "l2", sigma)
        solved = run.with_free_scale(solved, keep, max(sigma, MIN_SIGMA_PX))
    return _result(run, solved, time.perf_counter() - began)


def _result(run: Run, solved: Solved, seconds: float) -> CalibrationResult:
    """What was found, moved to the frame of the positions if there are any."""
    outside, summary = run.outside, _summary(run, solved, seconds)
    posterior = posterior_covariance(run.optimum(solved, summary.sigma_px))
    covariance = posterior.covariance
    scene = solved.state.to_scene(run.scene)
    if outside.navigation:
        nav_from_world = outside.nav_from_world(solved.state)
        scene = moved(scene, nav_from_world)
        turn = rigid3.rotmat_from_quat(nav_from_world[:4])
        covariance = replace(covariance, points=turn @ covariance.points @ turn.T)
    return CalibrationResult(
        scene=scene,
        inliers=solved.inliers,
        summary=summary,
        covariance=covariance,
        options=run.settings,
        lengths=outside.length_fit(solved.state),
        positions=outside.position_fit(solved.state, posterior.navigation),
        entered=outside.entered(),
    )


def _check(scene: Scene, settings: CalibrateOptions, lengths: Lengths | None) -> None:
    plain = settings.strategy == "joint" and settings.error_name == "reprojection"
    given = lengths is not None and lengths.give_scale
    if (given or len(scene.cameras) == 1) and not plain:
        raise InputError(
            "one camera, and lengths from outside, need the joint strategy and the "
            "reprojection error"
        )
    short = np.linalg.norm(scene.cam_from_rig[1:, 4:], axis=1) == 0.0
    if np.any(short):
        camera = int(np.nonzero(short)[0][0]) + 1
        raise InputError(f"cam_from_rig[{camera}] has no translation: no baseline")
    frames = len(np.unique(scene.frame_idx))
    if frames < 2 and len(scene.cameras) == 1:
        raise InputError(f"{frames} frame of one camera: there is no depth to adjust")
    if frames < 2 and np.any(settings.refine_distances):
        raise InputError(
            f"the distance of a port cannot be estimated from {frames} frame: any "
            "distance fits one stereo pair; add frames or set refine_distances=False"
        )
    if frames < 2 and settings.error_name == "point_3d":
        raise InputError(
            f"error 'point_3d' tells nothing from {frames} frame: its points can be "
            "where the rays meet, whatever the ports; add frames or use another error"
        )
    bare = all(not port.refracts for port in scene.ports)
    for each in OF_PORTS:
        wanted = np.any(settings.refines(each, len(scene.cameras)))
        if bare and wanted and each.refine is not None and each.refine.flag:
            raise InputError(f"{each.refine.field}: no camera is behind a port")
    other = [c for c, p in enumerate(scene.ports) if not p.has("normal")]
    if other and settings.error_name != "reprojection":
        raise InputError(
            f"error {settings.error_name!r} is defined for flat ports, camera "
            f"{other[0]} has {scene.ports[other[0]]}: use the reprojection error"
        )
    finite = finite_rows(scene.points)[scene.point_idx]
    if not np.all(finite):
        point = int(scene.point_idx[~finite][0])
        raise InputError(f"points[{point}] is not finite but has observations")


def _summary(run: Run, solved: Solved, seconds: float) -> CalibrateSummary:
    scene = run.scene
    sigma_px = solved.sigma()
    before = np.sum(scene.residuals() ** 2, axis=1)
    squares = solved.result.squares[np.isfinite(solved.result.squares)]
    return CalibrateSummary(
        num_frames=len(np.unique(solved.layout.cell_frame)),
        num_points=len(solved.used),
        num_observations=len(solved.layout.xy),
        num_outliers=scene.num_observations - int(np.count_nonzero(solved.inliers)),
        num_invalid=solved.result.num_invalid,
        num_iterations=run.num_iterations,
        solves=tuple(run.solves),
        converged=solved.result.stop is Stop.CONVERGED,
        initial_rms_px=float(np.sqrt(np.nanmean(before))),
        rms_px=float(np.sqrt(np.mean(squares))),
        mean_error_px=float(np.mean(np.sqrt(squares))),
        sigma_px=sigma_px,
        solve_s=seconds,
    )
