"""Reprojection errors of a run of points: gathered by camera, evaluated in lanes.

A chunk is as many points, with all their observations, as keep their rows in the L2
cache. Row j belongs to the j-th observation of the chunk.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from uwsfm._base.jit import inner
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lanes import BLOCK, OK, PX, PY, SIZE, STRIDE, X, Y, Z
from uwsfm.models.lens import NUM_PARAMS
from uwsfm.models.projection import JAC_SIZE
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.residuals.reprojection import point_in_rig, residual
from uwsfm.residuals.reprojection_lanes import (
    COLUMN_OF_SLOT,
    RESIDUAL,
    jac_from_rig,
    lens_columns,
    project_from_rig,
    redo_lane,
)
from uwsfm.scene import IndexArray
from uwsfm.solver.lane_products import (
    CELL,
    COUPLE,
    RES_U,
    RES_V,
    multiply_camera,
    multiply_cells,
    num_fours,
    weigh,
)
from uwsfm.solver.layout import Layout
from uwsfm.solver.losses import CAUCHY, INVALID_PX

CHUNK: Final = 512
"""Observations, unless one point has more."""

ROW: Final = 9
"""Columns of a row: H (6, lower triangle) and g (3) by the point in the rig."""
GRAD: Final = 6


class Chunk(NamedTuple):
    """Scratch for one chunk of at most M observations by C cameras."""

    rows: Array
    """(M, ROW) weighted products; zero where invalid."""
    fours: Array
    """(M, 3 fours of W, 4): x coupled to the free parameters of the camera, in as many
    fours as it has; then y, and z."""
    errors: Array
    """(M, 2) residuals in pixels, NaN where invalid."""
    in_rig: Array
    """(M, 3) the point of each observation."""
    bucket: IndexArray
    """(C, M) the observations of each camera, counted from the chunk's first."""
    counts: IndexArray
    """(C,) how many there are."""
    columns: IndexArray
    """(C, W + 1)"""
    buffer: Array
    """Lanes, see `uwsfm.models.lanes`."""
    products: Array
    """Lanes, see `uwsfm.solver.lane_products`."""
    j_lens: Array
    j_port: Array
    j_rig: Array
    j_border: Array
    """Scratch of the scalar kernels."""


def width(layout: Layout) -> int:
    """W: the most columns that are free of one camera."""
    return int(np.diff(layout.free_start).max())


def largest_chunk(layout: Layout) -> int:
    """Observations of the largest chunk of a layout."""
    # One point may have more observations than a chunk should.
    return max(CHUNK, int(np.diff(layout.cell_start[layout.point_start]).max()))


def new_chunk(layout: Layout, largest: int) -> Chunk:
    """Scratch for chunks of a layout, of at most so many observations."""
    num_cameras = len(layout.free_start) - 1
    fours = 3 * num_fours(width(layout))
    return Chunk(
        rows=np.zeros((largest, ROW)),
        fours=np.zeros((largest, fours, 4)),
        errors=np.empty((largest, 2)),
        in_rig=np.empty((largest, 3)),
        bucket=np.empty((num_cameras, largest), dtype=np.int64),
        counts=np.empty(num_cameras, dtype=np.int64),
        columns=_columns(layout),
        buffer=np.empty(SIZE),
        products=np.empty((COUPLE + 4 * fours) * STRIDE),
        j_lens=np.empty((2, NUM_PARAMS)),
        j_port=np.empty((2, JAC_SIZE)),
        j_rig=np.empty((2, 3)),
        j_border=np.zeros((2, BORDER_SIZE)),
    )


def _columns(layout: Layout) -> IndexArray:
    """(C, W + 1): lanes' columns of the residual and a camera's parameters."""
    num_cameras = len(layout.free_start) - 1
    columns = np.full((num_cameras, width(layout) + 1), RESIDUAL)
    for k in range(num_cameras):
        slots = layout.free_slot[layout.free_start[k] : layout.free_start[k + 1]]
        columns[k, 1 : len(slots) + 1] = COLUMN_OF_SLOT[slots]
    return columns


@inner
def chunk_end(layout, p, end):
    """The point after the last one of the chunk that starts with point p."""
    first = layout.cell_start[layout.point_start[p]]
    p += 1
    while p < end:
        if layout.cell_start[layout.point_start[p + 1]] - first > CHUNK:
            break
        p += 1
    return p


@inner
def gather(layout, state, first_point, last_point, chunk):
    """Move the points to the rig and list the observations of each camera."""
    counts, bucket, in_rig = chunk.counts, chunk.bucket, chunk.in_rig
    point_start, cell_start = layout.point_start, layout.cell_start
    cell_frame, camera = layout.cell_frame, layout.camera
    frames, points = state.frames, state.points
    for k in range(len(counts)):
        counts[k] = 0
    first = cell_start[point_start[first_point]]
    for p in range(first_point, last_point):
        for c in range(point_start[p], point_start[p + 1]):
            x, y, z = point_in_rig(frames[cell_frame[c]], points[p])
            for i in range(cell_start[c], cell_start[c + 1]):
                j, k = i - first, camera[i]
                in_rig[j, 0], in_rig[j, 1], in_rig[j, 2] = x, y, z
                bucket[k, counts[k]] = j
                counts[k] += 1
    return first


