"""The solves of one calibration: robust, least squares, at the best scale."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.calibration.priors import border_priors, with_terms
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import SolveHistory
from uwsfm.calibration.strategies import STRATEGIES
from uwsfm.calibration.uncertainty import Optimum, held_length_stddev
from uwsfm.errors import InputError, UwsfmError
from uwsfm.models.ports.port import behind_camera, kind_of_row, rows_with
from uwsfm.models.ports.row import DISTANCE
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import HELD, Layout, build_layout
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    LevenbergMarquardtResult,
    Priors,
    Report,
)
from uwsfm.solver.state import State

# Median of the squared length of a 2-D standard normal vector.
MEDIAN_CHI2_2 = 2.0 * float(np.log(2.0))

# No image feature is better than this: exact data must not prune rounding errors.
MIN_NOISE_PX = 0.01

# Exact data have no noise, and what is known beside them must weigh something.
MIN_SIGMA_PX = 1e-6

MAX_SCALE_STEPS = 10
SCALE_TOLERANCE = 0.03
"""Standard deviations: poses bend with the scale, and are better known than it."""


@dataclass(frozen=True)
class Solved:
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
        unknowns = layout.num_unknowns + 3 * len(self.used)
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


class Run:
    """The scene and settings that the solves of one calibration share."""

    def __init__(
        self,
        scene: Scene,
        known: Scene,
        settings: CalibrateOptions,
        outside: Outside,
        report: Report | None,
    ) -> None:
        self.scene = scene
        self.known = known
        self.settings = settings
        self.outside = outside
        self.report = report
        self.at_zero = np.zeros(len(scene.cameras), dtype=bool)
        self.num_iterations = 0
        self.solves: list[SolveHistory] = []

    @property
    def columns(self) -> IndexArray:
        return self.settings.border_columns(self.scene.cameras, self.at_zero)

    def solve(
        self, start: State, keep: NDArray[np.bool_], loss: str, sigma_px: float = 1.0
    ) -> Solved:
        """Minimise over the observations kept whose points are seen twice.

        No port is behind its camera: a distance that comes out negative is held at
        zero, and the rest is solved again.
        """
        self.at_zero[:] = False
        solved = self._solve_free(start, keep, loss, sigma_px)
        while np.any(negative := behind_camera(solved.state.ports)):
            self.at_zero |= negative
            ports = solved.state.ports.copy()
            ports[self.at_zero, DISTANCE] = 0.0
            solved = self._solve_free(
                replace(solved.state, ports=ports), keep, loss, sigma_px
            )
        _check_ports(solved.state)
        _check_bounds(solved.state, self.columns)
        return solved

    def _solve_free(
        self, start: State, keep: NDArray[np.bool_], loss: str, sigma_px: float
    ) -> Solved:
        if self.settings.error_name == "point_3d":
            keep = keep & in_shared_cells(self.scene, keep)
        counts = np.bincount(self.scene.point_idx[keep], minlength=len(start.points))
        inliers = keep & (counts[self.scene.point_idx] >= 2)
        part, used = self.scene.select(inliers)
        layout = build_layout(
            part,
            self.columns,
            navigation=self.outside.navigation,
            num_lengths=self.outside.num_lengths,
        )
        options = LevenbergMarquardtOptions(
            error=self.settings.error_name,
            loss=loss,
            loss_scale_px=self.settings.loss_scale_px,
            max_iterations=self.settings.max_iterations,
            initial_damping=self.settings.initial_damping,
            # The robust solve only has to tell outliers apart, and creeps at its end.
            min_relative_decrease=1e-9 if loss == "l2" else 1e-5,
        )
        priors = self.priors(used, np.unique(part.frame_idx), sigma_px)
        part_state = replace(start, points=start.points[used])
        strategy, costs = STRATEGIES[self.settings.strategy], []

        def noted(iteration: int, cost: float) -> None:
            costs.append(cost)
            if self.report is not None:
                self.report(iteration, cost)

        result = strategy(layout, part_state, options, priors, noted)
        self.num_iterations += result.num_iterations
        history = SolveHistory(
            error=options.error,
            loss=loss,
            num_observations=len(layout.xy),
            costs=tuple(costs),
        )
        self.solves.append(history)
        points = np.full_like(self.scene.points, np.nan)
        points[used] = result.state.points
        return Solved(
            state=replace(result.state, points=points),
            inliers=inliers,
            layout=layout,
            part=result.state,
            used=used,
            result=result,
        )

    def prune(self, state: State, sigma_px: float) -> NDArray[np.bool_]:
        """Mask (N,) of the observations within prune_sigma of their projections.

        A point moves to its observations: of the noise of n it leaves (2n - 3) / 2n,
        half of the gap between two. Fewer dimensions have longer tails: the cube root
        cuts off as many of two observations as the whole limit of many.
        """
        limit = self.settings.prune_sigma * max(sigma_px, MIN_NOISE_PX)
        counts = np.bincount(self.scene.point_idx, minlength=self.scene.num_points)
        limits = limit * np.cbrt(1.0 - 1.5 / np.maximum(counts, 2))
        residuals = state.to_scene(self.scene).residuals()
        squares = np.sum(residuals**2, axis=1)
        keep = squares <= limits[self.scene.point_idx] ** 2  # NaN compares false
        keep[self.outside.lengths.clicked] = True
        return keep

    @property
    def has_priors(self) -> bool:
        own = border_priors(self.known, self.settings, self.columns, 1.0)
        return own is not None or self.outside.has_terms

    def priors(
        self, used: IndexArray, frames: IndexArray, sigma_px: float
    ) -> Priors | None:
        own = border_priors(self.known, self.settings, self.columns, sigma_px)
        terms = self.outside.terms(used, frames, max(sigma_px, MIN_SIGMA_PX))
        return with_terms(own, terms, State.from_scene(self.known))

    def optimum(self, solved: Solved, sigma_px: float) -> Optimum:
        frames = np.unique(solved.layout.cell_frame).astype(np.int64)
        return Optimum(
            layout=solved.layout,
            state=solved.part,
            used=solved.used,
            num_points=len(solved.state.points),
            columns=self.columns,
            at_zero=self.at_zero,
            # The solve weighed the priors against a guess of the noise.
            priors=self.priors(solved.used, frames, sigma_px),
            sigma_px=sigma_px,
            image_sizes=np.array([(c.width, c.height) for c in self.scene.cameras]),
            degrees_of_freedom=solved.degrees_of_freedom,
            scale_ends=self.outside.ends,
            scale_held=self.outside.hold_scale,
        )

    @property
    def _scales_with_port(self) -> bool:
        """Whether a port may grow with everything else: then nothing tells the scale,
        for the glass, which does not, hardly shows."""
        ports, free = State.from_scene(self.scene).ports, self.columns != HELD
        settings = self.settings
        plane = rows_with(ports, "distance") & (settings.distance_stddev_m is None)
        dome = rows_with(ports, "center") & (settings.center_stddev_m is None)
        moving = plane & free[:, border.DISTANCE] | dome & free[:, border.CENTER][:, 0]
        return bool(np.any(moving))

    def with_free_scale(
        self, solved: Solved, keep: NDArray[np.bool_], sigma_px: float
    ) -> Solved:
        """The best scale, if refraction tells it; else the solution as given.

        The optimum of every scale bends with it, and steps along that valley are tiny:
        the scale is stepped by Newton's method, and the rest solved again at each.
        """
        if self._scales_with_port:
            return solved
        given, held, at_zero = solved, self.outside.held_m, self.at_zero.copy()
        pruned = self.settings.loss == "l2"
        for _ in range(MAX_SCALE_STEPS if self.outside.hold_scale else 0):
            stddev = self._scale_stddev(solved, sigma_px)
            factor = self.outside.scale_factor(solved.state, stddev)
            if factor is None:
                break
            if abs(factor - 1.0) < SCALE_TOLERANCE * stddev:
                if pruned:
                    self.outside.hold_scale = False
                    return replace(solved, layout=self._free(solved.layout))
                pruned = True  # once more, as outliers were told at another scale
                keep = self.prune(solved.state, sigma_px)
            state = self.outside.rescaled(solved.state, factor)
            solved = self.solve(state, keep, "l2", sigma_px)
        self.outside.held_m, self.at_zero = held, at_zero
        return given

    def _free(self, layout: Layout) -> Layout:
        return layout._replace(num_lengths=layout.num_lengths - 1)

    def _scale_stddev(self, solved: Solved, sigma_px: float) -> float:
        """Of the scale, relative, with nothing held; infinite if it is open."""
        free = replace(solved, layout=self._free(solved.layout))
        self.outside.hold_scale = False
        stddev = held_length_stddev(self.optimum(free, sigma_px))
        self.outside.hold_scale = True
        return stddev


def _check_bounds(state: State, columns: IndexArray) -> None:
    """Refuse what was refined of the glass or the water and has left its bounds."""
    for each in OF_PORTS:
        if each.refine is None or each.refine.flag is None or each.prior is None:
            continue
        low, high = each.bounds
        values = state.ports[:, each.column]
        free = columns[:, each.first] != HELD
        for camera in np.flatnonzero(free & ~((low <= values) & (values <= high))):
            raise UwsfmError(
                f"the {each.name} of camera number {camera + 1} came out at "
                f"{values[camera]:.4g} {each.unit.in_files}".rstrip()
                + f", beyond its bounds, {low:g} to {high:g}: the images do not "
                f"determine it; give a prior, {each.prior.field}, or hold it"
            )


def _check_ports(state: State) -> None:
    for camera, row in enumerate(state.ports):
        wrong = kind_of_row(row).departed(row, f"camera number {camera + 1}")
        if wrong:
            raise UwsfmError(wrong)
