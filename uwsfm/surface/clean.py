"""Clouds without the points that are known to be bad, and how many those were."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from uwsfm.cloud import STDDEV_NAMES, VIEWS_NAMES, column_of
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

_RANGE = ("view_range",)
_ERROR = ("reprojection_error_px",)
# A normal distribution's standard deviation over its median absolute deviation.
_MAD_TO_STDDEV = 1.4826
_NUM_NEIGHBOURS = 16


@dataclass(frozen=True, kw_only=True)
class CleanOptions:
    """What a good point is; None leaves a filter out.

    Raises:
        InputError: a limit that no point or every point meets.
    """

    min_views: int | None = None
    """Length of the track, or number of depth maps that agree."""
    max_error_px: float | None = None
    """Mean reprojection error; dense points have none."""
    max_stddev_m: float | None = None
    """Along the line of sight."""
    max_relative_stddev: float | None = None
    """The same, as a share of the distance through the water."""
    outlier_ratio: float | None = 4.0
    """Standard deviations that the logarithm of a point's mean distance to its
    neighbours may be above the median: the spacing varies by factors, and a few stray
    points must not widen the limit."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not value > 0:
                option = f"--{name.removesuffix('_m').replace('_', '-')}"
                raise InputError(f"{option} must be positive, got {value}")


@dataclass(frozen=True, kw_only=True)
class Filter:
    """What one filter did."""

    name: str
    limit: float | None
    num_tested: int
    """Points that the filters before it had left."""
    num_removed: int
    num_unknown: int
    """Tested points whose value is not determined; they are removed."""


def default_options(table: np.ndarray) -> CleanOptions:
    """Limits on what a cloud holds, and on nothing else; as in `clean_points`.

    Two views of a track always meet somewhere near: three are a check. Depth maps were
    checked against each other before they were fused.
    """
    names = set(table.dtype.names or ())
    return CleanOptions(
        min_views=3 if "track_length" in names else 2 if "num_views" in names else None,
        max_error_px=2.0 if set(_ERROR) & names else None,
        max_relative_stddev=(
            0.02 if set(STDDEV_NAMES) & names and set(_RANGE) & names else None
        ),
    )


def clean_points(
    table: np.ndarray, options: CleanOptions
) -> tuple[NDArray[np.bool_], list[Filter]]:
    """Which points of a cloud are good.

    Args:
        table: (N,) vertices of a PLY, with x, y, z and any of num_views or
            track_length, reprojection_error_px, stddev or depth_stddev_m, view_range.
        options: the limits.

    Returns:
        A mask (N,), and what each filter removed, in their order.

    Raises:
        InputError: a limit is asked for of what the cloud does not hold.
    """
    xyz = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
    keep = np.ones(len(table), dtype=bool)
    filters: list[Filter] = []

    def apply(name: str, limit: float | None, good: ArrayLike, known: ArrayLike = True):
        tested, unknown = np.count_nonzero(keep), np.count_nonzero(keep & ~_mask(known))
        keep[:] &= _mask(good) & _mask(known)
        filters.append(
            Filter(
                name=name,
                limit=limit,
                num_tested=int(tested),
                num_removed=int(tested - np.count_nonzero(keep)),
                num_unknown=int(unknown),
            )
        )

    apply("position is finite", None, np.isfinite(xyz).all(axis=1))
    if options.min_views is not None:
        views = _column(table, VIEWS_NAMES, "number of views", "min-views")
        apply("views", options.min_views, views >= options.min_views)
    for name, limit, values in _upper_limits(table, options):
        apply(name, limit, values <= limit, np.isfinite(values))
    if options.outlier_ratio is not None:
        stray = np.zeros(len(table), dtype=bool)
        rows = np.flatnonzero(keep)
        stray[rows] = outliers(xyz[rows], _NUM_NEIGHBOURS, options.outlier_ratio)
        apply("neighbours", options.outlier_ratio, ~stray)
    return keep, filters


def _upper_limits(
    table: np.ndarray, options: CleanOptions
) -> Iterator[tuple[str, float, Array]]:
    """Name, limit and values (N,) of the filters that are asked for."""
    if options.max_error_px is not None:
        errors = _column(table, _ERROR, "reprojection error", "max-error-px")
        yield "reprojection error (px)", options.max_error_px, errors
    if options.max_stddev_m is not None:
        stddev = _column(table, STDDEV_NAMES, "standard deviation", "max-stddev")
        yield "standard deviation (m)", options.max_stddev_m, stddev
    if options.max_relative_stddev is not None:
        stddev = _column(
            table, STDDEV_NAMES, "standard deviation", "max-relative-stddev"
        )
        share = stddev / _column(table, _RANGE, "range", "max-relative-stddev")
        yield "standard deviation / range", options.max_relative_stddev, share


def outliers(points: Array, num_neighbours: int, ratio: float) -> NDArray[np.bool_]:
    """Points (N, 3) that are unusually far from their neighbours: a mask (N,).

    The statistical filter of PCL and Open3D, but on logarithms and with the median:
    there the stray points widen the limit that should find them.
    """
    count = min(num_neighbours, len(points) - 1)
    if count < 1:
        return np.zeros(len(points), dtype=bool)
    distances, _ = cKDTree(points).query(points, k=count + 1, workers=-1)
    # Duplicates of a point are not far from anything.
    logs = np.log(np.maximum(distances[:, 1:].mean(axis=1), 1e-12))
    center = np.median(logs)
    spread = _MAD_TO_STDDEV * np.median(np.abs(logs - center))
    # A perfect grid has no spread: rounding is no outlier.
    return logs > center + ratio * max(float(spread), 0.05)


def _mask(values: ArrayLike) -> NDArray[np.bool_]:
    return np.asarray(values, dtype=bool)


def _column(table: np.ndarray, names: tuple[str, ...], what: str, limit: str) -> Array:
    found = column_of(table, names)
    if found is None:
        raise InputError(
            f"this cloud holds no {what} (property {' or '.join(names)}): "
            f"leave --{limit} out"
        )
    return found.astype(np.float64)
