"""Where neighbours see what stands along an image's water rays, as a table.

Exact projection through a port is iterative: far too slow for the hundreds of
hypotheses that each pixel tries. It is smooth, though. For nodes of a grid over the
image and levels of inverse depth the exact water ray is followed and projected into
each neighbour; between nodes it is linear, between levels quadratic, to one or two
hundredths of a pixel (tests/test_dense_warp.py). The same numbers give the derivatives:
by the pixel and by the inverse depth, of which the affine warp of a slanted patch is
made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.jit import lane
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

NODE_STEP, SMALL_STEP = 8, 4
"""Pixels between nodes; and in small images, whose pixels are wider angles."""
SMALL_WIDTH = 500
NUM_LEVELS = 16

_F = np.float32
_HALF, _ONE = _F(0.5), _F(1.0)


@dataclass(frozen=True, kw_only=True)
class Placement:
    """A neighbouring image: its camera and where it is."""

    camera: RefractiveCamera
    from_reference: Array
    """(7,) pose, this camera from the reference camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WarpTable:
    """Of an image (h, w) and its S neighbours."""

    nodes: NDArray[np.float32]
    """(S, rows, columns, levels, 3): x and y in the neighbour, pixel centres at
    integers, and the inverse depth there; NaN where a neighbour sees nothing."""
    levels: NDArray[np.float32]
    """(3,) the first inverse depth, the step to the next, and pixels between nodes:
    node (i, j) is pixel (i, j) times that."""


def warp_table(
    camera: RefractiveCamera,
    neighbours: list[Placement],
    near: float,
    far: float,
) -> WarpTable:
    """Tabulate the exact projections.

    Args:
        camera: of the image.
        neighbours: S of them.
        near, far: depths along the camera's axis, metres.
    """
    counts = table_shape(camera)
    pixels = node_step(camera)
    y, x = (pixels * np.arange(n) + 0.5 for n in counts)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    origins, dirs = camera.ray_from_img(xy)
    inverse = np.linspace(1.0 / far, 1.0 / near, NUM_LEVELS)
    depth = 1.0 / inverse
    along = (depth - origins[:, 2:]) / dirs[:, 2:]  # (N, levels)
    points = origins[:, None] + along[..., None] * dirs[:, None]
    nodes = np.empty((len(neighbours), *counts, NUM_LEVELS, 3), dtype=np.float32)
    for table, neighbour in zip(nodes, neighbours, strict=True):
        there = rigid3.transform(neighbour.from_reference, points.reshape(-1, 3))
        seen, valid = neighbour.camera.img_from_point(there)
        valid &= there[:, 2] > 0.0
        with np.errstate(divide="ignore"):
            found = np.column_stack([seen - 0.5, 1.0 / there[:, 2]])
        found[~valid] = np.nan
        table[:] = found.reshape(table.shape)
    step = inverse[1] - inverse[0]
    levels = np.array([inverse[0], step, pixels], dtype=np.float32)
    return WarpTable(nodes=nodes, levels=levels)


def node_step(camera: RefractiveCamera) -> int:
    """Pixels between the nodes of an image."""
    return NODE_STEP if camera.width >= SMALL_WIDTH else SMALL_STEP


def table_shape(camera: RefractiveCamera) -> tuple[int, int]:
    """Rows and columns of nodes: they reach the last pixel."""
    step = node_step(camera)
    return -(-camera.height // step) + 1, -(-camera.width // step) + 1


def table_bytes(camera: RefractiveCamera, num_neighbours: int) -> float:
    """Of a table, and of what it takes to make it."""
    rows, columns = table_shape(camera)
    return rows * columns * NUM_LEVELS * (12.0 * num_neighbours + 200.0)


@lane
def warped(nodes, levels, s, x, y, w):
    """Where neighbour s sees the point of pixel (x, y) at inverse depth w.

    Args:
        nodes: (S, rows, columns, levels, 3) of `WarpTable`.
        levels: (3,) likewise.
        s: neighbour.
        x, y: pixel, centres at integers.
        w: inverse depth.

    Returns:
        x and y there (NaN: not seen), and their derivatives by x, by y and by w: eight
        float32.
    """
    i, j, fx, fy = _cell(nodes, levels, x, y)
    k, t = _level(nodes, levels, w)
    u, ux, uy, uw = _mixed(nodes, s, i, j, k, 0, fx, fy, t)
    v, vx, vy, vw = _mixed(nodes, s, i, j, k, 1, fx, fy, t)
    a, b = _ONE / levels[2], _ONE / levels[1]
    return u, v, ux * a, vx * a, uy * a, vy * a, uw * b, vw * b


@lane
def depth_there(nodes, levels, s, x, y, w):
    """Inverse depth at neighbour s of the same point, and its derivative by w."""
    i, j, fx, fy = _cell(nodes, levels, x, y)
    k, t = _level(nodes, levels, w)
    z, _, _, zw = _mixed(nodes, s, i, j, k, 2, fx, fy, t)
    return z, zw / levels[1]


@lane
def _cell(nodes, levels, x, y):
    """Row and column of the node before a pixel, and how far behind it the pixel is."""
    at_x, at_y = x / levels[2], y / levels[2]
    j = min(max(int(at_x), 0), nodes.shape[2] - 2)
    i = min(max(int(at_y), 0), nodes.shape[1] - 2)
    return i, j, at_x - _F(j), at_y - _F(i)


@lane
def _level(nodes, levels, w):
    """The middle one of three levels around an inverse depth, and how far from it."""
    at = (w - levels[0]) / levels[1]
    k = min(max(int(at + _HALF), 1), nodes.shape[3] - 2)
    return k, at - _F(k)


@lane
def _mixed(nodes, s, i, j, k, c, fx, fy, t):
    """One number of the nodes around a pixel, and its derivatives, per step."""
    p00, e00 = _along(nodes, s, i, j, k, c, t)
    p01, e01 = _along(nodes, s, i, j + 1, k, c, t)
    p10, e10 = _along(nodes, s, i + 1, j, k, c, t)
    p11, e11 = _along(nodes, s, i + 1, j + 1, k, c, t)
    top, bottom = p00 + fx * (p01 - p00), p10 + fx * (p11 - p10)
    by_x = (p01 - p00) + fy * ((p11 - p10) - (p01 - p00))
    above, below = e00 + fx * (e01 - e00), e10 + fx * (e11 - e10)
    return top + fy * (bottom - top), by_x, bottom - top, above + fy * (below - above)


@lane
def _along(nodes, s, i, j, k, c, t):
    """Of one node, between levels: value and derivative."""
    a, b, e = nodes[s, i, j, k - 1, c], nodes[s, i, j, k, c], nodes[s, i, j, k + 1, c]
    slope, curve = _HALF * (e - a), e - b - (b - a)
    return b + t * (slope + _HALF * t * curve), slope + t * curve
