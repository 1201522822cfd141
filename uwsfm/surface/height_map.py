"""Heights and colours on a level grid, between the points and nowhere else."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree
from threadpoolctl import ThreadpoolController

from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.surface.units import length_words

_THREADS = ThreadpoolController()
_NUM_SAMPLED = 20_000
# The mean distance to the fourth neighbour is the spacing: of a grid, and nearly so of
# points at random (1.09 / sqrt(density)).
_NEIGHBOUR = 4
_GAP_SPACINGS = 5.0
_NEAR_SPACINGS = 2.5
"""Points no farther apart are neighbours, and between them the surface is measured."""
_SMOOTH_SLOPE = 1.0
"""Of a gap between points that is filled: what is steeper may be the edge of something
that stands in front of something else."""
MAX_CELLS = 100_000_000
NOTHING, MEASURED, FILLED = 0, 1, 2
"""What a cell of a map holds."""
_BLOCK = 500_000  # cells looked up at a time


@dataclass(frozen=True, kw_only=True)
class HeightMap:
    """A grid of square cells; its first row is the northernmost, of largest y."""

    height: NDArray[np.float32]
    """(rows, columns) metres above the map's zero, NaN where there is no data."""
    colors: NDArray[np.uint8]
    """(rows, columns, 4) red, green, blue and 255; 0 where there is no data."""
    origin: NDArray[np.uint8]
    """(rows, columns) `NOTHING`, `MEASURED`, or `FILLED`: in a gap between points."""
    resolution: float
    """Side of a cell, metres."""
    west: float
    """x of the outer corner of the first cell."""
    north: float
    """y of it."""
    max_gap: float
    """Longest distance between points that was bridged."""

    def centers(self) -> tuple[Array, Array]:
        """x (columns,) and y (rows,) of the centres of the cells."""
        rows, columns = self.height.shape
        x = self.west + self.resolution * (np.arange(columns, dtype=np.float64) + 0.5)
        y = self.north - self.resolution * (np.arange(rows, dtype=np.float64) + 0.5)
        return x, y


def point_spacing(xy: Array) -> float:
    """Typical distance between points (N, 2), seen from above.

    Raises:
        UwsfmError: there are too few.
    """
    if len(xy) <= _NEIGHBOUR:
        raise UwsfmError(f"a map needs more than {len(xy)} points")
    rng = np.random.default_rng(0)
    some = xy[rng.permutation(len(xy))[:_NUM_SAMPLED]]
    distances, _ = cKDTree(xy).query(some, k=_NEIGHBOUR + 1, workers=-1)
    return float(np.median(distances[:, -1]))


def make_height_map(
    points: Array,
    colors: NDArray[np.uint8],
    resolution: float | None = None,
    max_gap: float | None = None,
    unit: str = "metre",
) -> HeightMap:
    """Heights and colours of a cloud in the frame of the map.

    The points of a cell are joined at their middle (of those near their median height);
    these are joined by triangles, in which the centres of the cells are interpolated:
    exact on planes, however the points lie in the cells. Triangles with a side longer
    than ``max_gap`` are holes, and so are gaps across which the surface rises steeply.

    Args:
        points: (N, 3), z up.
        colors: (N, 3) RGB.
        resolution: side of a cell; default: the spacing of the points.
        max_gap: default: five times the spacing, or two cells if that is more.
        unit: of lengths, for messages.

    Raises:
        InputError: a length that is not positive, or too many cells.
        UwsfmError: too few points for a map.
    """
    for name, value in (("resolution", resolution), ("max-gap", max_gap)):
        if value is not None and not 0.0 < value < np.inf:
            raise InputError(f"--{name} must be positive and finite, got {value}")
    good = np.isfinite(points).all(axis=1)
    points, colors = points[good], colors[good]
    spacing = point_spacing(points[:, :2])
    cell = _rounded(spacing) if resolution is None else float(resolution)
    gap = max(_GAP_SPACINGS * spacing, 2.0 * cell) if max_gap is None else max_gap
    # Multiples of the cell: maps of one frame have cells in common.
    low = np.floor(points[:, :2].min(axis=0) / cell)
    high = np.floor(points[:, :2].max(axis=0) / cell) + 1.0
    columns, rows = (high - low).astype(np.int64).tolist()
    if columns * rows > MAX_CELLS:
        raise InputError(
            f"a map of {columns} x {rows} cells of "
            f"{length_words(cell, unit)} is too large: take a "
            "larger --resolution, or clean the cloud of strays first (uwsfm clean)"
        )
    west, north = float(low[0] * cell), float(high[1] * cell)
    column = np.clip(np.floor((points[:, 0] - west) / cell), 0, columns - 1)
    row = np.clip(np.floor((north - points[:, 1]) / cell), 0, rows - 1)
    index = (row * columns + column).astype(np.int64)
    nodes = _joined(np.hstack([points, colors]), index, cell)
    nodes[:, :2] = (nodes[:, :2] - [west, north]) / cell
    near = _NEAR_SPACINGS * max(spacing / cell, 1.0)
    height, rgba, origin = _between(nodes, (rows, columns), cell, (near, gap / cell))
    return HeightMap(
        height=height,
        colors=rgba,
        origin=origin,
        resolution=cell,
        west=west,
        north=north,
        max_gap=float(gap),
    )


