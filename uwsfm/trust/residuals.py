"""Residuals in bins: by place in the image, by radius and by depth.

Noise averages out in a bin; what stays is what the model gets wrong.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import CENTER
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.rig_checks.pinhole_fit import fit_virtual_pinhole
from uwsfm.trust.central import FittedCamera, fit_central, fit_lens

COLUMNS, FEWEST_COLUMNS = 14, 5
"""Cells across the longer side of an image; cells are square."""
PER_CELL = 25
"""Observations that a cell has on average, if so many cells have them."""
RADII, DEPTHS = 10, 8
"""Bins of the two profiles."""
NOTICEABLE_PX = 0.03
"""Of systematic residuals: more than feature detectors do by themselves."""
FEWEST = 8
"""Observations in a bin whose mean is worth showing."""
NEARNESS = ("near", "middle", "far")
"""Thirds of the observations by depth."""
HALVES = ("inner half", "outer half")
"""Of the observations by radius."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Mean radial residuals of one part of the observations, in bins."""

    name: str
    span: tuple[float, float]
    """Of the depths (metres) or radii (px) that tell this part from the others."""
    at: Array
    """(K,) mean radius in px, or depth in metres, of each bin."""
    mean_px: Array
    """(K,) along the radius, positive: projected too far out; NaN: too few."""
    stderr_px: Array
    """(K,) standard error of the mean, if errors are independent."""


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """What one model leaves in one camera."""

    cells_px: Array
    """(rows, columns, 2) mean residual, projection minus observation; NaN: too few."""
    by_radius: tuple[Profile, ...]
    """One per third of the depths."""
    by_depth: tuple[Profile, ...]
    """One per half of the radii."""
    rms_px: float
    systematic_px: float
    """RMS of the means by cell and third of the depths, without what chance adds."""


@dataclass(frozen=True, kw_only=True)
class CameraResiduals:
    """What the refractive model and a pinhole leave of the same observations."""

    name: str
    size: tuple[int, int]
    """Width and height, px."""
    counts: IndexArray
    """(rows, columns) observations in each cell."""
    refractive: Residuals
    model: str
    """Camera model of the pinhole."""
    pinhole: Residuals | None
    """None: there is no port, or too little to fit a pinhole to."""
    freed: Residuals | None
    """Of the refractive model with its lens as free as the pinhole's; None: it leaves
    little, or less than the pinhole, as it is."""
    least_central_px: tuple[float, float] | None
    """RMS and maximum of what any single centre leaves at the 10th and 90th percentile
    of depth, even of a lens that is exact at the median; None as above."""


@dataclass(frozen=True)
class _Places:
    """Where the observations of one camera are."""

    cell: IndexArray
    shape: tuple[int, int]
    outwards: Array
    """(N, 2) unit vectors from the principal point."""
    radius: Array
    depth: Array

    @property
    def third(self) -> IndexArray:
        return _ranked(self.depth, 3)

    @property
    def half(self) -> IndexArray:
        return _ranked(self.radius, 2)


def camera_residuals(scene: Scene, names: list[str]) -> list[CameraResiduals]:
    """Of every camera that has observations.

    Args:
        scene: the refined one; rows without a finite residual are left out.
        names: of its cameras.
    """
    residuals, in_cam = scene.residuals(), scene.points_in_cam()
    finite = np.all(np.isfinite(residuals), axis=1)
    found = []
    for index, camera in enumerate(scene.cameras):
        rows = np.flatnonzero((scene.camera_idx == index) & finite)
        if not len(rows):
            continue
        xy, points = scene.xy[rows], in_cam[rows]
        found.append(_camera(names[index], camera, points, xy, residuals[rows]))
    return found


def _camera(
    name: str, camera: RefractiveCamera, points: Array, xy: Array, ours: Array
) -> CameraResiduals:
    places = _places(camera, xy, points)

    def left_by(fit: FittedCamera | None) -> Residuals | None:
        left = None if fit is None else fit.residuals(points, xy)
        if left is None or not np.all(np.isfinite(left)):
            return None
        return _residuals(places, left)

    central = fit_central(camera, points, xy)
    pinhole, refractive = left_by(central), _residuals(places, ours)
    allowed = 0.0 if pinhole is None else pinhole.systematic_px
    freed = None
    if refractive.systematic_px > max(NOTICEABLE_PX, allowed):
        freed = left_by(fit_lens(camera, points, xy))
    counts = np.bincount(places.cell, minlength=int(np.prod(places.shape)))
    return CameraResiduals(
        name=name,
        size=(camera.width, camera.height),
        counts=counts.reshape(places.shape),
        refractive=refractive,
        model="" if central is None else central.camera.camera.model_name,
        pinhole=pinhole,
        freed=freed,
        least_central_px=_least_central(camera, places.depth),
    )


