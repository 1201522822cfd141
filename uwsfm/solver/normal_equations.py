"""Normal equations of the bundle adjustment, in blocks.

Per cell (one point in one frame) only H = sum J^T J (3x3) by the point in the rig, its
gradient and its coupling to the border are summed over the cameras. With q the point in
the rig, the pose enters by M = [-[q]x, I] and the point by the frame's rotation R:

    U += M^T H M,   W = M^T H R,   V += R^T H R

The points are eliminated by `uwsfm.solver.linear.schur`.
"""

from typing import NamedTuple

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.residuals.reprojection import point_in_rig
from uwsfm.solver.assembly import (
    NOTHING,
    Sums,
    add_cell,
    add_frames,
    assemble,
    clear,
    plus,
    rotation,
    write_point,
)
from uwsfm.solver.cells import (
    add_point_3d,
    add_virtual_camera,
    cell_cost,
    scatter_blocks,
)
from uwsfm.solver.chunks import (
    chunk_end,
    cost_of_errors,
    evaluate,
    evaluate_with_jac,
    gather,
)
from uwsfm.solver.error_models import POINT_3D, REPROJECTION, ErrorModel
from uwsfm.solver.layout import Layout
from uwsfm.solver.losses import L2
from uwsfm.solver.state import KernelState
from uwsfm.solver.threads import run_chunks
from uwsfm.solver.workspace import Workspace

MIN_DIAGONAL = 1e-6

_WRITTEN = ("cells", "points")
"""Blocks, by the starts of their names, that are written and not added to: the first of
any error, the second of errors in the image only."""


class NormalEquations(NamedTuple):
    """Blocks of J^T W J and of the gradient J^T W r (K cells, B border columns)."""

    points: Array
    """V (P, 3, 3)"""
    points_grad: Array
    """(P, 3)"""
    points_border: Array
    """E (P, 3, B)"""
    cells: Array
    """(K, 4, 3): H R, and q, of which frame against point is made: W (6, 3) = M^T H R.
    Two thirds of its memory, and of what has to be read."""
    frames: Array
    """U (F, 6, 6)"""
    frames_grad: Array
    """(F, 6)"""
    frames_border: Array
    """(F, 6, B)"""
    border: Array
    """(B, B)"""
    border_grad: Array
    """(B,)"""


def empty_normal_equations(layout: Layout) -> NormalEquations:
    """Zeroed blocks of the sizes of a layout."""
    num_points, num_frames = len(layout.point_start) - 1, len(layout.frame_col)
    num_border = layout.num_border_cols
    return NormalEquations(
        points=np.zeros((num_points, 3, 3)),
        points_grad=np.zeros((num_points, 3)),
        points_border=np.zeros((num_points, 3, num_border)),
        cells=np.zeros((len(layout.cell_frame), 4, 3)),
        frames=np.zeros((num_frames, 6, 6)),
        frames_grad=np.zeros((num_frames, 6)),
        frames_border=np.zeros((num_frames, 6, num_border)),
        border=np.zeros((num_border, num_border)),
        border_grad=np.zeros(num_border),
    )


@inner
def _add_couplings(x, y, z, frame, p, f, couple, out):
    """Couplings of a cell (3, B) to the border, from its frame and its point."""
    rows = out.frames_border[f]
    for k in range(couple.shape[1]):
        a, b, c = couple[0, k], couple[1, k], couple[2, k]
        rows[0, k] += y * c - z * b
        rows[1, k] += z * a - x * c
        rows[2, k] += x * b - y * a
        rows[3, k] += a
        rows[4, k] += b
        rows[5, k] += c
        for i in range(3):
            out.points_border[p, i, k] += (
                frame[i] * a + frame[4 + i] * b + frame[8 + i] * c
            )


class Work(NamedTuple):
    """Scratch of other errors: sums of a cell, of a camera, Jacobians of a row."""

    hess: Array
    """(3, 3), lower triangle."""
    grad: Array
    couple: Array
    blocks: Array
    """(C, BORDER_SIZE, BORDER_SIZE), lower triangles of what is free."""
    block_grads: Array
    free: Array
    j_rig: Array
    j_border: Array
    j_cell: Array


@inner
def _work(num_border, num_cameras, largest_cell):
    return Work(
        np.empty((3, 3)),
        np.empty(3),
        np.empty((3, num_border)),
        np.zeros((num_cameras, BORDER_SIZE, BORDER_SIZE)),
        np.zeros((num_cameras, BORDER_SIZE)),
        np.empty((2, BORDER_SIZE)),
        np.zeros((4, 3)),  # a virtual camera's error has three rows and one of zeros
        np.zeros((4, BORDER_SIZE)),
        np.zeros((largest_cell, 3, BORDER_SIZE)),
    )


@kernel
def _linearize_in_space(layout, state, error, loss, scale, turns, moves, out):
    """`linearize` of errors that are not in the image, cell by cell."""
    # A camera may have matched two features of an image to one point.
    largest_cell = np.diff(layout.cell_start).max()
    work = _work(len(out.border_grad), len(state.cams), largest_cell)
    hess, grad = work.hess, work.grad
    for p in range(len(layout.point_start) - 1):
        total = NOTHING
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            f = layout.cell_frame[c]
            frame = state.frames[f]
            x, y, z = point_in_rig(frame, state.points[p])
            hess[:], grad[:], work.couple[:] = 0.0, 0.0, 0.0
            if error.code == POINT_3D:
                add_point_3d(layout, state, error, c, x, y, z, loss, scale, work, out)
            else:
                add_virtual_camera(layout, state, error, c, x, y, z, loss, scale, work)
            lower = (hess[0, 0], hess[1, 0], hess[1, 1], hess[2, 0], hess[2, 1])
            cell = (*lower, hess[2, 2], grad[0], grad[1], grad[2])
            turn = rotation(state.frames, f)
            given = add_cell(x, y, z, turn, c, f, cell, turns, moves, out.cells)
            total = plus(total, given)
            _add_couplings(x, y, z, frame, p, f, work.couple, out)
        write_point(p, total, out.points, out.points_grad)
    scatter_blocks(layout, work, out)


