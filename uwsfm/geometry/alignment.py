"""Alignment of matched places: rigid, or with a scale, least squares or robust."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array

NUM_TRIALS = 1000
"""Of triples: with half of the places wrong, 125 are right on average."""
NEAREST = 1e-9
"""Share that decides, where places on a line leave a turn open: the smallest turn."""
MEDIAN_CHI2_3 = 2.366
"""Median of the squared length of a 3-D standard normal vector."""
LIMIT_CHI2_3 = 16.27
"""One in a thousand is beyond it."""
ENOUGH = 300
"""Places that tell a mirror image; all of a long survey would take seconds."""
MUCH_BETTER = 2.0
"""Times less in squares. Of 3800 simulated tracks of 4 to 10 places, clean or a third
of them wrong, none seemed mirrored; of mirrored ones that are not flat, nearly half
of those of five places are told, and nine in ten of those of ten."""


HEIGHT_ROUNDS = 30
HEIGHT_FLOOR = 1e-2
"""Of the median miss: below it, misses weigh alike."""
FLAT_SHARE = 1e-6
"""Of the largest variance: places whose smallest is less lie in a plane, or on a
line (a millimetre over a metre)."""


class Similarity(NamedTuple):
    """y = scale R x + t."""

    scale: float
    y_from_x: Array
    """(7,) rotation, and the translation after scaling."""

    def apply(self, x: Array) -> Array:
        return rigid3.transform(self.y_from_x, self.scale * x)


def align(x: Array, y: Array, weights: Array, *, with_scale: bool) -> Similarity:
    """Least squares of weights |scale R x + t - y|^2 (Umeyama, PAMI 1991).

    Args:
        x, y: (N, 3) matched places.
        weights: (N,), not all zero.
        with_scale: else the scale is 1.
    """
    rotmat, scale, shift = _align(x[None], y[None], weights[None], with_scale)
    return Similarity(float(scale[0]), rigid3.from_rotmat(rotmat[0], shift[0]))


def align_robustly(
    x: Array, y: Array, covariances: Array, *, with_scale: bool, seed: int = 0
) -> Similarity:
    """Alignment that half of the places may contradict.

    The least median of squared misses over their covariances among triples drawn by
    chance, then least squares on what agrees with it.

    Args:
        x, y: (N, 3) matched places, at least three.
        covariances: (N, 3, 3) of y.
        with_scale: else the scale is 1.
        seed: of the triples.
    """
    rng = np.random.default_rng(seed)
    triples = np.argsort(rng.random((NUM_TRIALS, len(x))), axis=1)[:, :3]
    ones = np.ones(triples.shape)
    rotmat, scale, shift = _align(x[triples], y[triples], ones, with_scale)
    inverses = np.linalg.inv(covariances)
    medians = np.empty(NUM_TRIALS)
    for trial in range(NUM_TRIALS):
        miss = scale[trial] * x @ rotmat[trial].T + shift[trial] - y
        medians[trial] = np.median(np.einsum("ni,nij,nj->n", miss, inverses, miss))
    best = int(np.argmin(medians))
    found = Similarity(
        float(scale[best]), rigid3.from_rotmat(rotmat[best], shift[best])
    )
    weights = 3.0 / np.trace(covariances, axis1=1, axis2=2)
    for _ in range(10):
        miss = found.apply(x) - y
        squares = np.einsum("ni,nij,nj->n", miss, inverses, miss)
        limit = LIMIT_CHI2_3 * max(1.0, float(np.median(squares)) / MEDIAN_CHI2_3)
        near = squares <= limit
        if np.count_nonzero(near) < 3:
            break
        found = align(x, y, near * weights, with_scale=with_scale)
    return found


def fits_mirrored(x: Array, y: Array, covariances: Array, *, with_scale: bool) -> bool:
    """Whether places fit much better as their mirror image: axes of y are left-handed.

    Which of them is wrong does not matter: two swapped and one of the wrong sign differ
    by a rotation. Places in a plane are their own mirror image and do not tell.

    Args:
        x, y, covariances, with_scale: as of `align_robustly`.
    """
    if len(x) > ENOUGH:
        rows = np.linspace(0, len(x) - 1, ENOUGH).astype(int)
        x, y, covariances = x[rows], y[rows], covariances[rows]
    inverses = np.linalg.inv(covariances)

    def squares(x: Array, found: Similarity) -> Array:
        miss = found.apply(x) - y
        return np.einsum("ni,nij,nj->n", miss, inverses, miss)

    image = x * [-1.0, 1.0, 1.0]
    as_image = squares(
        image, align_robustly(image, y, covariances, with_scale=with_scale)
    )
    # The robust fit may take some of few right places for wrong; all together do not.
    weights = 3.0 / np.trace(covariances, axis1=1, axis2=2)
    as_given = (
        align_robustly(x, y, covariances, with_scale=with_scale),
        align(x, y, weights, with_scale=with_scale),
    )
    spread = max(1.0, float(np.median(as_image)) / MEDIAN_CHI2_3)
    # A wrong place counts no more than one at the limit does.
    image_cost = float(np.sum(np.minimum(as_image / spread, LIMIT_CHI2_3)))
    cost = min(
        float(np.sum(np.minimum(squares(x, found) / spread, LIMIT_CHI2_3)))
        for found in as_given
    )
    return cost > max(MUCH_BETTER * image_cost, image_cost + LIMIT_CHI2_3)


def align_heights(
    x: Array, heights: Array, up: Array, *, with_scale: bool
) -> Similarity:
    """Alignment of places to their heights alone: the tilt, and the height of zero.

    The least sum of |s u.x + t - h| over unit vectors u, by reweighted least squares: a
    tenth of the heights may be wrong. The heading is that of the smallest turn, and the
    middle of the places is put at x = y = 0.

    Args:
        x: (N, 3) places.
        heights: (N,) upwards.
        up: (3,) roughly upwards in the frame of x. Heights of places in a plane leave
            two tilts; the one nearer to this is taken.
        with_scale: else the scale is 1, as where places in a plane leave it open.
    """
    weights = np.ones(len(x))
    for _ in range(HEIGHT_ROUNDS):
        share = weights / weights.sum()
        middle, level = share @ x, share @ heights
        root = np.sqrt(share)[:, None]
        rows, wanted = root * (x - middle), root[:, 0] * (heights - level)
        u, scale = _upward(rows, wanted, up, with_scale)
        miss = scale * (x - middle) @ u - (heights - level)
        typical = float(np.median(np.abs(miss)))
        weights = 1.0 / np.maximum(np.abs(miss), HEIGHT_FLOOR * typical + 1e-12)
    axis = np.cross(u, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), u[2])
    if np.linalg.norm(axis) < 1e-12:
        axis = np.array([1.0, 0.0, 0.0])
    turn = rigid3.quat_from_rotvec(angle * axis / np.linalg.norm(axis))
    rotation = np.concatenate([turn, np.zeros(3)])
    shift = [0.0, 0.0, level] - scale * rigid3.rotate(rotation, middle)
    shift[:2] = -scale * rigid3.rotate(rotation, x.mean(axis=0))[:2]
    return Similarity(scale, np.concatenate([turn, shift]))


def _upward(
    rows: Array, wanted: Array, up: Array, with_scale: bool
) -> tuple[Array, float]:
    """The unit vector u (3,) and scale of the least squares of rows s u = wanted.

    Of a unit vector, (A'A + lam) u = A'b with the lam that makes it one (secular
    equation; Gander 1981).
    """
    values, axes = np.linalg.eigh(rows.T @ rows)
    values = np.maximum(values, 1e-3 * FLAT_SHARE * values[2])
    pull = axes.T @ (rows.T @ wanted)
    flat = values[0] < FLAT_SHARE * values[2]
    if with_scale and not flat:
        u = axes @ (pull / values)
        length = float(np.linalg.norm(u))
        return u / length, length
    parts = np.zeros(3)
    firm = values > FLAT_SHARE * values[2]
    parts[firm] = pull[firm] / values[firm]
    if not firm.all() and np.linalg.norm(parts) < 1.0:
        # What the places do not show fills up the length, towards `up`.
        rest = axes[:, ~firm] @ (axes[:, ~firm].T @ up)
        parts = axes @ parts
        missing = np.sqrt(1.0 - parts @ parts)
        u = parts + missing * rest / max(float(np.linalg.norm(rest)), 1e-12)
        return u / np.linalg.norm(u), 1.0

    def excess(lam: float) -> float:
        return float(np.linalg.norm(pull / (values + lam))) - 1.0

    low = -values[0] * (1.0 - 1e-9)
    high = float(np.linalg.norm(pull)) + values[2]
    if excess(low) <= 0.0:
        u = axes @ (pull / (values + low))
        rest = axes[:, 0] * np.sign(axes[:, 0] @ up)
        u = u + np.sqrt(max(0.0, 1.0 - u @ u)) * rest
    else:
        u = axes @ (pull / (values + brentq(excess, low, high)))
    return u / np.linalg.norm(u), 1.0


def _align(
    x: Array, y: Array, weights: Array, with_scale: bool
) -> tuple[Array, Array, Array]:
    """Rotations (T, 3, 3), scales (T,), shifts (T, 3) of T sets (T, N, 3)."""
    share = weights / weights.sum(axis=1, keepdims=True)
    x_mean, y_mean = (np.einsum("tn,tni->ti", share, z) for z in (x, y))
    x_off, y_off = x - x_mean[:, None], y - y_mean[:, None]
    moment = np.einsum("tn,tni,tnj->tij", share, y_off, x_off)
    size = np.linalg.norm(moment, axis=(1, 2))[:, None, None]
    left, values, right = np.linalg.svd(moment + NEAREST * size * np.eye(3))
    flip = np.ones_like(values)
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    rotmat = (left * flip[:, None]) @ right
    scale = np.ones(len(x))
    if with_scale:
        spread = np.einsum("tn,tni,tni->t", share, x_off, x_off)
        scale = np.sum(values * flip, axis=1) / np.maximum(spread, 1e-300)
    shift = y_mean - scale[:, None] * np.einsum("tij,tj->ti", rotmat, x_mean)
    return rotmat, scale, shift
