"""Lengths and positions from outside, as terms of the bundle adjustment.

Each is weighed against the noise of the images: a standard deviation of s metres
counts as s / noise metres per pixel. Frames move by left perturbations of
rig_from_world = [R | t], so that a place l in the rig, in the world at R^T (l - t),
moves by R^T [l]x dw - R^T dv.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.layout import Layout
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.state import State


def centers(rig_from_world: Array) -> Array:
    """Origins (..., 3) of the rigs in the world."""
    return rigid3.inverse(rig_from_world)[..., 4:]


def skew_matrices(vectors: Array) -> Array:
    """[v]x (..., 3, 3), with [v]x u = v x u."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True, kw_only=True)
class LengthTerm:
    """Known distances, between points or between rig origins.

    Each has a column at the end of the border, see `uwsfm.solver.linear.quasidefinite`.
    """

    ends: IndexArray
    """(M, 2) points, or frames, as the layout numbers them."""
    lengths: Array
    """(M,) metres."""
    variances: Array
    """(M,) (standard deviation / noise in px) squared."""
    of_frames: bool
    first: int = 0
    """Of its columns among the lengths of the layout."""

    def distances(self, state: State) -> Array:
        """(M,) as they are."""
        return np.linalg.norm(self._between(state), axis=1)

    def cost(self, state: State) -> float:
        miss = self.distances(state) - self.lengths
        return 0.5 * float(np.sum(miss**2 / self.variances))

    def add_to(self, eqs: NormalEquations, state: State, layout: Layout) -> None:
        between = self._between(state)
        found = np.linalg.norm(between, axis=1)
        first = layout.num_unknowns - layout.num_frame_cols + self.first
        cols = first + np.arange(len(found))
        eqs.border[cols, cols] = -self.variances
        eqs.border_grad[cols] = found - self.lengths
        along = between / np.maximum(found, 1e-300)[:, None]
        for side, sign in ((0, 1.0), (1, -1.0)):
            ends, pull = self.ends[:, side], sign * along
            if self.of_frames:
                turned = -rigid3.rotate(state.rig_from_world[ends], pull)
                eqs.frames_border[ends, 3:, cols] += turned
            else:
                eqs.points_border[ends, :, cols] += pull

    def _between(self, state: State) -> Array:
        places = state.points
        if self.of_frames:
            places = centers(state.rig_from_world)
        return places[self.ends[:, 0]] - places[self.ends[:, 1]]


class PositionRows(NamedTuple):
    """Linearised position priors, whitened: px."""

    miss: Array
    """(M, 3)"""
    by_frame: Array
    """(M, 3, 6)"""
    by_navigation: Array
    """(M, 3, 6)"""


@dataclass(frozen=True, kw_only=True)
class PositionTerm:
    """Measured positions of an antenna on the rig, in a frame of their own."""

    frames: IndexArray
    """(M,)"""
    positions: Array
    """(M, 3)"""
    roots: Array
    """(M, 3, 3) whitening: noise in px times a root of the inverse covariance."""
    lever_arm: Array
    """(3,) the antenna in the rig."""
    sigma_px: float
    """The noise that the roots are for."""
    loss_scale: float | None
    """Cauchy's c in standard deviations; None: least squares."""
    start: Array
    """(7,) nav_from_world; how far it turns from there costs a little, for what a
    straight track leaves open: 1 radian is one standard deviation."""

    def squares(self, state: State) -> Array:
        """(M,) squared misses over their covariances, without a unit."""
        return np.sum(self._miss(state) ** 2, axis=1) / self.sigma_px**2

    def cost(self, state: State) -> float:
        squares = self.squares(state)
        if self.loss_scale is not None:
            c2 = self.loss_scale**2
            squares = c2 * np.log1p(squares / c2)
        turned = self._turned(state)
        return 0.5 * self.sigma_px**2 * float(np.sum(squares) + turned @ turned)

    def add_to(self, eqs: NormalEquations, state: State, layout: Layout) -> None:
        rows = self.linearized(state)
        weights = np.ones(len(rows.miss))
        if self.loss_scale is not None:
            weights /= 1.0 + self.squares(state) / self.loss_scale**2
        scaled = weights[:, None] * rows.miss
        by_frame = weights[:, None, None] * rows.by_frame
        first = layout.num_camera_cols
        cols = slice(first, first + layout.num_nav_cols)
        np.add.at(eqs.frames, self.frames, _products(rows.by_frame, by_frame))
        np.add.at(
            eqs.frames_grad, self.frames, np.einsum("mra,mr->ma", rows.by_frame, scaled)
        )
        coupling = _products(by_frame, rows.by_navigation)
        np.add.at(eqs.frames_border[:, :, cols], self.frames, coupling)
        nav = weights[:, None, None] * rows.by_navigation
        eqs.border[cols, cols] += _products(rows.by_navigation, nav).sum(axis=0)
        grad = np.einsum("mra,mr->a", rows.by_navigation, scaled)
        stiffness = self.sigma_px**2
        turns = np.arange(first, first + 3)
        eqs.border[turns, turns] += stiffness
        grad[:3] += stiffness * self._turned(state)
        eqs.border_grad[cols] += grad

    def linearized(self, state: State) -> PositionRows:
        poses = state.rig_from_world[self.frames]
        in_nav = self.predicted(state)
        world_from_rig = np.swapaxes(rigid3.rotmat_from_quat(poses[:, :4]), -1, -2)
        turn = rigid3.rotmat_from_quat(state.nav_from_world[:4])
        whitened = self.roots @ turn @ world_from_rig
        arm = np.broadcast_to(skew_matrices(self.lever_arm), whitened.shape)
        return PositionRows(
            miss=self._miss(state),
            by_frame=np.concatenate([whitened @ arm, -whitened], axis=-1),
            by_navigation=np.concatenate(
                [-self.roots @ skew_matrices(in_nav), self.roots], axis=-1
            ),
        )

    def predicted(self, state: State) -> Array:
        """(M, 3) where the antenna is, in the frame of the positions."""
        poses = rigid3.inverse(state.rig_from_world[self.frames])
        in_world = rigid3.transform(poses, self.lever_arm)
        return rigid3.transform(state.nav_from_world, in_world)

    def _miss(self, state: State) -> Array:
        miss = self.predicted(state) - self.positions
        return np.einsum("mij,mj->mi", self.roots, miss)

    def _turned(self, state: State) -> Array:
        """Rotation vector (3,) from the start to a state."""
        turn = rigid3.compose(state.nav_from_world, rigid3.inverse(self.start))
        return rigid3.rotvec_from_quat(turn[:4])


def _products(left: Array, right: Array) -> Array:
    """J^T K (M, a, b) of rows (M, 3, a) and (M, 3, b)."""
    return np.swapaxes(left, -1, -2) @ right
