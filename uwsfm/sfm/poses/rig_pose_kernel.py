"""The pose of a rig over known points: errors, and Levenberg-Marquardt in one kernel.

Six unknowns and some hundred observations: all that `levenberg_marquardt` builds for
thousands of frames would cost more than the solution.
"""

import math

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.projection import JAC_SIZE, project_with_jac
from uwsfm.models.status import VALID
from uwsfm.residuals.reprojection import point_in_rig, residual
from uwsfm.solver.losses import INVALID_PX, rho

POSE_SIZE = 6
MIN_DIAGONAL = 1e-12
MAX_DAMPING = 1e10
MIN_EIGENVALUE = 1e-12
"""Of a scaled Hessian: what is smaller is rounding."""
MIN_RELATIVE_DECREASE = 1e-7
"""Of some hundred observations: one hundredth of a standard deviation of the pose."""


@kernel
def squared_errors(pose, matches, rig, squares):
    """Squared reprojection errors (N,), pixels; inf where a point does not project.

    Args:
        pose: (12,) rig_from_world as a row of [R | t].
        matches: points in the world (N, 3), camera_idx (N,), xy (N, 2).
        rig: rows of cam_from_rig (C, 12), of lenses and of ports.
        squares: (N,), written.
    """
    points, camera_idx, xy = matches
    cams, lenses, ports = rig
    for i in range(len(points)):
        c = camera_idx[i]
        x, y, z = point_in_rig(pose, points[i])
        status, rx, ry = residual(x, y, z, xy[i], cams[c], lenses[c], ports[c])
        squares[i] = rx * rx + ry * ry if status == VALID else math.inf


@inner
def pose_cost(pose, matches, use, rig, loss, scale):
    """Half the robust error of the observations in use (N,)."""
    points, camera_idx, xy = matches
    cams, lenses, ports = rig
    total = 0.0
    for i in range(len(points)):
        if not use[i]:
            continue
        c = camera_idx[i]
        x, y, z = point_in_rig(pose, points[i])
        status, rx, ry = residual(x, y, z, xy[i], cams[c], lenses[c], ports[c])
        square = rx * rx + ry * ry if status == VALID else INVALID_PX * INVALID_PX
        value, _ = rho(square, loss, scale)
        total += value
    return 0.5 * total


@inner
def normal_equations(pose, matches, use, rig, loss, scale, hessian, grad):
    """J^T J (6, 6), J^T r (6,) and the cost; tangent as `rigid3.perturb`."""
    points, camera_idx, xy = matches
    cams, lenses, ports = rig
    jac = np.empty((2, JAC_SIZE))
    row = np.empty(POSE_SIZE)
    hessian[:] = 0.0
    grad[:] = 0.0
    total = 0.0
    for i in range(len(points)):
        if not use[i]:
            continue
        c = camera_idx[i]
        cam = cams[c]
        x, y, z = point_in_rig(pose, points[i])
        px, py, pz = point_in_rig(cam, (x, y, z))
        status, u, v = project_with_jac(px, py, pz, lenses[c], ports[c], jac)
        if status != VALID:
            value, _ = rho(INVALID_PX * INVALID_PX, loss, scale)
            total += value
            continue
        rx, ry = u - xy[i, 0], v - xy[i, 1]
        value, weight = rho(rx * rx + ry * ry, loss, scale)
        total += value
        for k in range(2):
            error = rx if k == 0 else ry
            j0, j1, j2 = jac[k, 0], jac[k, 1], jac[k, 2]
            lx = j0 * cam[0] + j1 * cam[4] + j2 * cam[8]
            ly = j0 * cam[1] + j1 * cam[5] + j2 * cam[9]
            lz = j0 * cam[2] + j1 * cam[6] + j2 * cam[10]
            # l . (w x p) = w . (p x l) for a turn w of the point p in the rig
            row[0], row[1], row[2] = y * lz - z * ly, z * lx - x * lz, x * ly - y * lx
            row[3], row[4], row[5] = lx, ly, lz
            for a in range(POSE_SIZE):
                scaled = weight * row[a]
                grad[a] += scaled * error
                for b in range(a + 1):
                    hessian[a, b] += scaled * row[b]
    return 0.5 * total


