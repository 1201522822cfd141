"""RANSAC over poses of a rig from three water rays, in one kernel.

Hypotheses are exact (`uwsfm.geometry.p3p`), scored by the truncated squared
reprojection error (MSAC, Torr & Zisserman 2000) in true pixels, and the best so far is
adjusted to its inliers (LO-RANSAC, Chum et al. 2003).
"""

import math

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.p3p import poses_from_three
from uwsfm.models.status import VALID
from uwsfm.residuals.reprojection import point_in_rig, residual
from uwsfm.sfm.poses.rig_pose_kernel import copy_into, refine_pose, squared_errors
from uwsfm.solver.losses import LOSS_CODES

CAUCHY = LOSS_CODES["cauchy"]
LOCAL_ITERATIONS = 3
# Samples drawn of inliers alone still miss, through noise, about this often.
MIN_GOOD = 0.5


@inner
def truncated_error(pose, matches, rig, limit, best):
    """(sum of min(error^2, limit), inliers); it stops when it exceeds ``best``."""
    points, camera_idx, xy = matches
    cams, lenses, ports = rig
    total, inliers = 0.0, 0
    for i in range(len(points)):
        c = camera_idx[i]
        x, y, z = point_in_rig(pose, points[i])
        status, rx, ry = residual(x, y, z, xy[i], cams[c], lenses[c], ports[c])
        square = rx * rx + ry * ry if status == VALID else math.inf
        if square < limit:
            total += square
            inliers += 1
        else:
            total += limit
        if total >= best:
            return math.inf, 0
    return total, inliers


@kernel
def trials_needed(inliers, total, confidence):
    """How many samples hold one of inliers alone, with this confidence."""
    ratio = inliers / total
    good = MIN_GOOD * ratio * ratio * ratio
    if good <= 0.0:
        return math.inf
    return math.log(1.0 - confidence) / math.log(1.0 - good)


@kernel
def search_pose(samples, rays, matches, rig, limit, best, pose):
    """Try samples; keep the best pose.

    Args:
        samples: (K, 3) indices of observations.
        rays: (N, 6) water rays in the rig.
        matches, rig: as in `rig_pose.squared_errors`.
        limit: squared pixels, above which an observation is an outlier.
        best: the truncated error of ``pose``, or inf.
        pose: (12,), the best so far, written.

    Returns:
        (truncated error of ``pose``, its inliers or -1 if it was not changed).
    """
    points = matches[0]
    ranges, poses = np.empty((4, 3)), np.empty((4, 12))
    squares = np.empty(len(points))
    local = np.empty(12)
    inliers = -1
    for s in range(len(samples)):
        i, j, k = samples[s, 0], samples[s, 1], samples[s, 2]
        found = poses_from_three(rays, points, i, j, k, ranges, poses)
        for n in range(found):
            error, count = truncated_error(poses[n], matches, rig, limit, best)
            if not error < best:
                continue
            best, inliers = error, count
            copy_into(pose, poses[n])
            if count < 4:
                continue
            squared_errors(pose, matches, rig, squares)
            copy_into(local, pose)
            refine_pose(
                local,
                matches,
                squares < limit,
                rig,
                np.int64(CAUCHY),  # a literal would compile everything once more
                0.5 * math.sqrt(limit),
                np.int64(LOCAL_ITERATIONS),
            )
            error, count = truncated_error(local, matches, rig, limit, best)
            if error < best:
                best, inliers = error, count
                copy_into(pose, local)
    return best, inliers
