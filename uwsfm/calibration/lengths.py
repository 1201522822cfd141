"""Lengths and positions from outside: what is given, and what came of it.

One camera has no baseline: its images leave the scale open. A scale bar, a known
distance between two frames, or navigation gives it. Rigs with a baseline gain too.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene


def _no_indices() -> IndexArray:
    return np.empty(0, dtype=np.int64)


def _all_three() -> NDArray[np.bool_]:
    return np.ones(3, dtype=bool)


@dataclass(frozen=True, kw_only=True, eq=False)
class Distances:
    """Known distances between pairs."""

    ends: IndexArray
    """(M, 2) indices of points, or of frames."""
    lengths_m: Array
    """(M,)"""
    stddevs_m: Array
    """(M,)"""

    @classmethod
    def from_arrays(
        cls, ends: ArrayLike, lengths_m: ArrayLike, stddevs_m: ArrayLike
    ) -> "Distances":
        """Check the arrays (shapes as in the class).

        Raises:
            InputError: a wrong shape, a length from something to itself, or a length or
                standard deviation that is not positive; the message names the row.
        """
        pairs = np.asarray(ends)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
            raise InputError(f"ends must be integers (M, 2), got shape {pairs.shape}")
        lengths, stddevs = np.asarray(lengths_m, float), np.asarray(stddevs_m, float)
        for name, values in (("lengths_m", lengths), ("stddevs_m", stddevs)):
            if values.shape != (len(pairs),):
                raise InputError(f"{name} must have one entry per row of ends")
            wrong = ~(np.isfinite(values) & (values > 0.0))
            if np.any(wrong):
                row = int(np.argmax(wrong))
                raise InputError(
                    f"{name}[{row}] must be positive and finite, got {values[row]}"
                )
        same = pairs[:, 0] == pairs[:, 1]
        if np.any(same):
            raise InputError(f"ends[{int(np.argmax(same))}] are one and the same")
        return cls(ends=pairs.astype(np.int64), lengths_m=lengths, stddevs_m=stddevs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Positions:
    """Measured positions of an antenna on the rig: navigation, USBL, GPS.

    Their frame is right-handed, metric and local, with axes of its own choice: where
    the world lies in it is estimated, and the result is moved there.
    """

    frame_idx: IndexArray
    """(M,)"""
    positions: Array
    """(M, 3) metres."""
    covariances: Array
    """(M, 3, 3)"""
    lever_arm: Array
    """(3,) the antenna in the rig's frame, that of the first camera."""
    source: str = "positions"
    """The file that they are from, for messages."""
    measured: NDArray[np.bool_] = field(default_factory=_all_three)
    """(3,) coordinates that were measured. The others are zero with a wide standard
    deviation: they hold the model somewhere, and their misses do not count."""

    @classmethod
    def from_arrays(
        cls,
        frame_idx: ArrayLike,
        positions: ArrayLike,
        covariances: ArrayLike,
        lever_arm: ArrayLike = (0.0, 0.0, 0.0),
        source: str = "positions",
        measured: ArrayLike = (True, True, True),
    ) -> "Positions":
        """Check the arrays.

        Args:
            frame_idx, positions, lever_arm, source, measured: as in the class.
            covariances: (M, 3, 3), or standard deviations (M, 3), or one (3,) for all.

        Raises:
            InputError: a wrong shape, what is not finite, or a covariance that is not
                positive; the message names the row.
        """
        frames, places = np.asarray(frame_idx), np.asarray(positions, float)
        if frames.ndim != 1 or frames.dtype.kind not in "iu":
            raise InputError("frame_idx must be integers (M,)")
        if places.shape != (len(frames), 3):
            raise InputError(
                f"positions.shape={places.shape}, expected ({len(frames)}, 3)"
            )
        spread = np.asarray(covariances, float)
        if spread.ndim < 3:
            spread = np.broadcast_to(spread, places.shape)[..., None] ** 2 * np.eye(3)
        if spread.shape != (len(frames), 3, 3):
            raise InputError(f"covariances.shape={spread.shape}, expected (M, 3, 3)")
        arm = np.asarray(lever_arm, float)
        if arm.shape != (3,) or not np.all(np.isfinite(arm)):
            raise InputError(f"lever_arm must be three numbers, got {arm}")
        for row, (place, block) in enumerate(zip(places, spread, strict=True)):
            if not np.all(np.isfinite(place)):
                raise InputError(f"positions[{row}] is not finite: {place.tolist()}")
            # NaN is no symmetric matrix
            if not (np.allclose(block, block.T) and np.linalg.eigvalsh(block)[0] > 0.0):
                raise InputError(f"covariances[{row}] is not positive definite")
        return cls(
            frame_idx=frames.astype(np.int64),
            positions=places,
            covariances=spread,
            lever_arm=arm,
            source=source,
            measured=np.array(measured, dtype=bool),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Lengths:
    """Everything that is known of lengths beside the baselines."""

    between_points: Distances | None = None
    """Scale bars."""
    between_frames: Distances | None = None
    """Between the origins of the rig: the centres of its first camera."""
    positions: Positions | None = None
    clicked: IndexArray = field(default_factory=_no_indices)
    """Observations that are never taken for outliers: the ends of scale bars, which
    people clicked. They are the last of the scene, and so are their points."""
    click_stddevs_px: Array | None = None
    """(M,) noise of the clicks on each scale bar; None: their ends are features."""

    def in_part(self, keep: NDArray[np.bool_], used: IndexArray) -> "Lengths":
        """These lengths for a part of the scene, as `Scene.select` makes it.

        Args:
            keep: (N,) observations that are in the part; clicked ones are.
            used: (P',) old index of each of its points.
        """
        bars = self.between_points
        if bars is not None:
            if not np.all(np.isin(bars.ends, used)):
                row = int(np.argmax(~np.isin(bars.ends, used).all(axis=1)))
                raise InputError(
                    f"scale bar {row + 1}: an end is not seen well enough to be placed"
                )
            bars = replace(bars, ends=np.searchsorted(used, bars.ends))
        clicked = np.cumsum(keep)[self.clicked] - 1
        return replace(self, between_points=bars, clicked=clicked)

    def in_frames(self, frames: IndexArray) -> "Lengths":
        """What speaks of some frames (F',) only, numbered as they are there."""
        between, known = self.between_frames, self.positions
        if between is not None:
            there = np.isin(between.ends, frames).all(axis=1)
            between = replace(
                between,
                ends=np.searchsorted(frames, between.ends[there]),
                lengths_m=between.lengths_m[there],
                stddevs_m=between.stddevs_m[there],
            )
        if known is not None:
            there = np.isin(known.frame_idx, frames)
            known = replace(
                known,
                frame_idx=np.searchsorted(frames, known.frame_idx[there]),
                positions=known.positions[there],
                covariances=known.covariances[there],
            )
        return replace(self, between_frames=between, positions=known)

    def checked(self, scene: Scene) -> "Lengths":
        """These lengths, if a scene has what they speak of.

        Raises:
            InputError: an index out of range.
        """
        limits = [
            ("between_points.ends", self.between_points, scene.num_points),
            ("between_frames.ends", self.between_frames, scene.num_frames),
        ]
        for name, distances, limit in limits:
            if distances is not None:
                _within(name, distances.ends, limit)
        if self.positions is not None:
            _within("positions.frame_idx", self.positions.frame_idx, scene.num_frames)
        _within("clicked", self.clicked, scene.num_observations)
        return self

    @property
    def give_scale(self) -> bool:
        return any(
            item is not None
            for item in (self.between_points, self.between_frames, self.positions)
        )


def _within(name: str, indices: IndexArray, limit: int) -> None:
    if indices.size and not (indices.min() >= 0 and indices.max() < limit):
        raise InputError(f"{name} is out of range: there are {limit}")


@dataclass(frozen=True, kw_only=True, eq=False)
class LengthFit:
    """How the lengths given fit what was found."""

    given_m: Array
    """(M,) scale bars, then distances between frames."""
    stddevs_m: Array
    """(M,) with those of clicked ends."""
    found_m: Array
    """(M,) in the adjusted scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PositionFit:
    """How the positions fit, and where the model lies in their frame."""

    frame_idx: IndexArray
    """(M,) of the positions whose frames took part."""
    misses_m: Array
    """(M, 3) antenna of the model minus position; zero in what was not measured."""
    inliers: NDArray[np.bool_]
    """(M,) positions that the last solve used."""
    scatter: float
    """How many times the given standard deviations the inliers scatter; above 1, where
    chance does not explain it, the standard deviations were enlarged so much."""
    covariance: Array
    """(6, 6) of the model's place in the frame of the positions: rotation (radians)
    about the middle of the positions, and translation (metres) of that middle."""
    measured: NDArray[np.bool_] = field(default_factory=_all_three)
    """(3,) as of the `Positions`."""

    def in_frames(self, frames: IndexArray) -> "PositionFit":
        """The fit of some frames (F',), numbered as they are there."""
        there = np.isin(self.frame_idx, frames)
        return replace(
            self,
            frame_idx=np.searchsorted(frames, self.frame_idx[there]),
            misses_m=self.misses_m[there],
            inliers=self.inliers[there],
        )

    @property
    def num_outliers(self) -> int:
        return int(np.count_nonzero(~self.inliers))

    @property
    def turn(self) -> tuple[float, Array]:
        """Largest standard deviation of the rotation, radians, and its axis (3,).

        Depths say nothing of the heading: of these, the tilt only.
        """
        axes = np.eye(3) if self.measured.all() else np.eye(3)[:, :2]
        values, vectors = np.linalg.eigh(axes.T @ self.covariance[:3, :3] @ axes)
        return float(np.sqrt(values[-1])), axes @ vectors[:, -1]
