"""How well a finished calibration fits, in numbers; `uwsfm.trust.verdict` judges them.

Each number is one that a wrong input makes large, whatever the standard deviations say:
those take the model for right. Nothing here looks at what is true.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uwsfm.calibration.result import CalibrationResult
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import CENTER
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.noise_floor import NoiseFloor
from uwsfm.trust.bound import pull_below_zero
from uwsfm.trust.central import fit_lens
from uwsfm.trust.freed import Freed, freed_numbers
from uwsfm.trust.given import Departure, departures
from uwsfm.trust.systematic import NOTHING, Systematic, systematic_part

By = Literal["place", "depth", "row", "camera", "time", "image"]

TILES = 4
"""Parts of an image, each way, that err together: neighbours share errors over about a
tenth of an image; a quarter leaves room, and enough parts to compare."""
CELLS = 8
"""Bins by place across the longer side of an image: those of one lens's distortion are
as wide, and they hold enough observations of a small set."""
DEPTHS = 8
ROWS = 12
TIMES = 6
"""Blocks of frames in their order, each of `FRAMES_IN_BLOCK` at least."""
FRAMES_IN_BLOCK = 3


@dataclass(frozen=True, kw_only=True)
class Part:
    """The systematic part of the residuals by one property of the observations."""

    by: By
    px: float
    """See `Systematic`; NaN: too few observations."""
    p_value: float


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """What is left of the observations of one camera."""

    name: str
    rms_px: float
    systematic_px: float
    """By place in the image; NaN: too few observations."""
    p_value: float
    freed_px: float | None
    """Systematic part if the lens is free behind the port as it is, all else held;
    None: there is nothing systematic, or too little to fit a lens to."""


@dataclass(frozen=True, kw_only=True)
class Used:
    """How much of the input the result explains."""

    num_frames: int
    num_registered: int
    num_tested: int | None = None
    """Observations of the map that the adjustment tested; None: not known."""
    num_kept: int | None = None
    """Of them, what agrees with the result."""


@dataclass(frozen=True, kw_only=True)
class Goodness:
    """All numbers that a verdict rests on."""

    rms_px: float
    """Root mean square of the residuals' lengths."""
    sigma_px: float
    """Noise of one coordinate, corrected for what was fitted."""
    floor: NoiseFloor | None
    """None: too few matches in any pair of images."""
    parts: tuple[Part, ...]
    cameras: tuple[CameraFit, ...]
    used: Used
    converged: bool
    departures: tuple[Departure, ...]
    """Estimates against what was given."""
    freed_lenses: Freed | None
    """What vanishes of the residuals with the lenses free; None: it cannot be told."""
    freed_placement: Freed | None
    """The same with the placement of the cameras free, where it was held."""
    below_zero_z: float | None
    """See `pull_below_zero`; None: no port distance ran into zero."""
    known_length_z: float | None
    """The largest miss of a known length, in its standard deviations."""
    positions_scatter: float | None
    positions_left_out: float | None
    """Share of the positions that contradict the images."""


def goodness_of(
    rig: Rig, calibration: CalibrationResult, floor: NoiseFloor | None, used: Used
) -> Goodness:
    """Measure how well a result fits.

    Args:
        rig: As given, before anything was refined.
        calibration: The result.
        floor: Of its scene.
        used: What became of the input.
    """
    scene, _ = calibration.scene.select(calibration.inliers)
    known = np.all(np.isfinite(scene.residuals()), axis=1)
    known &= finite_rows(scene.points)[scene.point_idx]
    scene, _ = scene.select(known)
    left = _Left.of(scene)
    lengths, positions = calibration.lengths, calibration.positions
    freed = freed_numbers(calibration)
    return Goodness(
        rms_px=float(np.sqrt(np.mean(np.sum(left.residuals**2, axis=1)))),
        sigma_px=calibration.summary.sigma_px,
        floor=floor,
        parts=left.parts(),
        cameras=tuple(
            left.camera(index, camera.name)
            for index, camera in enumerate(rig.cameras)
            if np.any(scene.camera_idx == index)
        ),
        used=used,
        converged=calibration.summary.converged,
        departures=departures(rig, calibration),
        freed_lenses=freed.lenses,
        freed_placement=freed.placement,
        below_zero_z=pull_below_zero(calibration),
        known_length_z=None
        if lengths is None
        else float(
            np.max(np.abs(lengths.found_m - lengths.given_m) / lengths.stddevs_m)
        ),
        positions_scatter=None if positions is None else positions.scatter,
        positions_left_out=None
        if positions is None
        else positions.num_outliers / len(positions.inliers),
    )