@inner
def _load(chunk, camera, start, count):
    """Points in the rig of a camera's observations into lanes."""
    bucket, in_rig, buffer = chunk.bucket, chunk.in_rig, chunk.buffer
    for i in range(BLOCK):
        j = bucket[camera, start + min(i, count - 1)]
        buffer[X * STRIDE + i] = in_rig[j, 0]
        buffer[Y * STRIDE + i] = in_rig[j, 1]
        buffer[Z * STRIDE + i] = in_rig[j, 2]


@inner
def evaluate(layout, state, first, chunk):
    """Residuals of a gathered chunk into ``errors``."""
    errors, buffer, bucket = chunk.errors, chunk.buffer, chunk.bucket
    xy = layout.xy
    for k in range(len(chunk.counts)):
        cam, lens, port = state.cams[k], state.lenses[k], state.ports[k]
        for start in range(0, chunk.counts[k], BLOCK):
            count = min(BLOCK, chunk.counts[k] - start)
            _load(chunk, k, start, count)
            project_from_rig(cam, lens, port, buffer)
            for i in range(count):
                j = bucket[k, start + i]
                if buffer[OK * STRIDE + i] == 1.0:
                    errors[j, 0] = buffer[PX * STRIDE + i] - xy[first + j, 0]
                    errors[j, 1] = buffer[PY * STRIDE + i] - xy[first + j, 1]
                else:
                    x, y, z = chunk.in_rig[j]
                    seen = xy[first + j]
                    _, rx, ry = residual(x, y, z, seen, cam, lens, port)
                    errors[j, 0], errors[j, 1] = rx, ry


@inner
def evaluate_with_jac(layout, state, first, loss, scale, sums, chunk):
    """Products of residuals and Jacobians of a gathered chunk: ``rows``, ``fours``.

    Args:
        sums: (C, W, W + 1), added to: each camera against the residual and itself.
    """
    buffer, products = chunk.buffer, chunk.products
    rows, fours, bucket = chunk.rows, chunk.fours, chunk.bucket
    for k in range(len(chunk.counts)):
        num_free = layout.free_start[k + 1] - layout.free_start[k]
        num_rows = 3 * num_fours(num_free)
        for start in range(0, chunk.counts[k], BLOCK):
            count = min(BLOCK, chunk.counts[k] - start)
            _load(chunk, k, start, count)
            project_from_rig(state.cams[k], state.lenses[k], state.ports[k], buffer)
            jac_from_rig(state.cams[k], state.arms[k], state.ports[k], buffer)
            if layout.free_lens:
                lens_columns(state.lenses[k], chunk.j_lens, buffer)
            _residuals(layout, state, first, k, start, count, chunk)
            weigh(count, loss, scale, buffer, products)
            multiply_cells(buffer, products)
            multiply_camera(chunk.columns[k], num_free, sums[k], buffer, products)
            for i in range(count):
                j = bucket[k, start + i]
                for a in range(ROW):
                    rows[j, a] = products[(CELL + a) * STRIDE + i]
                for s in range(num_rows):
                    for t in range(4):
                        fours[j, s, t] = products[(COUPLE + 4 * s + t) * STRIDE + i]


@inner
def _residuals(layout, state, first, k, start, count, chunk):
    """RES_U and RES_V; lanes that are not OK once more, by the scalar kernels."""
    buffer, bucket, xy = chunk.buffer, chunk.bucket, layout.xy
    for i in range(BLOCK):
        j = bucket[k, start + min(i, count - 1)]
        rx = buffer[PX * STRIDE + i] - xy[first + j, 0]
        ry = buffer[PY * STRIDE + i] - xy[first + j, 1]
        if buffer[OK * STRIDE + i] != 1.0:
            x, y, z = chunk.in_rig[j]
            _, rx, ry = redo_lane(
                i,
                x,
                y,
                z,
                layout.xy[first + j],
                state.cams[k],
                state.arms[k],
                state.lenses[k],
                state.ports[k],
                layout.free_lens,
                (chunk.j_port, chunk.j_rig, chunk.j_border),
                buffer,
            )
        buffer[RES_U * STRIDE + i], buffer[RES_V * STRIDE + i] = rx, ry


@inner
def cost_of_errors(errors, loss, scale, squares):
    """(0.5 sum rho(|e|^2), number of valid errors) of an evaluated chunk.

    Cauchy's logarithms are taken of products: log(1 + s) + log(1 + t) is
    log1p(s + t + s t), which keeps the digits of small s and t.

    Args:
        squares: (M',), written: |e|^2 in px^2, NaN where invalid.
    """
    valid, total, product, c2 = 0, 0.0, 0.0, scale * scale
    for j in range(len(squares)):
        square = errors[j, 0] * errors[j, 0] + errors[j, 1] * errors[j, 1]
        squares[j] = square
        if square < math.inf:
            valid += 1
        else:
            square = INVALID_PX * INVALID_PX
        if loss == CAUCHY:
            ratio = square / c2
            product += ratio + ratio * product
            if product > 1e100:  # a factor of 1e200 still fits
                total += c2 * math.log1p(product)
                product = 0.0
        else:
            total += square
    return 0.5 * (total + c2 * math.log1p(product)), valid
