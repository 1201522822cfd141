"""Covariance that holds when neighbouring features err together.

The inverse of the normal equations promises that every observation errs alone. On real
images they do not: what the lens model leaves over, and how a feature detector sees a
slanted surface, is shared by neighbours. The cluster-robust ("sandwich") covariance of
Liang & Zeger (Biometrika 1986) lets observations of one cluster err in any common way:

    S^-1 (sum over clusters of s s^T) S^-1,   s = sum of J~^T r over a cluster

with S the reduced system and J~ the Jacobian after elimination of the points.

Residuals are not errors: each frame's pose has taken up what it can of the errors of
its own images, which are the larger part of what a quarter of an image has in common
(6 of the 16 numbers that the means of 8 quarters are). What a cluster would leave over
if it had not taken part in the fit is, after Bell & McCaffrey (Survey Methodology
2002),

    s' = (I - M S^-1)^-1 s,   M = sum of J~^T J~ over the cluster

which is the jackknife over clusters. What the pose of the cluster's own frame took is
given back, all else held: the border is shared by all clusters, and hardly one's own.
"""

import numpy as np

from uwsfm._base.jit import inner, kernel
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

MAX_LEVERAGE = 0.9
"""Of a cluster in the pose of its frame: without it, next to nothing would hold it."""
RIDGE = 1e-9
"""Relative: poses of a determined system are held better by far."""


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


@inner
def _pose_row(eqs, c, inverse, frame, j, row):
    """One row (6,) of J~ by the pose of its frame; j (3,) by the point in the rig."""
    w0 = frame[0] * j[0] + frame[4] * j[1] + frame[8] * j[2]
    w1 = frame[1] * j[0] + frame[5] * j[1] + frame[9] * j[2]
    w2 = frame[2] * j[0] + frame[6] * j[1] + frame[10] * j[2]
    t0 = inverse[0, 0] * w0 + inverse[0, 1] * w1 + inverse[0, 2] * w2
    t1 = inverse[1, 0] * w0 + inverse[1, 1] * w1 + inverse[1, 2] * w2
    t2 = inverse[2, 0] * w0 + inverse[2, 1] * w1 + inverse[2, 2] * w2
    x, y, z = eqs.cells[c, 3]
    for a in range(3):
        taken = eqs.cells[c, a, 0] * t0 + eqs.cells[c, a, 1] * t1
        row[3 + a] = j[a] - taken - eqs.cells[c, a, 2] * t2
    row[0] = y * row[5] - z * row[4]
    row[1] = z * row[3] - x * row[5]
    row[2] = x * row[4] - y * row[3]


@kernel
def _by_poses(layout, state, eqs, inverses, cluster, steps, share, pull, along):
    """What observations are by the poses of their frames, whose rows of J~ it makes.

    With no ``steps`` yet, sums over each cluster: J~^T J~ in ``share`` (clusters, 6, 6)
    and J~^T r in ``pull`` (clusters, 6); then with steps (clusters, 6) of the poses,
    J~ step of each observation in ``along`` (N, 2). Nothing of a frame that is held.
    """
    j_port, j_rig = np.empty((2, JAC_SIZE)), np.empty((2, 3))
    j_border, row = np.zeros((2, BORDER_SIZE)), np.empty(6)
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            if layout.frame_col[layout.cell_frame[c]] == HELD:
                continue
            frame = state.frames[layout.cell_frame[c]]
            x, y, z = point_in_rig(frame, state.points[p])
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                status, rx, ry = linearized_residual(
                    layout, state, i, x, y, z, j_port, j_rig, j_border
                )
                if status != VALID:
                    continue
                own = cluster[i]
                for a, residual in enumerate((rx, ry)):
                    _pose_row(eqs, c, inverses[p], frame, j_rig[a], row)
                    for m in range(6):
                        if len(steps):
                            along[i, a] += row[m] * steps[own, m]
                            continue
                        pull[own, m] += row[m] * residual
                        for n in range(6):
                            share[own, m, n] += row[m] * row[n]


@kernel
def _scores(layout, state, eqs, inverses, cluster, rows, given_back, out):
    """Sum some rows' part of S^-1 J~^T r of each cluster, (clusters, K); squared loss.
    All rows' would be as large as frames times clusters. Residuals r have `given_back`
    added to them."""
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
                rx += given_back[i, 0]
                ry += given_back[i, 1]
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
        cluster: (N,) cluster of each sorted observation, counted from 0; each in one
            frame.
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
    back = given_back(layout, state, eqs, reduced, cluster)
    _scores(layout, state, eqs, reduced.points, cluster, rows, back, scores)
    return scores


def given_back(
    layout: Layout,
    state: KernelState,
    eqs: NormalEquations,
    reduced: ReducedCovariance,
    cluster: IndexArray,
) -> Array:
    """What residuals would be larger by (N, 2), if their cluster had no part in the
    pose of its frame.

    Zero in the first frame, whose pose is held.

    Args:
        layout, state, eqs, reduced, cluster: as of `clustered_covariance`.
    """
    num_clusters = int(cluster.max()) + 1
    share, pull = np.zeros((num_clusters, 6, 6)), np.zeros((num_clusters, 6))
    out, problem = np.zeros((len(layout.xy), 2)), (layout, state, eqs, reduced.points)
    _by_poses(*problem, cluster, np.empty((0, 6)), share, pull, out)
    frame = np.zeros(num_clusters, dtype=np.int64)
    frame[cluster] = np.repeat(layout.cell_frame, np.diff(layout.cell_start))
    whole = reduced.poses[frame]
    whole[layout.frame_col[frame] == HELD] = np.eye(6)
    steps = _steps_without(whole, share, pull)
    _by_poses(*problem, cluster, steps, share, pull, out)
    return out


def _steps_without(whole: Array, share: Array, pull: Array) -> Array:
    """(P - M)^-1 s of each cluster (G, 6); what nearly all hangs on counts as less."""
    ridge = RIDGE * np.einsum("gaa->ga", whole)[:, :, None] * np.eye(6)
    lower = np.linalg.cholesky(whole + ridge)
    inverse = np.linalg.inv(lower)
    leverage, axes = np.linalg.eigh(inverse @ share @ np.swapaxes(inverse, 1, 2))
    back = np.swapaxes(inverse, 1, 2) @ axes  # (G, 6, 6)
    along = np.einsum("gam,ga->gm", back, pull)
    along /= 1.0 - np.minimum(leverage, MAX_LEVERAGE)
    return np.einsum("gam,gm->ga", back, along)
