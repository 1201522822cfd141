"""Hypotheses for plain areas: planes through what is sure around them.

Where an image is plain, patches are alike at any depth and chance finds nothing. Sure
pixels of the image are triangulated, and each triangle is taken for a plane (Xu and
Tao, AAAI 2020, who weigh such a plane against the likeness; here it is a hypothesis
like any other, and what neighbours find decides whether it stays).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from uwsfm.dense.match import Gray
from uwsfm.dense.patch import RADIUS

PLAIN_PERCENT, PLAIN_SHARE = 2.0, 0.01
"""Windows that are taken for plain, and at most how much of the slopes of all windows
theirs have: an image that has texture everywhere has no plain ones."""
TIMES_PLAIN = 1.5
"""What of an image counts as plain."""
QUANTIZED = 1.0 / 6.0
"""Grey levels squared: slopes that rounding makes."""
SURE_COST = 0.35
"""Below which a hypothesis is a corner of triangles."""
CELL = 5
"""Pixels between corners, about."""
MAX_SIDE = 80.0
"""Pixels of the longest side of a triangle: beyond it nobody knows what is between."""
MAX_TANGENT = 2.0
"""Between a plane and the one across the camera's axis: steeper ones are steps."""


def slope_energy(image: Gray) -> NDArray[np.float32]:
    """(H, W) mean square of the slopes of a grey image in windows of a patch's size."""
    gray = image.astype(np.float32)
    across, down = np.diff(gray, axis=1), np.diff(gray, axis=0)
    energy = np.zeros_like(gray)
    energy[:-1, :-1] = 0.5 * (across[:-1] ** 2 + down[:, :-1] ** 2)
    side = 2 * RADIUS + 1
    return np.asarray(cv2.blur(energy, (side, side)))


def plain_energy(energy: NDArray[np.float32]) -> float:
    """That of the plainest windows: of noise, if some of the image is plain."""
    inside = energy[RADIUS : -RADIUS - 1, RADIUS : -RADIUS - 1]
    if not inside.size:
        return 0.0
    plain = max(float(np.percentile(inside, PLAIN_PERCENT)), QUANTIZED)
    return min(plain, PLAIN_SHARE * float(inside.mean()))


def is_plain(image: Gray) -> NDArray[np.bool_]:
    """(H, W) where a grey image has nothing but noise."""
    energy = slope_energy(image)
    return energy < TIMES_PLAIN * plain_energy(energy)


def with_planes(
    planes: NDArray[np.float32],
    costs: NDArray[np.float32],
    image: Gray,
    focal: float,
) -> NDArray[np.float32]:
    """Hypotheses (H, W, 3), those in plain areas replaced by planes where there are.

    Args:
        planes: (H, W, 3) hypotheses: inverse depth, and its growth per pixel.
        costs: (H, W) of them.
        image: (H, W) grey.
        focal: pixels per tangent.
    """
    plain = is_plain(image)
    corners = _corners(np.where(plain, np.inf, costs))
    if len(corners) < 3 or not plain.any():
        return planes
    try:
        mesh = Delaunay(corners[:, ::-1].astype(np.float64))
    except QhullError:  # all on a line
        return planes
    x, y = corners[:, 1], corners[:, 0]
    slopes = _plane_slopes(mesh, planes[y, x, 0])
    at = np.argwhere(plain)
    triangle = mesh.find_simplex(at[:, ::-1].astype(np.float64))
    fits = _fits(mesh, slopes, planes[y, x, 0], focal)
    keep = (triangle >= 0) & fits[triangle]
    at, triangle = at[keep], triangle[keep]
    first = corners[mesh.simplices[triangle, 0]]
    step = (at - first)[:, ::-1]
    found = planes.copy()
    held = planes[first[:, 0], first[:, 1], 0]
    found[at[:, 0], at[:, 1], 0] = held + np.sum(slopes[triangle] * step, axis=1)
    found[at[:, 0], at[:, 1], 1:] = slopes[triangle]
    return found


def _corners(costs: NDArray[np.float32]) -> NDArray[np.int64]:
    """Row and column (N, 2) of the surest pixel of each cell that has a sure one."""
    height, width = (n - n % CELL for n in costs.shape)
    cells = costs[:height, :width].reshape(height // CELL, CELL, width // CELL, CELL)
    flat = cells.transpose(0, 2, 1, 3).reshape(height // CELL, width // CELL, -1)
    best = flat.argmin(axis=2)
    row, column = np.nonzero(flat.min(axis=2, initial=np.inf) < SURE_COST)
    y, x = np.divmod(best[row, column], CELL)
    return np.stack([row * CELL + y, column * CELL + x], axis=1)


def _plane_slopes(mesh: Delaunay, values: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T, 2) growth per pixel to the right and down over each triangle."""
    corners = mesh.points[mesh.simplices]
    sides = corners[:, 1:] - corners[:, :1]
    rise = values[mesh.simplices].astype(np.float64)
    rise = rise[:, 1:] - rise[:, :1]
    a, b = sides[:, 0], sides[:, 1]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        right = (rise[:, 0] * b[:, 1] - rise[:, 1] * a[:, 1]) / area
        down = (rise[:, 1] * a[:, 0] - rise[:, 0] * b[:, 0]) / area
    return np.stack([right, down], axis=1)


def _fits(
    mesh: Delaunay,
    slopes: NDArray[np.float64],
    values: NDArray[np.float32],
    focal: float,
) -> NDArray[np.bool_]:
    """(T,) whether a triangle is small and no step in depth."""
    corners = mesh.points[mesh.simplices]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    inverse = values[mesh.simplices].mean(axis=1)
    with np.errstate(invalid="ignore"):
        tangent = np.abs(slopes).sum(axis=1) * focal / inverse
        return (sides.max(axis=1) <= MAX_SIDE) & (tangent < MAX_TANGENT)
