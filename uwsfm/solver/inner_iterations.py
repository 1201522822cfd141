"""Points that move alone, frames and cameras held: what a step's straight lines miss.

The large bends of a long survey, which its images hardly determine, are valleys that
curve: frames turn, points move straight. Once every point has moved again by a step of
its own, the bend costs what the quadratic model promised (inner iterations: Ruhe &
Wedin, SIAM Review 1980; embedded point iterations: Jeong et al., CVPR 2010).
"""

from dataclasses import replace

import numpy as np

from uwsfm._base.jit import inner_straight, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.assembly import (
    NOTHING,
    plus,
    point_sums,
    rotation,
    sum_rows,
    times_rotation,
    write_point,
)
from uwsfm.solver.chunks import chunk_end, evaluate_with_jac, gather
from uwsfm.solver.linear.schur import invert_damped
from uwsfm.solver.state import State
from uwsfm.solver.threads import run_chunks
from uwsfm.solver.workspace import Workspace


@inner_straight
def _move_points(layout, poses, first_point, last_point, first, rows, damping, points):
    """Points of an evaluated chunk; those that their rays do not fix stay."""
    point_start, cell_start = layout.point_start, layout.cell_start
    cell_frame, one = layout.cell_frame, np.int64(0)
    hess, grad, inverse = np.empty((1, 3, 3)), np.empty((1, 3)), np.empty((3, 3))
    for p in range(first_point, last_point):
        total = NOTHING
        for c in range(point_start[p], point_start[p + 1]):
            start, end = cell_start[c] - first, cell_start[c + 1] - first
            h00, h10, h11, h20, h21, h22, g0, g1, g2 = sum_rows(rows, start, end)
            frame = rotation(poses, cell_frame[c])
            a = times_rotation(h00, h10, h20, frame)
            b = times_rotation(h10, h11, h21, frame)
            d = times_rotation(h20, h21, h22, frame)
            total = plus(total, point_sums(frame, a, b, d, g0, g1, g2))
        write_point(one, total, hess, grad)
        if invert_damped(hess[0], damping, inverse):
            for k in range(3):
                points[p, k] -= (
                    inverse[k, 0] * grad[0, 0]
                    + inverse[k, 1] * grad[0, 1]
                    + inverse[k, 2] * grad[0, 2]
                )


@kernel
def _settle(layout, state, loss, scale, damping, begin, end, chunk, blocks, points):
    """Move points begin to end, by reprojection errors."""
    p = begin
    while p < end:
        last = chunk_end(layout, p, end)
        first = gather(layout, state, p, last, chunk)
        evaluate_with_jac(layout, state, first, loss, scale, blocks, chunk)
        _move_points(layout, state.frames, p, last, first, chunk.rows, damping, points)
        p = last


def settled(
    work: Workspace, state: State, loss: int, scale: float, damping: float
) -> State:
    """Every point moved by one damped step of its own, in reprojection errors.

    Args:
        work: of the layout.
        state: where the step starts.
        loss, scale: code of the robust loss, and its scale, px.
        damping: Marquardt's lambda.
    """
    held = np.zeros_like(work.layout.free_start)  # no camera has a column
    layout = work.layout._replace(free_start=held, free_lens=False)
    rows, points = state.kernel_state(), state.points.copy()

    def settle(part: int) -> None:
        begin, end = work.bounds[part : part + 2]
        blocks: Array = work.sums[part].blocks  # none is added to
        with work.chunk() as chunk:
            _settle(
                layout, rows, loss, scale, damping, begin, end, chunk, blocks, points
            )

    run_chunks(settle, work.num_parts)
    return replace(state, points=points)
