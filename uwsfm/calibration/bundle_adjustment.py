"""Housing calibration: one joint bundle adjustment of everything that is unknown.

Rig poses, cam_from_rig, port normals and distances (or domes' centres) and the points
move together on the
reprojection error in true pixels. Staging (normals first, then distances) converges
less often, and the nested scheme of Sedlazeck & Koch (BMVC 2011, fig. 5), which is
`strategies.minimize_nested`, reaches no better optimum, far slower.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.problem import (
    CalibrateOptions,
    CalibrateSummary,
    CalibrationResult,
    Covariance,
)
from uwsfm.calibration.strategies import STRATEGIES
from uwsfm.calibration.uncertainty import Optimum, posterior_covariance
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import DOME, FLAT, KIND, FlatPort, NoPort
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import Layout, build_layout
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    LevenbergMarquardtResult,
    Priors,
    Report,
    Stop,
)
from uwsfm.solver.state import State

# Median of the squared length of a 2-D standard normal vector.
MEDIAN_CHI2_2 = 2.0 * float(np.log(2.0))

# No image feature is better than this: exact data must not prune rounding errors.
MIN_NOISE_PX = 0.01


def calibrate(
    scene: Scene,
    *,
    known: Scene | None = None,
    report: Report | None = None,
    **options,
) -> CalibrationResult:
    """Refine the housing, the rig, the poses and the points of a scene.

    Nothing changes in place. The first observed frame and the baseline lengths are
    held: they fix place and scale.

    Args:
        scene: the start values, at least two frames.
        known: a scene with the values that priors are around; default: the start.
        report: called after every step with (iteration, cost).
        **options: fields of `CalibrateOptions`.

    Raises:
        InputError: an unknown option, or a scene that cannot determine what is asked.
        UwsfmError: the solver ended where nothing is physical.
    """
    settings = CalibrateOptions.parsed(options)
    _check(scene, settings)
    began = time.perf_counter()
    everything = np.ones(scene.num_observations, dtype=bool)
    run = _Run(scene, scene if known is None else known, settings, report)
    solved = run.solve(State.from_scene(scene), everything, settings.loss)
    if settings.loss != "l2":
        sigma = solved.robust_sigma()
        solved = run.solve(solved.state, run.prune(solved.state, sigma), "l2", sigma)
    elif run.priors(1.0) is not None:  # they were weighed for a noise of 1 px
        solved = run.solve(solved.state, everything, "l2", solved.sigma())
    summary = _summary(run, solved, time.perf_counter() - began)
    return CalibrationResult(
        scene=solved.state.to_scene(scene),
        inliers=solved.inliers,
        summary=summary,
        covariance=_covariance(run, solved, summary.sigma_px),
        options=settings,
    )


def _check(scene: Scene, settings: CalibrateOptions) -> None:
    if len(scene.cameras) < 2:
        raise InputError(
            "scale is not determined: a scene with one camera has no baseline"
        )
    short = np.linalg.norm(scene.cam_from_rig[1:, 4:], axis=1) == 0.0
    if np.any(short):
        camera = int(np.nonzero(short)[0][0]) + 1
        raise InputError(f"cam_from_rig[{camera}] has no translation: no baseline")
    frames = len(np.unique(scene.frame_idx))
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
    if settings.refine_water_index and all(
        isinstance(port, NoPort) for port in scene.ports
    ):
        raise InputError("refine_water_index: no camera is behind a port")
    other = [c for c, p in enumerate(scene.ports) if not isinstance(p, FlatPort)]
    if other and settings.error_name != "reprojection":
        raise InputError(
            f"error {settings.error_name!r} is defined for flat ports, camera "
            f"{other[0]} has {scene.ports[other[0]]}: use the reprojection error"
        )
    finite = finite_rows(scene.points)[scene.point_idx]
    if not np.all(finite):
        point = int(scene.point_idx[~finite][0])
        raise InputError(f"points[{point}] is not finite but has observations")


@dataclass(frozen=True)
class _Solved:
    """One finished solve, with its points back in the scene's numbering."""

    state: State
    inliers: NDArray[np.bool_]
    layout: Layout
    part: State
    """The state of the points that took part only, as the layout numbers them."""
    used: IndexArray
    result: LevenbergMarquardtResult

    @property
    def degrees_of_freedom(self) -> int:
        layout = self.layout
        unknowns = layout.num_frame_cols + layout.num_border_cols + 3 * len(self.used)
        return 2 * (len(layout.xy) - self.result.num_invalid) - unknowns

    def sigma(self) -> float:
        """Noise of one coordinate, px.

        Raises:
            InputError: there are no more observations than unknowns.
        """
        freedom, squares = self.degrees_of_freedom, self.result.squares
        if freedom <= 0:
            count = len(squares) - self.result.num_invalid
            raise InputError(
                f"{count} observations are too few for what is to be refined"
            )
        return float(np.sqrt(np.nansum(squares) / freedom))

    def robust_sigma(self) -> float:
        """Noise of one coordinate from the median residual, px.

        Residuals are smaller than the noise by the share of fitted parameters.
        """
        count = 2 * len(self.layout.xy)
        median = float(np.nanmedian(self.result.squares))
        share = max(self.degrees_of_freedom, 1) / count
        return float(np.sqrt(median / MEDIAN_CHI2_2 / share))


