"""Posterior covariance of frames, border and points at an optimum."""

import math
from dataclasses import dataclass

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.assembly import expand_cells
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.linear import schur
from uwsfm.solver.linear.block_graph import find_block
from uwsfm.solver.linear.reduced_factor import Inverse, inverse
from uwsfm.solver.linear.reduction import Reduction, analyse
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.threads import chunk_bounds, num_threads, run_chunks


@dataclass(frozen=True, kw_only=True, eq=False)
class ReducedCovariance:
    """What the inverse of the reduced system (n, n) tells, for unit noise.

    Of frames that share a point, and of all of them with the border; NaN everywhere if
    the system is singular.
    """

    reduction: Reduction
    determined: bool
    points: Array
    """(P, 3, 3) inverses of the point blocks that the elimination used."""
    blocks: Array
    """(number of blocks, 6, 6) of the free frames, in the pattern of the graph."""
    coupling: Array
    """(F, 6, B) of free frames and border."""
    whole_border: Array
    """(B, B), lengths included."""
    poses: Array
    """(F, 6, 6) of each frame in its own place: the block of its pose in the reduced
    system itself, zero if held."""
    found: Inverse | None

    @property
    def layout(self) -> Layout:
        return self.reduction.layout

    @property
    def border(self) -> Array:
        """(C, C) block of rig and ports, marginal over poses and points."""
        cameras = slice(self.layout.num_camera_cols)
        return self.whole_border[cameras, cameras]

    @property
    def navigation(self) -> Array:
        """(6, 6) block of nav_from_world [rotation, translation], left tangent."""
        first = self.layout.num_camera_cols
        inside = slice(first, first + self.layout.num_nav_cols)
        return self.whole_border[inside, inside]

    @property
    def border_rows(self) -> Array:
        """(B, n) rows of the border."""
        size = len(self.whole_border)
        frames = self.coupling.reshape(self.layout.num_frame_cols, size).T
        return np.concatenate([frames, self.whole_border], axis=1)

    @property
    def frames(self) -> Array:
        """(F, 6, 6) blocks of the poses, tangents of `rigid3.perturb`; zero if held."""
        return _diagonal(self.reduction, self.blocks)

    def variance_of(self, slope: Array) -> float:
        """Variance of what changes by slope (n,) times the unknowns; NaN if singular.

        Of any unknowns, whether they share a point or not.
        """
        if self.found is None:
            return math.nan
        return float(slope @ self.found.times(slope[:, None])[:, 0])


def _diagonal(reduction: Reduction, blocks: Array) -> Array:
    """(F, 6, 6) diagonal blocks, by frame; zero if held."""
    graph = reduction.graph
    by_frame = np.zeros((len(reduction.layout.frame_col), 6, 6))
    by_frame[graph.frame] = blocks[graph.row_start[1:] - 1]
    return by_frame


def reduced_covariance(
    layout: Layout, eqs: NormalEquations, reduction: Reduction | None = None
) -> ReducedCovariance:
    """Invert the undamped reduced system.

    The observations' noise is taken as 1 px: multiply by the noise variance.

    Args:
        layout, eqs: the problem at its optimum.
        reduction: how its reduced system is solved, if that is known.
    """
    reduction = reduction or analyse(layout)
    system = schur.reduced_system(layout, reduction.graph, eqs, 0.0)
    poses = _diagonal(reduction, system.blocks)
    found = inverse(reduction, system, layout.num_lengths)
    if found is None:
        blocks, border = (
            np.full_like(part, np.nan) for part in (system.blocks, system.border)
        )
        coupling = np.full((reduction.graph.num_frames, 6, len(border)), np.nan)
    else:
        blocks, coupling, border = found.blocks, found.coupling, found.border
    return ReducedCovariance(
        reduction=reduction,
        determined=found is not None,
        points=system.inverses,
        blocks=blocks,
        coupling=np.ascontiguousarray(coupling),
        whole_border=np.ascontiguousarray(border),
        poses=poses,
        found=found,
    )


@inner
def _product(left, middle, right, out):
    """out (3, 3) = L^T M R; L (a, 3), M (a, b), R (b, 3)."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(middle.shape[0]):
                for b in range(middle.shape[1]):
                    total += left[a, i] * middle[a, b] * right[b, j]
            out[i, j] = total


@inner
def _add(part, out):
    """out (3, 3) += part."""
    for i in range(3):
        for j in range(3):
            out[i, j] += part[i, j]


@inner
def _add_both_ways(part, out):
    """out (3, 3) += part + part^T."""
    for i in range(3):
        for j in range(3):
            out[i, j] += part[i, j]
            out[j, i] += part[i, j]


@inner
def _multiply(left, right, out):
    """(n, 3) times (3, 3)."""
    for i in range(len(out)):
        for b in range(3):
            out[i, b] = (
                left[i, 0] * right[0, b]
                + left[i, 1] * right[1, b]
                + left[i, 2] * right[2, b]
            )


@kernel
def _point_covariances(point_start, graph, eqs, known, first, last, out):
    """V^-1 + (C V^-1)^T S^-1 (C V^-1) of each point; NaN where V is singular."""
    blocks, coupling, border = known
    cells, points, points_border = eqs.cells, eqs.points, eqs.points_border
    row_start, row_other, cell_row = graph.row_start, graph.row_other, graph.cell_row
    largest = 0
    for p in range(first, last):
        largest = max(largest, point_start[p + 1] - point_start[p])
    reach, coupled = np.empty((largest, 6, 3)), np.empty((1, 6, 3))
    inverse_block, sideways = np.empty((3, 3)), np.empty((len(border), 3))
    part = np.empty((3, 3))
    for p in range(first, last):
        regular = schur.invert_damped(points[p], 0.0, inverse_block)
        for a in range(3):
            for b in range(3):
                out[p, a, b] = inverse_block[a, b] if regular else math.nan
        if not regular:
            continue
        _multiply(points_border[p].T, inverse_block, sideways)
        _product(sideways, border, sideways, part)
        _add(part, out[p])
        start = point_start[p]
        for c in range(start, point_start[p + 1]):
            i = cell_row[c]
            if i == HELD:
                continue
            expand_cells(cells, c, c + 1, coupled)
            _multiply(coupled[0], inverse_block, reach[c - start])
            _product(reach[c - start], coupling[i], sideways, part)
            _add_both_ways(part, out[p])
            s = row_start[i]
            for other in range(start, c + 1):
                j = cell_row[other]
                if j == HELD:
                    continue
                s = find_block(row_start, row_other, i, j, s)
                _product(reach[other - start], blocks[s], reach[c - start], part)
                if j != i:
                    _add_both_ways(part, out[p])
                else:
                    _add(part, out[p])


def point_covariances(
    layout: Layout, eqs: NormalEquations, reduced: ReducedCovariance
) -> Array:
    """Marginal covariances of the points in the world (P, 3, 3), unit noise.

    NaN for points that the observations do not determine.
    """
    out = np.empty_like(eqs.points)
    known = (reduced.blocks, reduced.coupling, reduced.whole_border)
    bounds = chunk_bounds(layout.point_start, num_threads())

    def fill(chunk: int) -> None:
        first, last = bounds[chunk], bounds[chunk + 1]
        graph = reduced.reduction.graph
        _point_covariances(layout.point_start, graph, eqs, known, first, last, out)

    run_chunks(fill, len(bounds) - 1)
    return out