def _rounded(value: float) -> float:
    """Up to two digits: 0.0123 becomes 0.013."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1.0)
    return float(f"{np.ceil(value / step - 1e-9) * step:.2g}")


def _joined(values: Array, index: NDArray[np.int64], reach: float) -> Array:
    """Rows x, y, z, red, green, blue (N, 6) as one mean per cell (n, 6).

    Only points within ``reach`` of their cell's median height count: of an overhang, or
    a stray, there is one surface.
    """
    order = np.lexsort((values[:, 2], index))
    values, index = values[order], index[order]
    _, start, group, count = np.unique(
        index, return_index=True, return_inverse=True, return_counts=True
    )
    z = values[:, 2]
    median = 0.5 * (z[start + (count - 1) // 2] + z[start + count // 2])
    # Of two surfaces with as many points, the median lies between: the upper counts.
    upper = z[start + count // 2]
    center = np.where(np.abs(upper - median) <= reach, median, upper)
    near = np.abs(z - center[group]) <= reach
    number = np.bincount(group, near)
    sums = [np.bincount(group, near * column) for column in values.T]
    return np.stack(sums, axis=1) / number[:, None]


def _between(
    nodes: Array, shape: tuple[int, int], cell: float, reach: tuple[float, float]
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Heights, RGBA and origins at the centres of the cells, interpolated in triangles.

    Args:
        nodes: (n, 6) x, y in cells from the corner (Qhull's tolerances are absolute),
            height, red, green, blue.
        shape: rows and columns.
        cell: side of a cell.
        reach: sides of triangles that are measured, and that are filled at most, cells.
    """
    rows, columns = shape
    height = np.full(rows * columns, np.nan, dtype=np.float32)
    rgba = np.zeros((rows * columns, 4), dtype=np.uint8)
    origin = np.zeros(rows * columns, dtype=np.uint8)
    xy = nodes[:, :2]
    try:
        triangles = Delaunay(xy)
    except (QhullError, ValueError):
        raise UwsfmError("a map needs points that are not all in a row") from None
    # One LAPACK call per triangle: threads would only wait for each other.
    with _THREADS.limit(limits=1, user_api="blas"):
        triangles.transform  # noqa: B018
    kinds = _origins(nodes[triangles.simplices][..., :3] / [1.0, 1.0, cell], reach)
    for begin in range(0, rows * columns, _BLOCK):
        index = np.arange(begin, min(begin + _BLOCK, rows * columns))
        center = np.stack([index % columns + 0.5, -(index // columns) - 0.5], axis=1)
        found = triangles.find_simplex(center)
        inside = (found >= 0) & (kinds[found] != NOTHING)
        found, index, center = found[inside], index[inside], center[inside]
        frame = triangles.transform[found]
        first = np.einsum("nij,nj->ni", frame[:, :2], center - frame[:, 2])
        weights = np.concatenate([first, 1.0 - first.sum(axis=1, keepdims=True)], 1)
        values = np.einsum("nc,nck->nk", weights, nodes[triangles.simplices[found], 2:])
        height[index] = values[:, 0]
        rgba[index, :3] = np.rint(np.clip(values[:, 1:], 0.0, 255.0))
        rgba[index, 3] = 255
        origin[index] = kinds[found]
    return height.reshape(shape), rgba.reshape(*shape, 4), origin.reshape(shape)


def _origins(corners: Array, reach: tuple[float, float]) -> NDArray[np.uint8]:
    """What triangles (t,) with corners (t, 3, 3), in cells, hold: see `_between`."""
    near, most = reach
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.linalg.norm(sides[..., :2], axis=2).max(axis=1)
    rise = np.abs(sides[..., 2]).max(axis=1)
    smooth = rise <= _SMOOTH_SLOPE * longest
    kinds = np.full(len(corners), NOTHING, dtype=np.uint8)
    kinds[(longest <= most) & smooth] = FILLED
    kinds[longest <= min(near, most)] = MEASURED
    return kinds
