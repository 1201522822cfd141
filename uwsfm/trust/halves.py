"""Cross-validation: disjoint halves of the frames, each adjusted alone.

A standard deviation is a promise of how far another dive would come out. Two halves of
one dive are two dives: if they differ by more than both promise, the promise is broken,
whatever the reason, and it is enlarged by as much. That finds what differs between the
halves. What is wrong in both alike, a lens as it was given or a length, it cannot find.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.stats import f as f_distribution

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.propagation import Propagation
from uwsfm.calibration.result import CalibrationResult
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry.alignment import align
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.trust.projections import ProjectionMap, projection_map
from uwsfm.trust.shared_numbers import SharedNumber, SharedNumbers, shared_numbers

INTERLEAVED, IN_ORDER = "interleaved", "first against second"
MIN_FRAMES = 6
"""In all: three in each half, of which the first one's pose is held."""
MIN_OBSERVATIONS = 200
"""In each half."""
LITTLE_WORK = 100_000
"""Observations that are cross-validated without being asked: a second or so."""
LOOSE_SCALE = 0.1
"""Predicted relative deviation of a distance in both halves, median: one that a length
scales has a hundredth and less."""
MAX_LENGTHS = 60
"""Distances between pairs of points that are compared."""
MEDIAN_NORMAL = 0.6745
"""Median of |x| for unit normal x."""
FARTHEST = 3.0
"""Times their typical size: differences of lengths beyond, of a point that a wrong
match has moved, count as this."""
SIGNIFICANT = 0.005
"""The chance of a larger difference, if the predictions are right."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How far the two halves differ in one group of numbers."""

    group: str
    """As of `SharedNumber`, "length" for distances between points, or "scale"."""
    ratio: float
    """Size of the differences over what both halves predict, RMS; about 1 is right."""
    num_independent: float
    """How many independent numbers that many correlated ones are worth."""
    p_value: float
    """Chance of a ratio as large, if the predictions are right."""


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """Distances between points that both halves have."""

    num_pairs: int
    typical_m: float
    """Median of the distances."""
    difference_m: float
    """Typical size of the differences: the median, as of a normal distribution."""
    predicted_m: float
    scale: float
    """All lengths of the second half over those of the first, less 1."""
    scale_stddev: float | None
    """As both halves predict it; None: the scale is arbitrary."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """One way to make two halves, and what came out."""

    name: str
    num_frames: tuple[int, int]
    num_observations: tuple[int, int]
    sigma_px: tuple[float, float]
    numbers: tuple[SharedNumber, ...]
    agreements: tuple[Agreement, ...]
    lengths: Lengths | None
    """None: too few points are in both halves."""
    projections: ProjectionMap


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossValidation:
    """Disjoint halves of the frames, each adjusted alone, compared."""

    unit: str
    """Of lengths: "m", or "units" where the scale is arbitrary."""
    splits: tuple[Split, ...]
    omitted: tuple[str, ...]
    """What could not be compared, and why, one sentence each."""

    @property
    def enlarged(self) -> dict[str, float]:
        """Groups whose standard deviations are too small, and by which factor.

        Of the two splits the worse one counts; its chance is doubled for the choice.
        """
        found: dict[str, float] = {}
        for split in self.splits:
            for each in split.agreements:
                if len(self.splits) * each.p_value < SIGNIFICANT and each.ratio > 1.0:
                    found[each.group] = max(found.get(each.group, 1.0), each.ratio)
        return found


def num_frames(calibration: CalibrationResult) -> int:
    """How many frames have observations that count."""
    return len(np.unique(calibration.scene.frame_idx[calibration.inliers]))


def why_not_halved(calibration: CalibrationResult) -> str | None:
    """Why a result is not cross-validated without being asked; None if it is."""
    count = int(np.count_nonzero(calibration.inliers))
    frames = num_frames(calibration)
    if frames < MIN_FRAMES:
        return f"the result has {frames} frames, and halves need {MIN_FRAMES} or more"
    if count > LITTLE_WORK:
        return f"the result has {count:,} observations, more than {LITTLE_WORK:,}"
    return None


def cross_validate_if_cheap(
    rig: Rig, calibration: CalibrationResult
) -> CrossValidation | None:
    """`cross_validate` where it costs little, without losing a result to it.

    Returns:
        None if there are too few frames, or too many observations; without splits, but
        with the reason, if the halves could not be adjusted.
    """
    if why_not_halved(calibration) or not calibration.covariance.determined:
        return None
    try:
        return cross_validate(rig, calibration)
    except (UwsfmError, np.linalg.LinAlgError) as error:  # the result is worth more
        return CrossValidation(
            unit=_unit(calibration), splits=(), omitted=(str(error),)
        )


def _unit(calibration: CalibrationResult) -> str:
    return "units" if calibration.covariance.scale_stddev is None else "m"


def cross_validate(
    rig: Rig, calibration: CalibrationResult, *, seed: int = 0
) -> CrossValidation:
    """Adjust disjoint halves of a result's frames, and compare them.

    The halves start from the result, and keep its observations. Lengths from outside
    take no part: they would be known to one half, or to both.

    Args:
        rig: names, and how far the lenses were calibrated.
        calibration: of the whole, as `reconstruct` or `open_result` give it.
        seed: of the points whose distances are compared.

    Raises:
        InputError: there are too few frames.
        UwsfmError: neither split could be adjusted.
    """
    scene, _ = calibration.scene.select(calibration.inliers)
    frames = np.unique(scene.frame_idx)
    if len(frames) < MIN_FRAMES:
        raise InputError(
            f"the result has {len(frames)} frames: halves that can be compared need "
            f"{MIN_FRAMES} or more, so a result of so few cannot be cross-validated"
        )
    middle = (len(frames) + 1) // 2
    ways = {
        INTERLEAVED: (frames[::2], frames[1::2]),
        IN_ORDER: (frames[:middle], frames[middle:]),
    }
    splits, omitted = [], []
    for name, halves in ways.items():
        try:
            parts = tuple(adjusted_alone(scene, half, calibration) for half in halves)
            splits.append(_compared(name, rig, scene, parts, seed))
        except UwsfmError as error:
            omitted.append(f"The halves {name} could not be compared: {error}.")
    if not splits:
        raise UwsfmError(" ".join(omitted))
    return CrossValidation(
        unit=_unit(calibration),
        splits=tuple(splits),
        omitted=tuple(omitted),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PartOfDive:
    """Some frames of a result, adjusted by themselves."""

    calibration: CalibrationResult
    point_idx: IndexArray
    """(P',) index in the whole of each of its points."""
    num_frames: int


def adjusted_alone(
    scene: Scene, frames: IndexArray, whole: CalibrationResult
) -> PartOfDive:
    """Adjust some frames of a result by themselves, from its observations.

    Args:
        scene: of the result, inliers only.
        frames: (K,) that are kept; poses and points are numbered anew.
        whole: its options; lengths from outside take no part.

    Raises:
        UwsfmError: they are too few, or do not determine what is refined.
    """
    keep = np.isin(scene.frame_idx, frames)
    counts = np.bincount(scene.point_idx[keep], minlength=scene.num_points)
    keep &= counts[scene.point_idx] >= 2
    if np.count_nonzero(keep) < MIN_OBSERVATIONS:
        raise UwsfmError(
            f"one of them has {np.count_nonzero(keep)} observations of points that it "
            f"sees twice, and {MIN_OBSERVATIONS} are needed"
        )
    part, used = scene.select(keep)
    present, frame_idx = np.unique(part.frame_idx, return_inverse=True)
    part = replace(
        part,
        rig_from_world=scene.rig_from_world[present],
        frame_idx=frame_idx.astype(np.int64),
    )
    options = {
        item.name: getattr(whole.options, item.name) for item in fields(whole.options)
    }
    result = calibrate(part, **{**options, "loss": "l2"})
    if not result.covariance.determined:
        raise UwsfmError("one of them alone does not determine what is refined")
    return PartOfDive(calibration=result, point_idx=used, num_frames=len(present))


def _compared(
    name: str, rig: Rig, scene: Scene, halves: Sequence[PartOfDive], seed: int
) -> Split:
    first, second = (half.calibration for half in halves)
    numbers = shared_numbers(first, second, [camera.name for camera in rig.cameras])
    freedom = sum(
        len(np.unique(half.calibration.scene.camera_idx)) * half.num_frames
        for half in halves
    )
    agreements = [_agreement(group, numbers, freedom) for group in numbers.groups]
    lengths = _compared_lengths(halves, seed)
    if lengths is not None:
        found, ratios, covariance = lengths
        most = FARTHEST * float(np.median(np.abs(ratios)) / MEDIAN_NORMAL)
        size = float(np.sqrt(np.mean(np.clip(ratios, -most, most) ** 2)))
        agreements.append(_judged("length", size, covariance, freedom))
        if found.scale_stddev is not None and found.scale_stddev > 0.0:
            z = abs(found.scale) / found.scale_stddev
            agreements.append(_judged("scale", z, np.ones((1, 1)), freedom))
    arbitrary = first.covariance.scale_stddev is None
    counts = [half.calibration.scene.num_observations for half in halves]
    return Split(
        name=name,
        num_frames=(halves[0].num_frames, halves[1].num_frames),
        num_observations=(counts[0], counts[1]),
        sigma_px=(first.summary.sigma_px, second.summary.sigma_px),
        numbers=numbers.numbers,
        # A number at its bound in one half has no prediction there.
        agreements=tuple(
            a for a in agreements if np.isfinite([a.ratio, a.p_value]).all()
        ),
        lengths=None if lengths is None else lengths[0],
        projections=projection_map(
            first.scene, second.scene, scene, rig, with_scale=arbitrary
        ),
    )


def _agreement(group: str, numbers: SharedNumbers, freedom: int) -> Agreement:
    which = numbers.of(group)
    z = np.array([numbers.numbers[k].z for k in which])
    ratio = float(np.sqrt(np.mean(z**2)))
    return _judged(group, ratio, numbers.covariance[np.ix_(which, which)], freedom)


def _judged(group: str, ratio: float, covariance: Array, freedom: int) -> Agreement:
    """The chance of a ratio: correlated numbers count for fewer (Satterthwaite), and
    predictions are themselves estimates, from as many images as there are."""
    stddevs = np.sqrt(np.diag(covariance))
    correlation = covariance / (stddevs[:, None] * stddevs)
    independent = float(np.trace(correlation) ** 2 / np.sum(correlation**2))
    chance = float(f_distribution.sf(ratio**2, independent, freedom))
    return Agreement(
        group=group, ratio=ratio, num_independent=independent, p_value=chance
    )


def _compared_lengths(
    halves: Sequence[PartOfDive], seed: int
) -> tuple[Lengths, Array, Array] | None:
    """Distances between points of both; differences in their standard deviations (K,),
    and the covariance (K, K) of the differences."""
    rows = [
        half.point_idx[finite_rows(half.calibration.scene.points)] for half in halves
    ]
    common = np.intersect1d(rows[0], rows[1])
    count = min(MAX_LENGTHS, len(common) // 2)
    if count < 2:
        return None
    chosen = np.random.default_rng(seed).permutation(common)[: 2 * count]
    found, places, covariances = [], [], []
    for half in halves:
        scene = half.calibration.scene
        index = np.searchsorted(half.point_idx, chosen)
        propagation = Propagation(half.calibration)
        ends = propagation.of_points(index)
        apart = ends.points[:count] - ends.points[count:]
        lengths = np.linalg.norm(apart, axis=1)
        slopes = np.zeros((count, 2 * count, 3))
        pairs = np.arange(count)
        slopes[pairs, pairs] = apart / lengths[:, None]
        slopes[pairs, count + pairs] = -slopes[pairs, pairs]
        alone = propagation.covariance(ends, slopes)
        shared = propagation.clustered_covariance(ends, slopes)
        raised = np.sqrt(np.maximum(np.diag(shared) / np.diag(alone), 1.0))
        covariances.append(raised[:, None] * alone * raised)
        found.append(lengths)
        places.append(scene.points[np.searchsorted(half.point_idx, common)])
    moved = align(places[0], places[1], np.ones(len(common)), with_scale=True)
    gaps, covariance = _differences(found, covariances, moved.scale)
    stddevs = np.sqrt(np.diag(covariance))
    known = [half.calibration.covariance.scale_stddev for half in halves]
    predicted = None
    if known[0] is not None and known[1] is not None:
        predicted = float(np.hypot(known[0], known[1]))
    report = Lengths(
        num_pairs=count,
        typical_m=float(np.median(found[0])),
        difference_m=float(np.median(np.abs(gaps)) / MEDIAN_NORMAL),
        predicted_m=float(np.median(stddevs)),
        scale=moved.scale - 1.0,
        scale_stddev=predicted,
    )
    return report, gaps / stddevs, covariance


def _differences(
    lengths: Sequence[Array], covariances: Sequence[Array], scale: float
) -> tuple[Array, Array]:
    """Differences (K,) of lengths in two halves, and their covariance (K, K).

    A scale that only a port's distance hints at is unknown by half, and far from
    linear: it is taken out, and what is left is the shape.

    Args:
        lengths: (K,) of each half.
        covariances: (K, K) of each.
        scale: of the second half over the first.
    """
    gaps, covariance = lengths[1] - lengths[0], covariances[0] + covariances[1]
    # Each to its own lengths: a half whose scale is loose may have shrunk to a fifth.
    relative = [
        np.diag(each) / length**2
        for each, length in zip(covariances, lengths, strict=True)
    ]
    if np.sqrt(np.median(np.sum(relative, axis=0))) < LOOSE_SCALE:
        return gaps, covariance
    gaps = lengths[1] / scale - lengths[0]
    covariance = covariances[0] + covariances[1] / scale**2
    along = lengths[0] / np.linalg.norm(lengths[0])
    across = np.eye(len(along)) - along[:, None] * along
    return across @ gaps, across @ covariance @ across.T