@inner
def solve_damped(hessian, grad, damping, factor, step):
    """step = -(H + damping diag H)^-1 g by Cholesky; whether H is positive definite.

    Args:
        hessian: (K, K), of which the lower triangle is read.
        grad: (K,)
        damping: Marquardt's.
        factor: (K, K) scratch.
        step: (K,), written.
    """
    size = len(grad)
    for a in range(size):
        for b in range(a + 1):
            value = hessian[a, b]
            if a == b:
                value += damping * max(value, MIN_DIAGONAL)
            for k in range(b):
                value -= factor[a, k] * factor[b, k]
            if a > b:
                factor[a, b] = value / factor[b, b]
            elif value > 0.0:
                factor[a, a] = math.sqrt(value)
            else:
                return False
    for a in range(size):
        value = -grad[a]
        for k in range(a):
            value -= factor[a, k] * step[k]
        step[a] = value / factor[a, a]
    for a in range(size - 1, -1, -1):
        value = step[a]
        for k in range(a + 1, size):
            value -= factor[k, a] * step[k]
        step[a] = value / factor[a, a]
    return True


@inner
def copy_into(out, values):
    """out[:] = values, of which numba would compile the error message too."""
    flat_out, flat_values = out.ravel(), values.ravel()
    for i in range(len(flat_values)):
        flat_out[i] = flat_values[i]


@inner
def slope_along(grad, step):
    """<grad, step>"""
    total = 0.0
    for i in range(len(step)):
        total += grad[i] * step[i]
    return total


@inner
def moved_pose(pose, step, out):
    """The row of [R | t] after a left perturbation, see `rigid3.perturb`; written."""
    x, y, z = step[0], step[1], step[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-4:  # the next terms of both series are below rounding
        s, c = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    r00, r01, r02 = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    r10, r11, r12 = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    r20, r21, r22 = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)
    for k in range(4):
        a, b, d = pose[k], pose[4 + k], pose[8 + k]
        out[k] = r00 * a + r01 * b + r02 * d
        out[4 + k] = r10 * a + r11 * b + r12 * d
        out[8 + k] = r20 * a + r21 * b + r22 * d
    out[3] += step[3]
    out[7] += step[4]
    out[11] += step[5]


@kernel
def refine_pose(pose, matches, use, rig, loss, scale, max_iterations):
    """Minimise `pose_cost` by Levenberg-Marquardt; ``pose`` is changed in place.

    Returns:
        (cost, J^T J (6, 6) where the last step was taken from, lower triangle).
    """
    hessian, factor = np.empty((6, 6)), np.empty((6, 6))
    grad, step, trial = np.empty(6), np.empty(6), np.empty(12)
    damping, growth = 1e-6, 4.0
    cost = normal_equations(pose, matches, use, rig, loss, scale, hessian, grad)
    for _ in range(max_iterations):
        if not solve_damped(hessian, grad, damping, factor, step):
            damping = max(damping, 1e-6) * growth
            growth *= 2.0
            if damping > MAX_DAMPING:
                break
            continue
        moved_pose(pose, step, trial)
        found = pose_cost(trial, matches, use, rig, loss, scale)
        decrease = cost - found
        if not decrease > 0.0:
            # At the minimum nothing but rounding is left to gain.
            if not -slope_along(grad, step) > 1e-12 * cost:
                break
            damping, growth = damping * growth, growth * 2.0
            if damping > MAX_DAMPING:
                break
            continue
        copy_into(pose, trial)
        damping, growth = 0.1 * damping, 4.0
        small = decrease < MIN_RELATIVE_DECREASE * cost
        cost = normal_equations(pose, matches, use, rig, loss, scale, hessian, grad)
        if small or not cost > 1e-22 * len(use):
            break
    return cost, hessian


def covariance_from_hessian(hessian: Array, noise: float) -> Array:
    """noise^2 H^-1 (K, K) of a lower triangle; inf if H is singular to rounding."""
    full = np.tril(hessian) + np.tril(hessian, -1).T
    # In units of its own diagonal: rotations are radians, translations metres.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(full), 1e-300))
    values, vectors = np.linalg.eigh(full * np.outer(scale, scale))
    if not values[0] > MIN_EIGENVALUE:
        return np.full(full.shape, np.inf)
    return noise**2 * ((vectors / values) @ vectors.T) * np.outer(scale, scale)
