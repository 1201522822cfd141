"""How far away the scene is, all over an image: between the points seen in it.

Inverse depth is interpolated, linearly over a Delaunay triangulation of the points:
seen by a pinhole it is linear on every plane, so planes come out exactly.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, Delaunay, KDTree
from threadpoolctl import ThreadpoolController

from uwsfm.geometry.rigid3 import Array

_ANCHORS_PER_SIDE = 9
_NEIGHBOURS = 8
_MIN_POINTS = 4
# The border anchors lie this much of the image outside of it: keypoints may, too.
_MARGIN = 0.25
_ON_HULL_PX = 1e-6
_STRIP_PX = 8
_THREADS = ThreadpoolController()


class ImageDepth:
    """Inverse depth over a pinhole image, continuous everywhere.

    Outside of the points' convex hull it runs towards the mean of the nearest points;
    with fewer points than a triangulation takes it is constant.

    Args:
        xy: (n, 2) pixels of the points.
        inverse_depths: (n,) 1 / metres, along the optical axis.
        size: width and height of the image, pixels.
        fallback: inverse depth of an image without points.
    """

    def __init__(
        self,
        xy: ArrayLike,
        inverse_depths: ArrayLike,
        size: tuple[int, int],
        fallback: float,
    ) -> None:
        pixels = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        values = np.asarray(inverse_depths, dtype=np.float64).ravel()
        self._constant = float(np.median(values)) if len(values) else float(fallback)
        self._interpolator = None
        self._hull = np.empty((0, 3))
        # Three points in a row, too, have no triangles.
        spread = pixels - pixels.mean(axis=0) if len(pixels) else pixels
        if len(pixels) < _MIN_POINTS or _is_row(spread):
            return
        self._hull = ConvexHull(pixels).equations  # (h, 3): inside where <= 0
        anchors = _anchors(pixels, size)
        distance, near = KDTree(pixels).query(anchors, k=min(_NEIGHBOURS, len(pixels)))
        weights = 1.0 / (distance + 1.0)
        at_anchors = np.sum(weights * values[near], axis=1) / weights.sum(axis=1)
        triangles = Delaunay(np.concatenate([pixels, anchors]))
        # One LAPACK call per triangle, kept from here on: threads would only wait for
        # each other, 50 ms an image on a busy machine.
        with _THREADS.limit(limits=1, user_api="blas"):
            triangles.transform  # noqa: B018
        at_all = np.concatenate([values, at_anchors])
        self._interpolator = LinearNDInterpolator(triangles, at_all)

    def inverse(self, xy: ArrayLike) -> Array:
        """Inverse depth (N,) at pixels (N, 2); NaN where they are."""
        pixels = np.asarray(xy, dtype=np.float64)
        if self._interpolator is None:
            return np.where(np.isfinite(pixels).all(axis=1), self._constant, np.nan)
        # Triangles are searched for from the last one found: strip by strip is fast.
        x, y = np.nan_to_num(pixels).T
        order = np.lexsort((x, y // _STRIP_PX))
        found = np.empty(len(pixels))
        found[order] = self._interpolator(pixels[order])
        # Farther out than the anchors: nothing there is in the image.
        lost = np.isnan(found) & np.isfinite(pixels).all(axis=1)
        found[lost] = self._constant
        return found

    def is_between_points(self, xy: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (N, 2) lie in the convex hull of the points (N,)."""
        pixels = np.asarray(xy, dtype=np.float64)
        inside = np.full(len(pixels), len(self._hull) > 0)
        for a, b, c in self._hull:
            inside &= a * pixels[:, 0] + b * pixels[:, 1] + c <= _ON_HULL_PX
        return inside


def _is_row(spread: Array) -> bool:
    """Whether centred pixels (n, 2) lie on a line, to within a pixel or so."""
    (xx, xy), (_, yy) = np.einsum("ni,nj->ij", spread, spread)
    smaller = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy))
    return bool(smaller < 1.0)


def _anchors(xy: Array, size: tuple[int, int]) -> Array:
    """Pixels (A, 2) around the image and all its points."""
    margin = _MARGIN * np.asarray(size, dtype=np.float64)
    low = np.minimum(xy.min(axis=0), 0.0) - margin
    high = np.maximum(xy.max(axis=0), size) + margin
    steps = np.linspace(0.0, 1.0, _ANCHORS_PER_SIDE)
    x, y = np.meshgrid(steps, steps)
    border = (np.minimum(x, y) == 0.0) | (np.maximum(x, y) == 1.0)
    return low + np.stack([x[border], y[border]], axis=1) * (high - low)
