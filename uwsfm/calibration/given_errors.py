"""What errors of the given numbers do to the estimates, without solving again.

The gradient g(x, p) vanishes at the optimum, so a given number p that is off by dp
moves the estimate x by dx = -H_xx^-1 H_xp dp: one linearisation answers for all, and
with C the covariance of what is given, the estimates' own grows by A C A^T, A = dx/dp.
"""

from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.assumed import assumed_accuracy
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.calibration.priors import lens_priors
from uwsfm.calibration.relinearized import reopened
from uwsfm.calibration.result import CalibrationResult, CameraCovariance, InAll
from uwsfm.calibration.scale import by_unknowns, scale_slope
from uwsfm.calibration.uncertainty import (
    Optimum,
    camera_covariance,
    camera_variances,
    likelihood,
)
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals import border
from uwsfm.scene import IndexArray
from uwsfm.solver.layout import HELD, Layout, with_columns
from uwsfm.solver.levenberg_marquardt import suitable_blas
from uwsfm.solver.linear import schur
from uwsfm.solver.linear.quasidefinite import symmetric
from uwsfm.solver.linear.reduced_factor import coupling_columns, inverse
from uwsfm.solver.linear.reduction import analyse
from uwsfm.solver.normal_equations import NormalEquations


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenReach:
    """How the estimates of an optimum follow the numbers that were given."""

    optimum: Optimum
    layout: Layout
    """With a column for every given number, after those of what is refined."""
    eqs: NormalEquations
    """Of this layout."""
    accuracy: GivenAccuracy
    given: IndexArray
    """(G, 2) camera and slot of each given number: first what is held, then what is
    refined with a prior."""
    num_held: int
    unknowns: Array
    """(n, G) steps of the unknowns of ``layout`` per unit of each; NaN if open."""
    scale_step: Array
    """(G,) relative steps of the scale."""

    @property
    def covariance(self) -> Array:
        """(G, G) of the given numbers; a prior has its own standard deviation."""
        block = self.accuracy.block(self.given)
        priors = self.optimum.priors
        if priors is not None:
            camera, slot = self.given[self.num_held :].T
            weights = np.zeros(len(block))
            weights[self.num_held :] = priors.weights[camera, slot]
            single = np.flatnonzero(weights)
            block[single] = block[:, single] = 0.0
            block[single, single] = self.optimum.sigma_px**2 / weights[single]
        return block

    @property
    def stddevs(self) -> Array:
        """(G,)"""
        return np.sqrt(np.diag(self.covariance))

    @property
    def border_steps(self) -> Array:
        """(C, BORDER_SIZE, G) of all parameters, of the given ones themselves too."""
        layout = self.layout
        first = layout.num_frame_cols
        own = self.unknowns[first : first + layout.num_camera_cols]
        padded = np.concatenate([own, np.zeros((1, len(self.given)))])
        return padded[layout.border_col]  # HELD = -1 reads the zeros at the end

    @property
    def frame_steps(self) -> Array:
        """(F, 6, G) left tangents of rig_from_world."""
        layout = self.layout
        steps = np.zeros((len(layout.frame_col), 6, len(self.given)))
        free = layout.frame_col != HELD
        rows = layout.frame_col[free, None] + np.arange(6)
        steps[free] = self.unknowns[rows]
        return steps

    def added(self, steps: Array, *, priors: bool = False) -> Array:
        """Covariance (..., K, K) that errors of what is given make.

        Args:
            steps: (..., K, G) of K numbers.
            priors: False: without the part of the priors alone, which the covariance
                from the images holds already.
        """
        covariance, held = self.covariance, self.num_held
        if not priors:
            covariance[held:, held:] = 0.0
        return np.asarray(steps @ covariance @ np.swapaxes(steps, -1, -2))


def given_reach(calibration: CalibrationResult) -> GivenReach:
    """Linearise a calibration by everything that was given.

    Args:
        calibration: its options say what was held, and how well it is known.
    """
    optimum = reopened(calibration)
    scene, columns = calibration.scene, optimum.columns
    accuracy = calibration.options.given or assumed_accuracy(scene)
    held = (columns == HELD) & (accuracy.stddevs > 0.0)
    held[optimum.at_zero, border.DISTANCE] = False
    pulled = np.zeros_like(held)
    if optimum.priors is not None:
        pulled = (optimum.priors.weights > 0.0) & (columns != HELD)
        for term in lens_priors(optimum.priors):
            pulled[tuple(term.slots.T)] = True
    extended = columns.copy()
    num_free = int(columns.max(initial=-1)) + 1
    extended[held] = num_free + np.arange(np.count_nonzero(held))
    layout = with_columns(optimum.layout, extended)
    given = np.concatenate([np.argwhere(held), np.argwhere(pulled)])
    eqs = likelihood(layout, optimum.state, optimum.priors)
    unknowns, inverses = _steps(optimum, layout, eqs, num_free, pulled)
    if optimum.scale_held:
        scale = np.zeros(len(given))
    else:
        slope = scale_slope(optimum.state.points, inverses)
        scale = by_unknowns(layout, eqs, inverses, slope) @ unknowns
    return GivenReach(
        optimum=optimum,
        layout=layout,
        eqs=eqs,
        accuracy=accuracy,
        given=given,
        num_held=int(np.count_nonzero(held)),
        unknowns=unknowns,
        scale_step=scale,
    )