def _least_central(
    camera: RefractiveCamera, depth: Array
) -> tuple[float, float] | None:
    if not camera.port.refracts:
        return None
    found = fit_virtual_pinhole(camera, np.percentile(depth, [10.0, 50.0, 90.0]))
    return found.rms_px, found.max_px


def _places(camera: RefractiveCamera, xy: Array, points_in_cam: Array) -> _Places:
    size = np.array([camera.width, camera.height], dtype=np.float64)
    across = np.sqrt(len(xy) / PER_CELL * size.max() / size.min())
    across = np.clip(across, FEWEST_COLUMNS, COLUMNS)
    columns, rows = np.maximum(1, np.round(across * size / size.max())).astype(int)
    place = np.clip((xy / size * [columns, rows]).astype(np.int64), 0, None)
    column, row = np.minimum(place, [columns - 1, rows - 1]).T
    offset = xy - camera.lens[CENTER]
    radius = np.linalg.norm(offset, axis=1)
    return _Places(
        cell=row * columns + column,
        shape=(int(rows), int(columns)),
        outwards=offset / np.maximum(radius, 1e-9)[:, None],
        radius=radius,
        depth=points_in_cam[:, 2],
    )


def _ranked(values: Array, parts: int) -> IndexArray:
    """Which of so many equal parts of the sorted values each is in (N,)."""
    limits = np.quantile(values, np.arange(1, parts) / parts)
    return np.searchsorted(limits, values, side="right").astype(np.int64)


def _residuals(places: _Places, residuals: Array) -> Residuals:
    count = int(np.prod(places.shape))
    means, _ = _means(places.cell, count, residuals)
    radial = np.sum(residuals * places.outwards, axis=1)
    widest = float(places.radius.max())
    ring = np.minimum((RADII * places.radius / widest).astype(np.int64), RADII - 1)
    layer = _ranked(places.depth, DEPTHS)
    by_third = _parts(places.third, NEARNESS, places.depth)
    by_half = _parts(places.half, HALVES, places.radius)
    return Residuals(
        cells_px=means.reshape(*places.shape, 2),
        by_radius=tuple(
            _profile(label, ring[part], RADII, places.radius[part], radial[part])
            for label, part in by_third
        ),
        by_depth=tuple(
            _profile(label, layer[part], DEPTHS, places.depth[part], radial[part])
            for label, part in by_half
        ),
        rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        systematic_px=_systematic(3 * places.cell + places.third, residuals),
    )


_Label = tuple[str, tuple[float, float]]


def _parts(
    index: IndexArray, names: tuple[str, ...], values: Array
) -> Iterator[tuple[_Label, NDArray[np.bool_]]]:
    """Each part that has any: its name and the span of its values, and its mask."""
    for number, name in enumerate(names):
        part = index == number
        if np.any(part):
            low, high = values[part].min(), values[part].max()
            yield (name, (float(low), float(high))), part


def _profile(
    label: _Label, index: IndexArray, size: int, at: Array, radial: Array
) -> Profile:
    mean, stderr = _means(index, size, radial[:, None])
    where, _ = _means(index, size, at[:, None])
    return Profile(
        name=label[0],
        span=label[1],
        at=where[:, 0],
        mean_px=mean[:, 0],
        stderr_px=stderr,
    )


def _means(index: IndexArray, size: int, values: Array) -> tuple[Array, Array]:
    """Means (size, K) of rows (N, K) by index, and their standard errors (size,), of
    the whole vectors; NaN where there are fewer than `FEWEST`."""
    count = np.bincount(index, minlength=size).astype(np.float64)
    count[count < FEWEST] = np.nan
    total = np.stack([np.bincount(index, v, minlength=size) for v in values.T], 1)
    mean = total / count[:, None]
    squares = np.bincount(index, np.sum(values**2, axis=1), minlength=size) / count
    spread = np.maximum(squares - np.sum(mean**2, axis=1), 0.0)
    return mean, np.sqrt(spread / (count - 1.0))


def _systematic(index: IndexArray, residuals: Array) -> float:
    """RMS of the bins' means, weighted by their observations, less its expectation
    where all is noise; 0 where no more than noise is there."""
    groups, index = np.unique(index, return_inverse=True)
    mean, stderr = _means(index, len(groups), residuals)
    count = np.bincount(index, minlength=len(groups))
    excess = np.sum(mean**2, axis=1) - stderr**2
    known = np.isfinite(excess)
    if not np.any(known):
        return float("nan")
    return float(np.sqrt(max(np.average(excess[known], weights=count[known]), 0.0)))