def in_shared_cells(scene: Scene, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (N,) of points that two or more cameras of one frame observe.

    Args:
        keep: (N,) observations that count.
    """
    cell = scene.point_idx * scene.num_frames + scene.frame_idx
    num_cameras = len(scene.cameras)
    views = np.unique(cell[keep] * num_cameras + scene.camera_idx[keep])
    cells, counts = np.unique(views // num_cameras, return_counts=True)
    return keep & np.isin(cell, cells[counts >= 2])


class _Run:
    """The scene and settings that the solves of one calibration share."""

    def __init__(
        self,
        scene: Scene,
        known: Scene,
        settings: CalibrateOptions,
        report: Report | None,
    ) -> None:
        self.scene = scene
        self.known = known
        self.settings = settings
        self.report = report
        self.at_zero = np.zeros(len(scene.cameras), dtype=bool)
        self.num_iterations = 0

    @property
    def columns(self) -> IndexArray:
        return self.settings.border_columns(self.scene.cameras, self.at_zero)

    def solve(
        self, start: State, keep: NDArray[np.bool_], loss: str, sigma_px: float = 1.0
    ) -> _Solved:
        """Minimise over the observations kept whose points are seen twice.

        No port is behind its camera: a distance that comes out negative is held at
        zero, and the rest is solved again.
        """
        self.at_zero[:] = False
        solved = self._solve_free(start, keep, loss, sigma_px)
        while np.any(negative := _behind_camera(solved.state.ports)):
            self.at_zero |= negative
            ports = solved.state.ports.copy()
            ports[self.at_zero, 3] = 0.0
            solved = self._solve_free(
                replace(solved.state, ports=ports), keep, loss, sigma_px
            )
        _check_ports(solved.state)
        return solved

    def _solve_free(
        self, start: State, keep: NDArray[np.bool_], loss: str, sigma_px: float
    ) -> _Solved:
        if self.settings.error_name == "point_3d":
            keep = keep & in_shared_cells(self.scene, keep)
        counts = np.bincount(self.scene.point_idx[keep], minlength=len(start.points))
        inliers = keep & (counts[self.scene.point_idx] >= 2)
        part, used = self.scene.select(inliers)
        layout = build_layout(part, self.columns)
        options = LevenbergMarquardtOptions(
            error=self.settings.error_name,
            loss=loss,
            loss_scale_px=self.settings.loss_scale_px,
            max_iterations=self.settings.max_iterations,
            initial_damping=self.settings.initial_damping,
            # The robust solve only has to tell outliers apart, and creeps at its end.
            min_relative_decrease=1e-9 if loss == "l2" else 1e-5,
        )
        priors = self.priors(sigma_px)
        part_state = replace(start, points=start.points[used])
        strategy = STRATEGIES[self.settings.strategy]
        result = strategy(layout, part_state, options, priors, self.report)
        self.num_iterations += result.num_iterations
        points = np.full_like(self.scene.points, np.nan)
        points[used] = result.state.points
        return _Solved(
            state=replace(result.state, points=points),
            inliers=inliers,
            layout=layout,
            part=result.state,
            used=used,
            result=result,
        )

    def prune(self, state: State, sigma_px: float) -> NDArray[np.bool_]:
        """Mask (N,) of the observations within prune_sigma of their projections."""
        limit = self.settings.prune_sigma * max(sigma_px, MIN_NOISE_PX)
        residuals = state.to_scene(self.scene).residuals()
        return np.sum(residuals**2, axis=1) <= limit**2  # NaN compares false

    def priors(self, sigma_px: float) -> Priors | None:
        return border_priors(self.known, self.settings, self.columns, sigma_px)


def _behind_camera(ports: Array) -> NDArray[np.bool_]:
    """Mask (C,) of the flat ports whose distance is negative."""
    return (ports[:, KIND] == FLAT) & (ports[:, 3] < 0.0)


def _check_ports(state: State) -> None:
    for camera, row in enumerate(state.ports):
        offset = float(np.linalg.norm(row[:3]))
        if row[KIND] == DOME and not offset < row[3]:
            raise UwsfmError(
                f"the dome of camera {camera} moved away, to a centre {offset:.3f} m "
                f"from the camera at a radius of {row[3]:.3f} m: the start is too far "
                "off, or the images do not determine the centre"
            )
        if row[KIND] == FLAT and not row[2] > 0.0:
            raise UwsfmError(
                f"the port normal of camera {camera} turned away from the water, to "
                f"({row[0]:.3f}, {row[1]:.3f}, {row[2]:.3f}): the start is too far off "
                "or cam_from_rig is wrong"
            )


def _summary(run: _Run, solved: _Solved, seconds: float) -> CalibrateSummary:
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
        converged=solved.result.stop is Stop.CONVERGED,
        initial_rms_px=float(np.sqrt(np.nanmean(before))),
        rms_px=float(np.sqrt(np.mean(squares))),
        mean_error_px=float(np.mean(np.sqrt(squares))),
        sigma_px=sigma_px,
        solve_s=seconds,
    )


def _covariance(run: _Run, solved: _Solved, sigma_px: float) -> Covariance:
    return posterior_covariance(
        Optimum(
            layout=solved.layout,
            state=solved.part,
            used=solved.used,
            num_points=len(solved.state.points),
            columns=run.columns,
            at_zero=run.at_zero,
            # The solve weighed the priors against a guess of the noise.
            priors=run.priors(sigma_px),
            sigma_px=sigma_px,
            image_sizes=np.array([(c.width, c.height) for c in run.scene.cameras]),
            degrees_of_freedom=solved.degrees_of_freedom,
        )
    )
