"""Relative pose of two rig frames from matches: gaps of water rays, and their descent.

The gap of a match (see `uwsfm.sfm.poses.epipolar.ray_gaps_px`) is the least move of
both pixels that makes their water rays meet, so that the sum of squared gaps is the
error of a two-view bundle adjustment whose points are eliminated. Its Jacobian by the
pose is taken at the midpoint of the rays, where the moves that a point can take up are
left out (variable projection, Kaufman 1975): exact where the gap is zero.
"""

import math

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.vec3 import dot
from uwsfm.models.projection import JAC_SIZE, project_with_jac
from uwsfm.models.status import VALID
from uwsfm.residuals.reprojection import point_in_rig
from uwsfm.sfm.poses.rig_pose_kernel import (
    copy_into,
    moved_pose,
    slope_along,
    solve_damped,
)
from uwsfm.solver.losses import INVALID_PX, rho

MIN_RELATIVE_DECREASE = 1e-7
MAX_DAMPING = 1e10
MAX_LOG_STEP = 2.0
# Of the squared sine between two rays: parallel to rounding.
MIN_SQUARED_SINE = 1e-14


@inner
def rows_in_rig(x, y, z, cam, lens, port, jac, rows):
    """Pixel of a point in the rig, with the Jacobian (2, 3) written to ``rows``.

    Args:
        x, y, z: the point in the rig.
        cam: (12,) cam_from_rig.
        lens, port: rows of the models.
        jac: (2, JAC_SIZE) scratch.
        rows: (2, 3), written.

    Returns:
        (status, px, py).
    """
    px, py, pz = point_in_rig(cam, (x, y, z))
    status, u, v = project_with_jac(px, py, pz, lens, port, jac)
    if status == VALID:
        for i in range(2):
            for k in range(3):
                rows[i, k] = (
                    jac[i, 0] * cam[k] + jac[i, 1] * cam[4 + k] + jac[i, 2] * cam[8 + k]
                )
    return status, u, v


@inner
def midpoint(pose, ray_a, ray_b):
    """Where two rays nearly meet, in both rigs; NaN unless in front of both.

    Args:
        pose: (12,) b_from_a.
        ray_a, ray_b: (6,) origin and unit direction, each in its own rig.
    """
    nan = math.nan
    dax, day, daz = ray_a[3], ray_a[4], ray_a[5]
    # The first ray in the second rig.
    oa = point_in_rig(pose, ray_a)
    da = (
        pose[0] * dax + pose[1] * day + pose[2] * daz,
        pose[4] * dax + pose[5] * day + pose[6] * daz,
        pose[8] * dax + pose[9] * day + pose[10] * daz,
    )
    db = (ray_b[3], ray_b[4], ray_b[5])
    between = (ray_b[0] - oa[0], ray_b[1] - oa[1], ray_b[2] - oa[2])
    cosine, along_a, along_b = dot(da, db), dot(da, between), dot(db, between)
    det = 1.0 - cosine * cosine
    range_a = (along_a - cosine * along_b) / det
    range_b = (cosine * along_a - along_b) / det
    if not (det > MIN_SQUARED_SINE and range_a > 0.0 and range_b > 0.0):
        return nan, nan, nan, nan, nan, nan
    bx = 0.5 * (oa[0] + range_a * da[0] + ray_b[0] + range_b * db[0])
    by = 0.5 * (oa[1] + range_a * da[1] + ray_b[1] + range_b * db[1])
    bz = 0.5 * (oa[2] + range_a * da[2] + ray_b[2] + range_b * db[2])
    x, y, z = bx - pose[3], by - pose[7], bz - pose[11]
    return (
        pose[0] * x + pose[4] * y + pose[8] * z,
        pose[1] * x + pose[5] * y + pose[9] * z,
        pose[2] * x + pose[6] * y + pose[10] * z,
        bx,
        by,
        bz,
    )


