"""Covariance that holds when neighbouring features err together.

The inverse of the normal equations promises that every observation errs alone. On real
images they do not: what the lens model leaves over, and how a feature detector sees a
slanted surface, is shared by neighbours. The cluster-robust ("sandwich") covariance of
Liang & Zeger (Biometrika 1986) lets observations of one cluster err in any common way:

    S^-1 (sum over clusters of s s^T) S^-1,   s = sum of J~^T r over a cluster

with S the reduced system and J~ the Jacobian after elimination of the points.
"""

import numpy as np

from uwsfm._jit import inner, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.projection import JAC_SIZE
from uwsfm.models.status import VALID
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.residuals.reprojection import point_in_rig
from uwsfm.scene import IndexArray
from uwsfm.solver.cells import linearized_residual
from uwsfm.solver.covariance import ReducedCovariance
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.state import KernelState


@inner
def _reach_of_point(layout, eqs, p, rows, out):
    """What a pull (3,) on a point does to each row, (K, 3): S^-1 [W; E^T]."""
    offset = rows.shape[1] - len(eqs.border_grad)
    out[:] = 0.0
    for b in range(len(out)):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            col = layout.frame_col[layout.cell_frame[c]]
            if col == HELD:
                continue
            x, y, z = eqs.cells[c, 3]
            r0, r1, r2 = rows[b, col], rows[b, col + 1], rows[b, col + 2]
            m0 = rows[b, col + 3] + r1 * z - r2 * y
            m1 = rows[b, col + 4] + r2 * x - r0 * z
            m2 = rows[b, col + 5] + r0 * y - r1 * x
            for i in range(3):
                out[b, i] += m0 * eqs.cells[c, 0, i]
                out[b, i] += m1 * eqs.cells[c, 1, i] + m2 * eqs.cells[c, 2, i]
        for k in range(len(eqs.border_grad)):
            for i in range(3):
                out[b, i] += rows[b, offset + k] * eqs.points_border[p, i, k]


@inner
def _add_score(layout, rows, offset, col, force, pull, grad, camera, of_point, score):
    """Add S^-1 J~^T r of one observation: its own part, minus what its point takes."""
    for b in range(len(score)):
        total = -(
            of_point[b, 0] * pull[0]
            + of_point[b, 1] * pull[1]
            + of_point[b, 2] * pull[2]
        )
        if col != HELD:
            for a in range(6):
                total += rows[b, col + a] * force[a]
        for s in range(layout.free_start[camera], layout.free_start[camera + 1]):
            total += rows[b, offset + layout.free_col[s]] * grad[layout.free_slot[s]]
        score[b] += total


@kernel
def _scores(layout, state, eqs, inverses, cluster, rows, out):
    """Sum some rows' part of S^-1 J~^T r of each cluster, (clusters, K); squared loss.
    All rows' would be as large as frames times clusters."""
    offset = rows.shape[1] - len(eqs.border_grad)
    j_port, j_rig = np.empty((2, JAC_SIZE)), np.empty((2, 3))
    j_border = np.zeros((2, BORDER_SIZE))
    force, grad = np.empty(6), np.empty(BORDER_SIZE)
    of_point, pull = np.empty((len(rows), 3)), np.empty(3)
    for p in range(len(layout.point_start) - 1):
        inverse = inverses[p]
        _reach_of_point(layout, eqs, p, rows, of_point)
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            f = layout.cell_frame[c]
            frame = state.frames[f]
            x, y, z = point_in_rig(frame, state.points[p])
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                status, rx, ry = linearized_residual(
                    layout, state, i, x, y, z, j_port, j_rig, j_border
                )
                if status != VALID:
                    continue
                g0 = j_rig[0, 0] * rx + j_rig[1, 0] * ry
                g1 = j_rig[0, 1] * rx + j_rig[1, 1] * ry
                g2 = j_rig[0, 2] * rx + j_rig[1, 2] * ry
                force[0], force[1] = y * g2 - z * g1, z * g0 - x * g2
                force[2] = x * g1 - y * g0
                force[3], force[4], force[5] = g0, g1, g2
                for k in range(BORDER_SIZE):
                    grad[k] = j_border[0, k] * rx + j_border[1, k] * ry
                w0 = frame[0] * g0 + frame[4] * g1 + frame[8] * g2
                w1 = frame[1] * g0 + frame[5] * g1 + frame[9] * g2
                w2 = frame[2] * g0 + frame[6] * g1 + frame[10] * g2
                for a in range(3):
                    pull[a] = (
                        inverse[a, 0] * w0 + inverse[a, 1] * w1 + inverse[a, 2] * w2
                    )
                score = out[cluster[i]]
                _add_score(
                    layout,
                    rows,
                    offset,
                    layout.frame_col[f],
                    force,
                    pull,
                    grad,
                    layout.camera[i],
                    of_point,
                    score,
                )


def clustered_covariance(
    layout: Layout,
    state: KernelState,
    eqs: NormalEquations,
    reduced: ReducedCovariance,
    cluster: IndexArray,
) -> Array:
    """Covariance (B, B) of the border, for errors shared within clusters.

    Args:
        layout, state, eqs: the problem at its least-squares optimum.
        reduced: inverse of the reduced system, unit noise.
        cluster: (N,) cluster of each sorted observation, counted from 0.
    """
    rows = reduced.border_rows
    scores = cluster_scores(layout, state, eqs, reduced, cluster, rows)
    return scores.T @ scores


def cluster_scores(
    layout: Layout,
    state: KernelState,
    eqs: NormalEquations,
    reduced: ReducedCovariance,
    cluster: IndexArray,
    rows: Array,
) -> Array:
    """What the residuals of each cluster do to some numbers (clusters, K).

    Args:
        layout, state, eqs, reduced, cluster: as of `clustered_covariance`.
        rows: (K, n) derivatives of the numbers by the unknowns of the reduced system,
            times S^-1.
    """
    scores = np.zeros((int(cluster.max()) + 1, len(rows)))
    rows = np.ascontiguousarray(rows)
    _scores(layout, state, eqs, reduced.points, cluster, rows, scores)
    return scores