def _steps(
    optimum: Optimum,
    layout: Layout,
    eqs: NormalEquations,
    num_free: int,
    pulled: Array,
) -> tuple[Array, Array]:
    """Steps (n, G) of all unknowns per unit of what is given, and (P, 3, 3) inverses of
    the points' blocks.

    The order of the border is that of the columns: the given ones come after the free
    ones of the cameras, and before those of the navigation and the lengths.
    """
    own = optimum.layout
    reduction = analyse(own)
    offset = layout.num_frame_cols
    kept = np.r_[:num_free, layout.num_camera_cols : layout.num_border_cols]
    moved = np.arange(num_free, layout.num_camera_cols)
    count = len(moved) + int(np.count_nonzero(pulled))
    steps = np.zeros((offset + layout.num_border_cols, count))
    steps[offset + moved, np.arange(len(moved))] = 1.0
    with suitable_blas(reduction):
        whole = schur.reduced_system(layout, reduction.graph, eqs, 0.0)
        square = symmetric(whole.border)
        part = whole._replace(
            coupling=np.ascontiguousarray(whole.coupling[:, kept]),
            border=square[np.ix_(kept, kept)],
            right_border=whole.right_border[kept],
        )
        found = inverse(reduction, part, layout.num_lengths)
        if found is None:
            steps[np.r_[:offset, offset + kept]] = np.nan
            return steps, whole.inverses
        by_given = [coupling_columns(whole)[:, moved], square[np.ix_(kept, moved)]]
        right = np.zeros((offset + len(kept), count))
        right[:, : len(moved)] = -np.concatenate(by_given)
        right[:, len(moved) :] = _pulls(optimum, pulled, offset, len(kept))
        if count:
            steps[np.r_[:offset, offset + kept]] = found.times(right)
    return steps, whole.inverses


def _pulls(optimum: Optimum, pulled: Array, offset: int, num_kept: int) -> Array:
    """(n, Q) forces on the unknowns per unit of each prior."""
    slots = np.argwhere(pulled)
    out = np.zeros((offset + num_kept, len(slots)))
    if not len(slots):
        return out
    assert optimum.priors is not None
    columns = optimum.columns[pulled]
    out[offset + columns, np.arange(len(slots))] = optimum.priors.weights[pulled]
    rows = offset + optimum.columns
    for term in lens_priors(optimum.priors):
        number = np.cumsum(pulled).reshape(pulled.shape) - 1
        at = tuple(term.slots.T)
        out[np.ix_(rows[at], number[at])] = term.information
    return out


def in_all(calibration: CalibrationResult, reach: GivenReach) -> InAll:
    """Covariances from the images and from what was given, together.

    Args:
        calibration: as it was solved.
        reach: of the same.
    """
    covariance = calibration.covariance
    columns, steps = covariance.border_cols, reach.border_steps
    num_cameras = len(columns)
    flat = steps.reshape(num_cameras * border.BORDER_SIZE, -1)
    added = reach.added(flat)
    every = np.arange(len(flat)).reshape(columns.shape)
    cameras = []
    for c, (own, pose) in enumerate(
        zip(covariance.cameras, calibration.scene.cam_from_rig, strict=True)
    ):
        dome = calibration.scene.ports[c].has("center")
        more = camera_variances(added, every[c], pose, dome)
        total = _variances(own) + np.clip(more, 0.0, None)
        cameras.append(camera_covariance(total, own.distance_at_zero))
    free = columns != HELD
    onto = np.zeros(len(covariance.border), dtype=np.int64)
    onto[columns[free]] = every[free]
    scale = covariance.scale_stddev
    if scale is not None:
        by_given = max(float(reach.added(reach.scale_step[None])[0, 0]), 0.0)
        scale = float(np.sqrt(scale**2 + by_given))
    return InAll(
        cameras=tuple(cameras),
        border=covariance.border + added[np.ix_(onto, onto)],
        given=added,
        frames=covariance.frames + reach.added(reach.frame_steps),
        scale_stddev=scale,
    )


def with_given_errors(
    calibration: CalibrationResult, reach: GivenReach
) -> CalibrationResult:
    """The calibration with `Covariance.in_all`."""
    found = in_all(calibration, reach)
    return replace(
        calibration, covariance=replace(calibration.covariance, in_all=found)
    )


def _variances(camera: CameraCovariance) -> Array:
    """(9,) as `camera_variances`."""
    stddevs = [
        np.radians(camera.normal_stddev_deg),
        camera.distance_stddev_m,
        np.radians(camera.rotation_stddev_deg),
        *camera.translation_stddev_m,
        *camera.center_stddev_m,
    ]
    return np.square(stddevs)