@inner
def gap_with_jac(i, pose, matches, rig, jac, rows, row):
    """(whether there is one, signed gap in pixels) of a match.

    Args:
        i: which.
        pose: (12,) rig_b_from_rig_a.
        matches: camera_a (N,), xy_a (N, 2), rays_a (N, 6), camera_b, xy_b, rays_b;
            rays in their own rigs.
        rig: rows of cam_from_rig (C, 12), of lenses and of ports.
        jac, rows: (2, JAC_SIZE) and (4, 3) scratch.
        row: (6,) d gap / d [rotation, translation] as `rigid3.perturb`, written.
    """
    camera_a, xy_a, rays_a, camera_b, xy_b, rays_b = matches
    cams, lenses, ports = rig
    ax, ay, az, x, y, z = midpoint(pose, rays_a[i], rays_b[i])
    if not abs(x) < math.inf:
        return False, math.nan
    c = camera_a[i]
    status, ua, va = rows_in_rig(
        ax, ay, az, cams[c], lenses[c], ports[c], jac, rows[:2]
    )
    if status != VALID:
        return False, math.nan
    c = camera_b[i]
    status, ub, vb = rows_in_rig(x, y, z, cams[c], lenses[c], ports[c], jac, rows[2:])
    if status != VALID:
        return False, math.nan
    for k in range(2):  # the first camera's rows, by the point in the second rig
        p, q, r = rows[k, 0], rows[k, 1], rows[k, 2]
        rows[k, 0] = pose[0] * p + pose[1] * q + pose[2] * r
        rows[k, 1] = pose[4] * p + pose[5] * q + pose[6] * r
        rows[k, 2] = pose[8] * p + pose[9] * q + pose[10] * r
    # The 3-plane of what a point can reach is perpendicular to this 4-vector.
    along_a, along_b = _cross(rows[0], rows[1]), _cross(rows[2], rows[3])
    in_ax, in_ay = dot(rows[1], along_b), -dot(rows[0], along_b)
    in_bx, in_by = dot(rows[3], along_a), -dot(rows[2], along_a)
    inv = 1.0 / math.sqrt(in_ax**2 + in_ay**2 + in_bx**2 + in_by**2)
    miss_a = in_ax * (ua - xy_a[i, 0]) + in_ay * (va - xy_a[i, 1])
    miss_b = in_bx * (ub - xy_b[i, 0]) + in_by * (vb - xy_b[i, 1])
    lx = (in_bx * rows[2, 0] + in_by * rows[3, 0]) * inv
    ly = (in_bx * rows[2, 1] + in_by * rows[3, 1]) * inv
    lz = (in_bx * rows[2, 2] + in_by * rows[3, 2]) * inv
    row[0], row[1], row[2] = y * lz - z * ly, z * lx - x * lz, x * ly - y * lx
    row[3], row[4], row[5] = lx, ly, lz
    return True, (miss_a + miss_b) * inv


@inner
def _cross(p, q):
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


@kernel
def gaps(pose, matches, rig, out):
    """Signed gaps (N,) in pixels, written; inf where the rays do not meet in front."""
    jac, rows, row = np.empty((2, JAC_SIZE)), np.empty((4, 3)), np.empty(6)
    for i in range(len(out)):
        valid, gap = gap_with_jac(i, pose, matches, rig, jac, rows, row)
        out[i] = gap if valid else math.inf


@kernel
def leverages(pose, matches, rig, covariance, out):
    """Variance of each gap (N,) by that of the pose (6, 6), written; inf without a gap.

    For a covariance at unit noise, the leverage of a match that the pose was fitted to.
    """
    jac, rows, row = np.empty((2, JAC_SIZE)), np.empty((4, 3)), np.empty(6)
    for i in range(len(out)):
        valid, _ = gap_with_jac(i, pose, matches, rig, jac, rows, row)
        total = 0.0 if valid else math.inf
        for a in range(6):
            for b in range(6):
                total += row[a] * covariance[a, b] * row[b]
        out[i] = total


@kernel
def midpoints(pose, matches, points):
    """Where rays nearly meet (N, 3), in the second rig, written; NaN as `midpoint`."""
    rays_a, rays_b = matches[2], matches[5]
    for i in range(len(points)):
        _, _, _, x, y, z = midpoint(pose, rays_a[i], rays_b[i])
        points[i, 0], points[i, 1], points[i, 2] = x, y, z


