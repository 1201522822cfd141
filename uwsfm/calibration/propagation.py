"""How the errors of a calibration reach what is computed from places in its world.

A place X, a point of the model or one set by rays, depends on the unknowns u of the
reduced system (poses, rig, ports) and on image errors of its own:

    dX = D du + noise,   D = -V^-1 [W^T E],   V = sum J^T J over its observations

in the notation of `uwsfm.solver.normal_equations`. What is computed from places with
the gradients g has the variance

    s^T S^-1 s + g^T A g,   s = sum D^T g,   A the covariance of their own noise

with S the reduced matrix: correlations between places, through poses, rig and ports,
are all in s. One step of a linear system per number, and no dense inverse.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from uwsfm.calibration.clicks import pixels_by_point
from uwsfm.calibration.given_errors import given_reach
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.uncertainty import (
    clusters_of,
    likelihood,
    prior_covariance,
)
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.clustered import cluster_scores, given_back
from uwsfm.solver.covariance import reduced_covariance
from uwsfm.solver.layout import HELD, Layout, build_layout, with_columns
from uwsfm.solver.levenberg_marquardt import suitable_blas
from uwsfm.solver.linear.reduction import analyse
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.terms import skew_matrices

FEATURE = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """M places and how they depend on the calibration."""

    points: Array
    """(M, 3) in the world."""
    own: Array
    """(M, 3, 3) covariance of what is theirs alone; NaN if undetermined."""
    pull: sp.csr_array
    """(3 M, n) derivative by the unknowns of the reduced system."""
    by_given: Array
    """(3 M, G) derivative by the numbers that were given, see `GivenReach`."""
    in_model: IndexArray
    """(M,) index of a point of the model, `FEATURE` for what is none."""

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: IndexArray) -> "Places":
        """Some of them, in an order (M',)."""
        blocks = 3 * np.asarray(rows)[:, None] + np.arange(3)
        return Places(
            points=self.points[rows],
            own=self.own[rows],
            pull=sp.csr_array(self.pull[blocks.ravel()]),
            by_given=self.by_given[blocks.ravel()],
            in_model=self.in_model[rows],
        )

    @classmethod
    def joined(cls, parts: "list[Places]") -> "Places":
        return cls(
            points=np.concatenate([part.points for part in parts]),
            own=np.concatenate([part.own for part in parts]),
            pull=sp.csr_array(sp.vstack([part.pull for part in parts], format="csr")),
            by_given=np.concatenate([part.by_given for part in parts]),
            in_model=np.concatenate([part.in_model for part in parts]),
        )


class Propagation:
    """The joint covariance of a calibration, asked for single numbers."""

    def __init__(self, calibration: CalibrationResult) -> None:
        """Linearise at the optimum, once.

        Args:
            calibration: of a scene, as `calibrate` or `open_result` give it.
        """
        self.scene = calibration.scene
        self._reach = given_reach(calibration)
        self.optimum = self._reach.optimum
        layout = self.optimum.layout
        reduction = analyse(layout)
        with suitable_blas(reduction):
            self._eqs = likelihood(layout, self.optimum.state, self.optimum.priors)
            self._reduced = reduced_covariance(layout, self._eqs, reduction)

    @property
    def determined(self) -> bool:
        """False: the data leave some direction of the unknowns free."""
        return self._reduced.determined

    def of_points(self, point_idx: IndexArray) -> Places:
        """Points of the model.

        Args:
            point_idx: (M,) of the scene; different ones, for what two numbers share of
                one point's noise is told by its index.
        """
        optimum = self.optimum
        rows = np.searchsorted(optimum.used, point_idx)
        return Places(
            points=self.scene.points[point_idx],
            own=optimum.sigma_px**2 * _inverses(self._eqs.points[rows]),
            pull=_pull(optimum.layout, self._eqs, rows),
            by_given=self._by_given(self._reach.layout, self._reach.eqs, rows),
            in_model=np.asarray(point_idx, dtype=np.int64),
        )

    def of_rays(self, seen: Scene, stddevs_px: Array) -> Places:
        """Places that rays of the model set, as
        `uwsfm.calibration.point_placement.placed`.

        Args:
            seen: M points and their observations, in frames of the model.
            stddevs_px: (M,) of each coordinate of each point's observations.
        """
        optimum = self.optimum
        layout = build_layout(
            seen,
            optimum.columns,
            navigation=optimum.layout.num_nav_cols > 0,
            num_lengths=optimum.layout.num_lengths,
        )
        layout = layout._replace(frame_col=optimum.layout.frame_col)
        eqs = likelihood(layout, replace(optimum.state, points=seen.points), None)
        own = np.asarray(stddevs_px)[:, None, None] ** 2 * _inverses(eqs.points)
        rows = np.arange(seen.num_points)
        wider = with_columns(layout, self._reach.layout.border_col)
        by_all = likelihood(wider, replace(optimum.state, points=seen.points), None)
        return Places(
            points=seen.points,
            own=own,
            pull=_pull(layout, eqs, rows),
            by_given=self._by_given(wider, by_all, rows),
            in_model=np.full(seen.num_points, FEATURE),
        )

    def covariance(self, places: Places, slopes: Array) -> Array:
        """Covariance (K, K) of numbers, if every observation errs alone.

        Args:
            places: M of them.
            slopes: (K, M, 3) derivatives of the numbers by the places.

        Returns:
            NaN if the data leave something open.
        """
        steps = self._steps(places, slopes)
        if steps is None:
            return np.full((len(slopes), len(slopes)), np.nan)
        by_unknowns, solved = steps
        shared = self.optimum.sigma_px**2 * by_unknowns.T @ solved
        return shared + self._own(places, slopes, np.ones(len(places), dtype=bool))

    def shared_variances(self, by_unknowns: Array) -> Array:
        """Variances (K,) of numbers, as far as they come through the unknowns.

        Args:
            by_unknowns: (n, K) derivatives by the unknowns of the reduced system.

        Returns:
            NaN if the data leave something open.
        """
        if self._reduced.found is None:
            return np.full(by_unknowns.shape[1], np.nan)
        by_unknowns = np.ascontiguousarray(by_unknowns)
        with suitable_blas(self._reduced.reduction):
            solved = self._reduced.found.times(by_unknowns)
        return self.optimum.sigma_px**2 * np.einsum("nk,nk->k", by_unknowns, solved)

    def clustered_covariance(self, places: Places, slopes: Array) -> Array:
        """The same, if the observations of a quarter of an image may err together, by
        as much as their residuals show; see `uwsfm.solver.clustered`."""
        steps = self._steps(places, slopes)
        if steps is None:
            return np.full((len(slopes), len(slopes)), np.nan)
        optimum, (_, solved) = self.optimum, steps
        layout, cluster = optimum.layout, clusters_of(optimum)
        state = optimum.state.kernel_state()
        scores = cluster_scores(
            layout, state, self._eqs, self._reduced, cluster, solved.T
        )
        if np.any(places.in_model != FEATURE):
            back = given_back(layout, state, self._eqs, self._reduced, cluster)
            self._add_own_scores(places, slopes, cluster, back, scores)
        found = scores.T @ scores * 2 * len(layout.xy) / optimum.degrees_of_freedom
        if optimum.priors is not None:
            split = layout.num_frame_cols
            by_frame = solved[:split].reshape(-1, 6, len(slopes))
            prior = prior_covariance(
                layout, optimum.state, optimum.priors, by_frame, solved[split:]
            )
            found += optimum.sigma_px**2 * prior
        return found + self._own(places, slopes, places.in_model == FEATURE)

    def given_covariance(self, places: Places, slopes: Array) -> Array:
        """What errors of the given numbers add to the covariance (K, K) of numbers.

        Args:
            places, slopes: as of `covariance`.
        """
        flat = slopes.reshape(len(slopes), -1)
        return self._reach.added(flat @ places.by_given)

    def _by_given(
        self, layout: Layout, eqs: NormalEquations, rows: IndexArray
    ) -> Array:
        """(3 M, G) steps of points of a layout that has the given numbers' columns."""
        return np.asarray(_pull(layout, eqs, rows) @ self._reach.unknowns)

    def _steps(self, places: Places, slopes: Array) -> tuple[Array, Array] | None:
        """s (n, K) and S^-1 s (n, K); None if S is singular."""
        if self._reduced.found is None:
            return None
        flat = slopes.reshape(len(slopes), -1)
        by_unknowns = np.ascontiguousarray(places.pull.T @ flat.T)
        with suitable_blas(self._reduced.reduction):
            return by_unknowns, self._reduced.found.times(by_unknowns)

    def _own(self, places: Places, slopes: Array, which: Array) -> Array:
        """(K, K) from what is the places' alone."""
        some = slopes[:, which]
        return np.einsum("kmi,mij,lmj->kl", some, places.own[which], some)

    def _add_own_scores(
        self,
        places: Places,
        slopes: Array,
        cluster: IndexArray,
        back: Array,
        scores: Array,
    ) -> None:
        """What residuals of the model's points do to these points themselves."""
        optimum = self.optimum
        layout = optimum.layout
        for m in np.flatnonzero(places.in_model != FEATURE):
            p = int(np.searchsorted(optimum.used, places.in_model[m]))
            cells = layout.point_start[p], layout.point_start[p + 1]
            rows = np.arange(*layout.cell_start[list(cells)])
            seen = self._observations(rows, p)
            errors = seen.residuals() + back[rows]
            pull = np.einsum("nij,ni->nj", pixels_by_point(seen), errors)
            reach = slopes[:, m] @ places.own[m] / optimum.sigma_px**2  # (K, 3)
            np.add.at(scores, cluster[rows], np.nan_to_num(pull) @ reach.T)

    def _observations(self, rows: IndexArray, p: int) -> Scene:
        """Sorted observations of one point of the layout, as a scene."""
        layout, state = self.optimum.layout, self.optimum.state
        frame = np.repeat(layout.cell_frame, np.diff(layout.cell_start))
        return replace(
            self.scene,
            points=state.points[p : p + 1],
            camera_idx=layout.camera[rows].astype(np.int64),
            frame_idx=frame[rows].astype(np.int64),
            point_idx=np.zeros(len(rows), dtype=np.int64),
            xy=layout.xy[rows],
        )


def _pull(layout: Layout, eqs: NormalEquations, rows: IndexArray) -> sp.csr_array:
    """D (3 M, n) of some points of a layout."""
    num_frame_cols = layout.num_frame_cols
    size = num_frame_cols + layout.num_border_cols
    inverses = _inverses(eqs.points[rows])
    border = num_frame_cols + np.arange(layout.num_border_cols)
    columns, values, starts = [], [], [0]
    for m, p in enumerate(rows):
        cells = np.arange(layout.point_start[p], layout.point_start[p + 1])
        first = layout.frame_col[layout.cell_frame[cells]]
        free = first != HELD
        blocks = _frame_against_point(eqs.cells[cells[free]])  # (6 cells, 3)
        col = (first[free, None] + np.arange(6)).ravel()
        both = np.vstack([blocks, eqs.points_border[p].T])
        columns += 3 * [np.append(col, border)]
        values.append(-inverses[m] @ both.T)
        starts += 3 * [len(both)]
    return sp.csr_array(
        (
            np.concatenate([v.ravel() for v in values]),
            np.concatenate(columns),
            np.cumsum(starts),
        ),
        shape=(3 * len(rows), size),
    )


def _frame_against_point(cells: Array) -> Array:
    """W (6 k, 3) = [[q]x H R; H R] of cells (k, 4, 3), as the equations keep them."""
    lower, in_rig = cells[:, :3], cells[:, 3]
    upper = skew_matrices(in_rig) @ lower
    return np.concatenate([upper, lower], axis=1).reshape(-1, 3)


def _inverses(normal: Array) -> Array:
    """(M, 3, 3); NaN where there is none."""
    scale = np.sqrt(np.einsum("mii->mi", normal))
    scaled = normal / np.maximum(scale[:, :, None] * scale[:, None, :], 1e-300)
    good = np.isfinite(scaled).all(axis=(1, 2))
    good[good] = np.linalg.eigvalsh(scaled[good])[:, 0] > 1e-14
    out = np.full_like(normal, np.nan)
    out[good] = np.linalg.inv(normal[good])
    return out
