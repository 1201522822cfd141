"""Points from tracks in which some keypoints are wrong.

A track is a set of keypoints that matches connect, right or wrong: it may hold two
keypoints of one image, or two points that one wrong match joined. Every pair of its
water rays proposes a point; the one that most images see within the tolerance, in true
pixels, is refined and takes its keypoints with it; what is left may hold another.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.jit import inner, kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.vec3 import add, cross, dot
from uwsfm.models.lens_row import FX
from uwsfm.models.ports.row import N_WATER
from uwsfm.models.projection import JAC_SIZE, project_with_jac
from uwsfm.models.status import VALID
from uwsfm.residuals.reprojection import point_in_rig, residual

IndexArray = NDArray[np.int64]

MAX_HYPOTHESES = 40
"""Pairs of rays that are tried per point. A track of 9 keypoints has no more; with half
of a longer one wrong, 40 random pairs miss every right one with chance 1e-5."""
MAX_POINTS = 4
"""Looked for in one track."""
MAX_ITERATIONS = 6
"""Of the refinement on the reprojection error: 3 are usual."""


class Views(NamedTuple):
    """Everything that projection needs, as rows; I images, N keypoints."""

    cam_from_world: Array
    """(I, 12) [R | t]; rows of images without a pose are not read."""
    camera: IndexArray
    """(I,)"""
    lenses: Array
    """(C, LENS_SIZE)"""
    ports: Array
    """(C, PORT_SIZE)"""
    image: IndexArray
    """(N,) of each keypoint."""
    xy: Array
    """(N, 2)"""
    origins: Array
    """(N, 3) of the water rays, in the world."""
    dirs: Array
    """(N, 3) unit."""


@inner
def squared_error(views, keypoint, x, y, z):
    """Squared reprojection error of a keypoint at a world point; inf if invalid."""
    i = views.image[keypoint]
    c = views.camera[i]
    status, u, v = residual(
        x,
        y,
        z,
        views.xy[keypoint],
        views.cam_from_world[i],
        views.lenses[c],
        views.ports[c],
    )
    return u * u + v * v if status == VALID else math.inf


@inner
def _midpoint(views, a, b):
    """(cosine of the angle, x, y, z): where two rays nearly meet; NaN if behind."""
    da = (views.dirs[a, 0], views.dirs[a, 1], views.dirs[a, 2])
    db = (views.dirs[b, 0], views.dirs[b, 1], views.dirs[b, 2])
    oa = (views.origins[a, 0], views.origins[a, 1], views.origins[a, 2])
    ob = (views.origins[b, 0], views.origins[b, 1], views.origins[b, 2])
    between = add(ob, -1.0, oa)
    cosine = dot(da, db)
    det = 1.0 - cosine * cosine
    range_a = (dot(da, between) - cosine * dot(db, between)) / det
    range_b = (cosine * dot(da, between) - dot(db, between)) / det
    if not (range_a > 0.0 and range_b > 0.0 and det > 1e-14):
        return cosine, math.nan, math.nan, math.nan
    p, q = add(oa, range_a, da), add(ob, range_b, db)
    return cosine, 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])


@inner
def _image_rows(views, keypoint, x, y, z, jac):
    """(status, miss (2), rows (6)): error of a keypoint and its slope in the world."""
    i = views.image[keypoint]
    c, cam = views.camera[i], views.cam_from_world[i]
    px, py, pz = point_in_rig(cam, (x, y, z))
    status, u, v = project_with_jac(px, py, pz, views.lenses[c], views.ports[c], jac)
    rows = (
        jac[0, 0] * cam[0] + jac[0, 1] * cam[4] + jac[0, 2] * cam[8],
        jac[0, 0] * cam[1] + jac[0, 1] * cam[5] + jac[0, 2] * cam[9],
        jac[0, 0] * cam[2] + jac[0, 1] * cam[6] + jac[0, 2] * cam[10],
        jac[1, 0] * cam[0] + jac[1, 1] * cam[4] + jac[1, 2] * cam[8],
        jac[1, 0] * cam[1] + jac[1, 1] * cam[5] + jac[1, 2] * cam[9],
        jac[1, 0] * cam[2] + jac[1, 1] * cam[6] + jac[1, 2] * cam[10],
    )
    return status, u - views.xy[keypoint, 0], v - views.xy[keypoint, 1], rows


@inner
def _gap(views, a, b, x, y, z, jac):
    """Sampson's distance, px, of two keypoints from those that a point near (x, y, z)
    can have: see `epipolar.ray_gaps_px`."""
    status_a, ua, va, ra = _image_rows(views, a, x, y, z, jac)
    status_b, ub, vb, rb = _image_rows(views, b, x, y, z, jac)
    if status_a != VALID or status_b != VALID:
        return math.inf
    da = cross((ra[0], ra[1], ra[2]), (ra[3], ra[4], ra[5]))
    db = cross((rb[0], rb[1], rb[2]), (rb[3], rb[4], rb[5]))
    # The normal of the 3-plane of reachable pixels (4): a's two coordinates, b's two.
    n0 = -(ra[3] * db[0] + ra[4] * db[1] + ra[5] * db[2])
    n1 = ra[0] * db[0] + ra[1] * db[1] + ra[2] * db[2]
    n2 = -(rb[3] * da[0] + rb[4] * da[1] + rb[5] * da[2])
    n3 = rb[0] * da[0] + rb[1] * da[1] + rb[2] * da[2]
    miss = abs(n0 * ua + n1 * va + n2 * ub + n3 * vb)
    return miss / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)


@kernel
def match_gaps_batch(views, ends, gaps):
    """Loop over matches: gaps (n,), written."""
    jac = np.empty((2, JAC_SIZE))
    for k in range(len(ends)):
        a, b = ends[k, 0], ends[k, 1]
        cosine, x, y, z = _midpoint(views, a, b)
        gap = math.inf
        if abs(x) < math.inf:
            gap = _gap(views, a, b, x, y, z, jac)
        if cosine > 0.0:
            c = views.camera[views.image[a]]
            focal = views.lenses[c, FX] * views.ports[c, N_WATER]
            turn = focal * math.sqrt(max(1.0 - cosine * cosine, 0.0))
            gap = min(gap, turn)
        gaps[k] = gap if gap >= 0.0 else math.inf


@inner
def _select(views, left, num_left, x, y, z, limit, chosen):
    """(cost, count): each image's nearest keypoint, ``chosen`` if within the limit.

    The cost is truncated (MSAC): every image costs its squared error or the limit.
    """
    cost, count, best, best_error, image = 0.0, 0, -1, limit, -1
    for k in range(num_left + 1):
        keypoint = left[k] if k < num_left else -1
        own = views.image[keypoint] if keypoint >= 0 else -1
        if own != image:
            if image >= 0:
                cost += best_error
                if best >= 0:
                    chosen[count] = best
                    count += 1
            best, best_error, image = -1, limit, own
        if keypoint >= 0:
            error = squared_error(views, keypoint, x, y, z)
            if error < best_error:
                best, best_error = keypoint, error
    return cost, count


@inner
def _gauss_newton_step(views, chosen, count, x, y, z, jac):
    """Step (3) towards the least reprojection error; NaN if it is not determined."""
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    g0, g1, g2 = 0.0, 0.0, 0.0
    for k in range(count):
        status, u, v, rows = _image_rows(views, chosen[k], x, y, z, jac)
        if status != VALID:
            continue
        for row in range(2):
            j0, j1, j2, error = rows[0], rows[1], rows[2], u
            if row == 1:
                j0, j1, j2, error = rows[3], rows[4], rows[5], v
            h00 += j0 * j0
            h01 += j0 * j1
            h02 += j0 * j2
            h11 += j1 * j1
            h12 += j1 * j2
            h22 += j2 * j2
            g0 += j0 * error
            g1 += j1 * error
            g2 += j2 * error
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    det = h00 * c00 + h01 * c01 + h02 * c02
    return (
        -(c00 * g0 + c01 * g1 + c02 * g2) / det,
        -(c01 * g0 + c11 * g1 + c12 * g2) / det,
        -(c02 * g0 + c12 * g1 + c22 * g2) / det,
    )


@inner
def _best_hypothesis(views, left, num_left, limit, max_cosine, seed, chosen):
    """(found, x, y, z): the point of two rays with the least truncated cost."""
    num_pairs = num_left * (num_left - 1) // 2
    num_images = 1
    for k in range(1, num_left):
        if views.image[left[k]] != views.image[left[k - 1]]:
            num_images += 1
    best_cost, found, x, y, z = math.inf, False, 0.0, 0.0, 0.0
    state = np.uint64(seed)
    a, b = 0, 0
    for _ in range(min(num_pairs, MAX_HYPOTHESES)):
        if num_pairs <= MAX_HYPOTHESES:
            b += 1
            if b == num_left:
                a += 1
                b = a + 1
        else:  # Knuth's MMIX generator: the same draws on every machine
            state = state * np.uint64(6364136223846793005) + np.uint64(
                1442695040888963407
            )
            draw = np.int64(state >> np.uint64(33))
            a = draw % num_left
            b = (a + 1 + (draw // num_left) % (num_left - 1)) % num_left
        if views.image[left[a]] == views.image[left[b]]:
            continue
        cosine, px, py, pz = _midpoint(views, left[a], left[b])
        if not (cosine <= max_cosine and abs(px) < math.inf):
            continue
        cost, count = _select(views, left, num_left, px, py, pz, limit, chosen)
        if count >= 2 and cost < best_cost:
            best_cost, found, x, y, z = cost, True, px, py, pz
            if count == num_images:  # no wrong one among them: the rest is refinement
                break
    return found, x, y, z


@inner
def _refined(views, left, num_left, x, y, z, limit, chosen, jac):
    """(count, x, y, z): the point moved to its least cost, and how many see it."""
    cost, count = _select(views, left, num_left, x, y, z, limit, chosen)
    for _ in range(MAX_ITERATIONS):
        dx, dy, dz = _gauss_newton_step(views, chosen, count, x, y, z, jac)
        if not abs(dx) + abs(dy) + abs(dz) < math.inf:
            break
        new_cost, count = _select(
            views, left, num_left, x + dx, y + dy, z + dz, limit, chosen
        )
        if not new_cost < cost:
            break
        done = cost - new_cost < 1e-6 * cost
        cost, x, y, z = new_cost, x + dx, y + dy, z + dz
        if done:
            break
    _, count = _select(views, left, num_left, x, y, z, limit, chosen)
    return count, x, y, z


@inner
def _least_cosine(views, chosen, count):
    """Of the angles between the rays of some keypoints."""
    least = 1.0
    for k in range(count):
        a = chosen[k]
        for m in range(k):
            b = chosen[m]
            cosine = (
                views.dirs[a, 0] * views.dirs[b, 0]
                + views.dirs[a, 1] * views.dirs[b, 1]
                + views.dirs[a, 2] * views.dirs[b, 2]
            )
            least = min(least, cosine)
    return least


@inner
def _remaining(track, point_of, left):
    """How many keypoints of a track have no point yet; writes them to ``left``."""
    count = 0
    for k in range(len(track)):
        if point_of[k] == -1:
            left[count] = track[k]
            count += 1
    return count


@inner
def _take(views, track, point_of, chosen, count, point, x, y, z, limit):
    """Give the chosen keypoints their point, and take its doubles away (-2): what else
    an image has there is the same feature twice."""
    taken = 0
    for k in range(len(track)):
        if taken < count and track[k] == chosen[taken]:
            point_of[k] = point
            taken += 1
        elif point_of[k] == -1 and squared_error(views, track[k], x, y, z) < limit:
            point_of[k] = -2


@kernel
def triangulate_batch(
    views, track_start, keypoints, limit, max_cosine, min_images, points, point_of
):
    """Loop over tracks: writes points and point_of, returns the number of points."""
    largest = 0
    for t in range(len(track_start) - 1):
        largest = max(largest, track_start[t + 1] - track_start[t])
    left, chosen = np.empty(largest, np.int64), np.empty(largest, np.int64)
    jac = np.empty((2, JAC_SIZE))
    num_points = np.int64(0)  # `_take` would be compiled once more for a literal
    for t in range(len(track_start) - 1):
        track = keypoints[track_start[t] : track_start[t + 1]]
        mine = point_of[track_start[t] : track_start[t + 1]]
        for _ in range(MAX_POINTS):
            num_left = _remaining(track, mine, left)
            if num_left < min_images:
                break
            found, x, y, z = _best_hypothesis(
                views, left, num_left, limit, max_cosine, track[0], chosen
            )
            if not found:
                break
            count, x, y, z = _refined(
                views, left, num_left, x, y, z, limit, chosen, jac
            )
            if count < min_images:
                break
            if not _least_cosine(views, chosen, count) <= max_cosine:
                break
            _take(views, track, mine, chosen, count, num_points, x, y, z, limit)
            points[num_points, 0], points[num_points, 1] = x, y
            points[num_points, 2] = z
            num_points += 1
        for k in range(len(track)):
            mine[k] = max(mine[k], -1)
    return num_points