@kernel
def _linearize_points(layout, state, loss, scale, begin, end, chunk, sums, out):
    """Reprojection errors of points begin to end: their blocks, and sums."""
    p = begin
    while p < end:
        last = chunk_end(layout, p, end)
        first = gather(layout, state, p, last, chunk)
        evaluate_with_jac(layout, state, first, loss, scale, sums.blocks, chunk)
        assemble(layout, state, p, last, first, chunk, sums, out)
        p = last


def scatter(layout: Layout, parts: list[Sums], out: NormalEquations) -> None:
    """Sum parts up in their order; cameras may share border columns."""
    cameras = layout.num_camera_cols
    chosen = parts[0].column.reshape(-1, 1) == np.arange(cameras)  # the same in all
    for sums in parts:
        add_frames(sums.seen, sums.turns, sums.moves, out.frames, out.frames_grad)
        slots = sums.slots.reshape(len(sums.seen), 6, -1)
        out.frames_border[sums.seen, :, :cameras] += slots @ chosen
    blocks = np.sum([sums.blocks for sums in parts], axis=0)
    for k in range(len(layout.free_start) - 1):
        cols = layout.free_col[layout.free_start[k] : layout.free_start[k + 1]]
        lower = np.tril(blocks[k, : len(cols), 1 : len(cols) + 1])
        # fx and fy of one camera may share a column.
        np.add.at(out.border, np.ix_(cols, cols), lower + np.tril(lower, -1).T)
        np.add.at(out.border_grad, cols, blocks[k, : len(cols), 0])


def linearize(
    work: Workspace,
    state: KernelState,
    error: ErrorModel,
    loss: int,
    scale: float,
    out: NormalEquations,
) -> None:
    """Fill `NormalEquations` at a state, with weights rho'(s)."""
    in_image = error.code == REPROJECTION
    for name, block in out._asdict().items():
        if not name.startswith(_WRITTEN if in_image else _WRITTEN[:1]):
            block[...] = 0.0
    if not in_image:
        num_frames = len(out.frames)
        turns, moves = np.zeros((num_frames, 3, 6)), np.zeros((num_frames, 12))
        _linearize_in_space(work.layout, state, error, loss, scale, turns, moves, out)
        add_frames(np.arange(num_frames), turns, moves, out.frames, out.frames_grad)
        return

    def add_part(part: int) -> None:
        begin, end = work.bounds[part : part + 2]
        sums = work.sums[part]
        clear(sums)
        with work.chunk() as chunk:
            _linearize_points(
                work.layout, state, loss, scale, begin, end, chunk, sums, out
            )

    run_chunks(add_part, len(work.sums))
    scatter(work.layout, work.sums, out)


@kernel
def _cost_in_space(layout, state, error, loss, scale):
    """`total_cost` of errors that are not in the image."""
    cost, valid = 0.0, 0
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], state.points[p])
            part, count = cell_cost(layout, state, error, c, x, y, z, loss, scale)
            cost += part
            valid += count
    return cost, valid


@kernel
def _cost_of_points(layout, state, loss, scale, begin, end, chunk, squares):
    """Cost and number of valid reprojection errors of points begin to end."""
    cost, valid, p = 0.0, 0, begin
    while p < end:
        last = chunk_end(layout, p, end)
        first = gather(layout, state, p, last, chunk)
        evaluate(layout, state, first, chunk)
        after = layout.cell_start[layout.point_start[last]]
        part, good = cost_of_errors(chunk.errors, loss, scale, squares[first:after])
        cost += part
        valid += good
        p = last
    return cost, valid


def _image_cost(
    work: Workspace, state: KernelState, loss: int, scale: float
) -> tuple[float, int]:
    """Cost and number of valid errors of the reprojection error; `work.squares`."""
    costs, squares = [(0.0, 0)] * work.num_parts, work.squares
    work.set_state(None)

    def add_part(part: int) -> None:
        begin, end = work.bounds[part : part + 2]
        with work.chunk() as chunk:
            costs[part] = _cost_of_points(
                work.layout, state, loss, scale, begin, end, chunk, squares
            )

    run_chunks(add_part, len(costs))
    work.set_state(state)
    return sum(cost for cost, _ in costs), sum(valid for _, valid in costs)


def total_cost(
    work: Workspace, state: KernelState, error: ErrorModel, loss: int, scale: float
) -> tuple[float, int]:
    """(Robust cost 0.5 sum rho(|e|^2) in pixels squared, number of valid errors)."""
    if error.code != REPROJECTION:
        return _cost_in_space(work.layout, state, error, loss, scale)
    return _image_cost(work, state, loss, scale)


def squared_errors(work: Workspace, state: KernelState) -> Array:
    """Squared reprojection errors (N,) in sorted order, px^2; NaN where invalid.

    The array belongs to the workspace.
    """
    if work.squares_at(state) is None:
        _image_cost(work, state, L2, 1.0)
    return work.squares