@dataclass(frozen=True, kw_only=True)
class _Left:
    """Residuals of a scene, and where each observation is."""

    scene: Scene
    residuals: Array
    """(N, 2)"""
    share: Array
    """(N, 2) place in the image, from 0 to 1."""
    depth: Array
    """(N,)"""
    image: IndexArray
    """(N,) of camera and frame."""
    cluster: IndexArray
    """(N,) tile of an image."""

    @classmethod
    def of(cls, scene: Scene) -> _Left:
        size = np.array([[c.width, c.height] for c in scene.cameras], dtype=np.float64)
        share = np.clip(scene.xy / size[scene.camera_idx], 0.0, 1.0 - 1e-9)
        image = scene.frame_idx * len(scene.cameras) + scene.camera_idx
        return cls(
            scene=scene,
            residuals=scene.residuals(),
            share=share,
            depth=scene.points_in_cam()[:, 2],
            image=image,
            cluster=image * TILES**2 + _cell(share, TILES, TILES),
        )

    def parts(self) -> tuple[Part, ...]:
        found = {
            "place": self._by_place(self.residuals, slice(None)),
            "depth": self._by_depth(),
            "row": self._by(self._band(self.share[:, 1], ROWS)),
            "camera": self._by(self.scene.camera_idx),
            "time": self._by_time(),
            "image": self._by(self.image),
        }
        return tuple(
            Part(by=by, px=part.px, p_value=part.p_value)  # type: ignore[arg-type]
            for by, part in found.items()
        )

    def camera(self, index: int, name: str) -> CameraFit:
        mine = np.flatnonzero(self.scene.camera_idx == index)
        part = self._by_place(self.residuals[mine], mine)
        return CameraFit(
            name=name,
            rms_px=float(np.sqrt(np.mean(np.sum(self.residuals[mine] ** 2, axis=1)))),
            systematic_px=part.px,
            p_value=part.p_value,
            freed_px=self._freed(index, mine) if part.px > 0.0 else None,
        )

    def _freed(self, index: int, mine: IndexArray) -> float | None:
        """What stays systematic if the lens is fitted to the same observations."""
        camera, points = self.scene.cameras[index], self.scene.points_in_cam()[mine]
        fit = fit_lens(camera, points, self.scene.xy[mine])
        if fit is None:
            return None
        left = fit.residuals(points, self.scene.xy[mine])
        return self._by_place(left, mine).px if np.all(np.isfinite(left)) else None

    def _by(self, bins: IndexArray) -> Systematic:
        return systematic_part(self.residuals, bins, self.cluster)

    def _by_place(self, residuals: Array, rows: IndexArray | slice) -> Systematic:
        camera, share = self.scene.camera_idx[rows], self.share[rows]
        cell = _cell(share, CELLS, CELLS)
        return systematic_part(residuals, camera * CELLS**2 + cell, self.cluster[rows])

    def _band(self, share: Array, count: int) -> IndexArray:
        """One of so many equal bands of the image, and the camera."""
        band = (share * count).astype(np.int64)
        return self.scene.camera_idx * count + band

    def _by_depth(self) -> Systematic:
        """Along and across the radius, by depth and half of the radius: a port that is
        wrong draws near and far points to different radii."""
        centers = np.array([camera.lens[CENTER] for camera in self.scene.cameras])
        offset = self.scene.xy - centers[self.scene.camera_idx]
        radius = np.linalg.norm(offset, axis=1)
        outwards = offset / np.maximum(radius, 1e-9)[:, None]
        across = outwards[:, ::-1] * [-1.0, 1.0]
        turned = np.stack(
            [
                np.sum(self.residuals * outwards, axis=1),
                np.sum(self.residuals * across, axis=1),
            ],
            axis=1,
        )
        outer = (radius > np.median(radius)).astype(np.int64)
        limits = np.quantile(self.depth, np.arange(1, DEPTHS) / DEPTHS)
        layer = np.searchsorted(limits, self.depth, side="right")
        bins = (self.scene.camera_idx * DEPTHS + layer) * 2 + outer
        return systematic_part(turned, bins.astype(np.int64), self.cluster)

    def _by_time(self) -> Systematic:
        """By block of frames and third of the image: a lens that changes on the way."""
        frames = np.unique(self.scene.frame_idx)
        blocks = min(TIMES, len(frames) // FRAMES_IN_BLOCK)
        if blocks < 2:
            return NOTHING
        order = np.searchsorted(frames, self.scene.frame_idx)
        block = order * blocks // len(frames)
        place = self.scene.camera_idx * 9 + _cell(self.share, 3, 3)
        # What is the same at all times belongs to the place, not to the time.
        residuals = self.residuals - _bin_means(self.residuals, place)
        return systematic_part(
            residuals, (place * blocks + block).astype(np.int64), self.cluster
        )


def _cell(share: Array, columns: int, rows: int) -> IndexArray:
    column, row = (share * [columns, rows]).astype(np.int64).T
    return row * columns + column


def _bin_means(values: Array, bins: IndexArray) -> Array:
    """The mean of its bin, for each row (N, K)."""
    count = np.maximum(np.bincount(bins), 1)
    means = [np.bincount(bins, column) / count for column in values.T]
    return np.stack(means, axis=1)[bins]