@kernel
def pair_equations(pose, matches, use, rig, robust, length_prior, hessian, grad):
    """J^T J (6, 6), lower triangle, J^T r (6,) and half the robust error.

    Args:
        pose, matches, rig: as `gap_with_jac`.
        use: (N,) which matches count.
        robust: (loss code, its scale).
        length_prior: (log of the length of the translation, its weight), or weight 0.
        hessian, grad: written, the prior included.
    """
    jac, rows, row = np.empty((2, JAC_SIZE)), np.empty((4, 3)), np.empty(6)
    hessian[:] = 0.0
    grad[:] = 0.0
    total = 0.0
    for i in range(len(use)):
        if not use[i]:
            continue
        valid, gap = gap_with_jac(i, pose, matches, rig, jac, rows, row)
        if not valid:
            value, _ = rho(INVALID_PX * INVALID_PX, robust[0], robust[1])
            total += value
            continue
        value, weight = rho(gap * gap, robust[0], robust[1])
        total += value
        for a in range(6):
            scaled = weight * row[a]
            grad[a] += scaled * gap
            for b in range(a + 1):
                hessian[a, b] += scaled * row[b]
    if length_prior[1] > 0.0:
        total += _add_length_prior(pose, length_prior, hessian, grad)
    return 0.5 * total


@inner
def _add_length_prior(pose, length_prior, hessian, grad):
    """weight (log |t| - mean)^2, which a turn does not change: its share of the sum."""
    x, y, z = pose[3], pose[7], pose[11]
    square = x * x + y * y + z * z
    miss = 0.5 * math.log(square) - length_prior[0]
    weight = length_prior[1]
    along = (x / square, y / square, z / square)
    for a in range(3):
        grad[3 + a] += weight * miss * along[a]
        for b in range(a + 1):
            hessian[3 + a, 3 + b] += weight * along[a] * along[b]
    return weight * miss * miss


@inner
def _moved_pair(pose, step, out):
    """The pose after a step: as `rigid3.perturb` to first order, but along the sphere.

    The translation turns by its step across and grows by the exponential of that along
    itself, so that a prior on the log of its length is a parabola, and one that holds
    it bars no turn.
    """
    moved_pose(pose, (step[0], step[1], step[2], 0.0, 0.0, 0.0), out)
    motion = (out[3], out[7], out[11])
    length = math.sqrt(dot(motion, motion))
    inv = 1.0 / length
    unit = (motion[0] * inv, motion[1] * inv, motion[2] * inv)
    along = dot((step[3], step[4], step[5]), unit)
    across = (
        (step[3] - along * unit[0]) * inv,
        (step[4] - along * unit[1]) * inv,
        (step[5] - along * unit[2]) * inv,
    )
    angle = math.sqrt(dot(across, across))
    sinc = math.sin(angle) / angle if angle > 1e-8 else 1.0
    length *= math.exp(min(max(along * inv, -MAX_LOG_STEP), MAX_LOG_STEP))
    cosine = math.cos(angle)
    out[3] = length * (cosine * unit[0] + sinc * across[0])
    out[7] = length * (cosine * unit[1] + sinc * across[1])
    out[11] = length * (cosine * unit[2] + sinc * across[2])


@kernel
def refine_pair(pose, matches, use, rig, robust, length_prior, max_iterations):
    """Minimise the sum of squared gaps by Levenberg-Marquardt; ``pose`` in place.

    Returns:
        (cost, J^T J (6, 6) at ``pose``, lower triangle, the prior included).
    """
    hessian, trial_hessian = np.empty((6, 6)), np.empty((6, 6))
    grad, trial_grad = np.empty(6), np.empty(6)
    factor, step, trial = np.empty((6, 6)), np.empty(6), np.empty(12)
    damping, growth = 1e-6, 4.0
    cost = pair_equations(pose, matches, use, rig, robust, length_prior, hessian, grad)
    for _ in range(max_iterations):
        found = math.inf
        if solve_damped(hessian, grad, damping, factor, step):
            _moved_pair(pose, step, trial)
            found = pair_equations(
                trial,
                matches,
                use,
                rig,
                robust,
                length_prior,
                trial_hessian,
                trial_grad,
            )
            if not found < cost and not -slope_along(grad, step) > 1e-12 * cost:
                break
        if not found < cost:
            damping, growth = damping * growth, growth * 2.0
            if damping > MAX_DAMPING:
                break
            continue
        decrease = cost - found
        cost = found
        copy_into(pose, trial)
        copy_into(hessian, trial_hessian)
        copy_into(grad, trial_grad)
        damping, growth = 0.1 * damping, 4.0
        if decrease < MIN_RELATIVE_DECREASE * cost or not cost > 1e-22 * len(use):
            break
    return cost, hessian
