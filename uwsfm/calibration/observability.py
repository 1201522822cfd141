"""What the images determine and what they do not, in words, and what to do about it.

Scale, distance and depth hang together under water: which combinations stay open
follows from the posterior covariance, and why from how the rig moved over what.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.error_budget import BudgetRow, Shift
from uwsfm.calibration.length_verdicts import length_verdicts, small_length
from uwsfm.calibration.parameters import BASELINE, FOCAL, OF_PORTS, WATER_INDEX
from uwsfm.calibration.prior_verdicts import held_by_priors
from uwsfm.calibration.result import CalibrationResult, CameraCovariance
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort, PlanePort
from uwsfm.residuals import border
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD

# A standard deviation below this share of a distance is worth a number.
WEAK_SHARE = 0.25
# Tilts better than this can be told from a straight port by eye.
WEAK_TILT_DEG, OPEN_TILT_DEG = 0.2, 1.0
# Of the centre of a dome, by its radius: a hundredth moves pixels by about one in 1000.
WEAK_CENTER, OPEN_CENTER = 0.02, 0.2
# Below this, relief and changes of range do not separate depth from port distance.
FLAT, LEVEL = 0.03, 0.15
FEW_FRAMES = 5
INSEPARABLE = 0.95


def distance_verdict(distance: float, cov: CameraCovariance, refined: bool) -> str:
    """Whether the images determine a port's distance: a word for people."""
    if not refined:
        return "held"
    if cov.distance_at_zero:
        return "ran into zero"
    return _verdict(cov.distance_stddev_m, WEAK_SHARE * abs(distance), abs(distance))


def normal_verdict(cov: CameraCovariance, refined: bool) -> str:
    """Whether the images determine a port's tilt: a word for people."""
    if not refined:
        return "held"
    return _verdict(cov.normal_stddev_deg, WEAK_TILT_DEG, OPEN_TILT_DEG)


def center_verdict(radius: float, cov: CameraCovariance, refined: bool) -> str:
    """Whether the images determine the centre of a dome: a word for people."""
    if not refined:
        return "held"
    stddev = float(np.linalg.norm(cov.center_stddev_m))
    return _verdict(stddev, WEAK_CENTER * radius, OPEN_CENTER * radius)


def _verdict(stddev: float, weak: float, lost: float) -> str:
    if not math.isfinite(stddev) or stddev >= lost:
        return "not determined"
    return "determined" if stddev < weak else "weakly determined"


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """How the rig moved over what; lengths relative to the median range."""

    num_frames: int
    relief: float
    """Standard deviation of the points from their plane."""
    range_spread: float
    """Of the frames' median ranges, from the 5th to the 95th percentile."""

    @classmethod
    def of(cls, scene: Scene) -> "Geometry":
        used = finite_rows(scene.points)[scene.point_idx]
        frames, points = scene.frame_idx[used], scene.points[scene.point_idx[used]]
        depth = rigid3.transform(scene.rig_from_world[frames], points)[:, 2]
        seen = np.unique(frames)
        ranges = np.array([np.median(depth[frames == f]) for f in seen])
        cloud = scene.points[finite_rows(scene.points)]
        flat = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)[-1]
        low, high = np.percentile(ranges, [5.0, 95.0])
        middle = float(np.median(ranges))
        return cls(
            num_frames=len(seen),
            relief=float(flat / np.sqrt(len(cloud)) / middle),
            range_spread=float((high - low) / middle),
        )

    def reason(self) -> tuple[str, str]:
        """What makes a distance hard to tell here, and what would help."""
        if self.num_frames < FEW_FRAMES:
            return f"only {self.num_frames} frames", "add frames"
        if self.relief >= FLAT and self.range_spread >= LEVEL:
            return (
                f"these {self.num_frames} frames",
                "add frames, turned and tilted against each other",
            )
        if self.relief >= FLAT:
            return "a rig at constant altitude", "fly at two altitudes"
        if self.range_spread >= LEVEL:
            return "a flat sea floor", "add frames, or fly over relief"
        return "a flat sea floor at constant altitude", "fly at two altitudes"


def verdicts(
    result: CalibrationResult, names: Sequence[str], budget: Sequence[BudgetRow] = ()
) -> tuple[str, ...]:
    """One sentence for everything refined that is not determined.

    Args:
        result: of a calibration, with its covariance; deviations "in all" count if
            they are there.
        names: of its cameras.
        budget: of the same, to name the given number that matters most.

    Returns:
        Nothing if all is determined.
    """
    covariance = result.covariance
    geometry = Geometry.of(result.scene.select(result.inliers)[0])
    at_zero = tuple(
        f"the images put the port of {name} behind its camera, so its distance was "
        "held at zero: either they do not determine it, or they contradict the lens "
        "calibrated in air (is it valid up to the image corners?) or the water index"
        for name, camera in zip(names, covariance.cameras, strict=True)
        if camera.distance_at_zero
    )
    about_lengths = length_verdicts(result)
    causes = _Causes(result, budget)
    if not covariance.determined:
        reason, advice = geometry.reason()
        return (
            *about_lengths,
            *at_zero,
            "the images leave some combination of what is refined entirely free, so no "
            f"standard deviation can be given; {reason} do not tell: {advice}, or hold "
            "more of it",
        )
    return (
        *about_lengths,
        *at_zero,
        *_distances(result, names, geometry, causes),
        *_tilts(result, names, causes),
        *_centers(result, names, causes),
        *held_by_priors(result, names),
        *_inseparable(result, names),
    )


@dataclass(frozen=True, eq=False)
class _Causes:
    """Whether the images or the given numbers leave an estimate open."""

    result: CalibrationResult
    budget: Sequence[BudgetRow]

    def given(
        self, image_word: str, size: Callable[[Shift], float], camera: int
    ) -> str | None:
        """The given number that matters most; None if it is the images that do not
        determine the estimate."""
        if image_word != "determined" or not self.budget:
            return None
        single = [row for row in self.budget[:-1] if "alike" not in row.name]
        worst = max(single, key=lambda row: size(row.shifts[camera]), default=None)
        if worst is None:
            return None
        word = "assumed" if worst.assumed else "given"
        return (
            f"errors of what was given leave it so, most of all {worst.name} "
            f"({worst.amount.replace('+', '± ')}, {word}): give its accuracy in the "
            "rig file if it is known better, or calibrate it again"
        )


def _distances(
    result: CalibrationResult,
    names: Sequence[str],
    geometry: Geometry,
    causes: _Causes,
) -> list[str]:
    """The weak directions of the port distances, weakest first."""
    covariance = result.covariance
    with_one = [port.has("distance") for port in result.scene.ports]
    cols = np.where(with_one, covariance.border_cols[:, border.DISTANCE], HELD)
    free = np.nonzero(cols != HELD)[0]
    if not len(free):
        return []
    in_all = covariance.in_all
    border_block = covariance.border if in_all is None else in_all.border
    block = border_block[np.ix_(cols[free], cols[free])]
    # Neighbours' shared errors make the reported deviations larger than the block's.
    judged = covariance.judged_cameras
    reported = np.array([judged[c].distance_stddev_m for c in free])
    grow = reported / np.sqrt(np.diag(block))
    values, vectors = np.linalg.eigh(block * np.outer(grow, grow))
    ports = [result.scene.ports[c] for c in free]
    sizes = [p.distance for p in ports if isinstance(p, PlanePort)]
    typical = float(np.mean(sizes))
    sentences = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        strong = _strong(vector)
        # Of one distance, not of the unit vector that several share.
        share = np.abs(vector[strong]).mean()
        stddev = float(share * np.sqrt(max(value, 0.0)))
        size = typical
        if np.count_nonzero(strong) == 1:  # as in the tables: other directions, too
            alone = int(np.argmax(strong))
            stddev, size = float(reported[alone]), abs(sizes[alone])
        word = _verdict(stddev, WEAK_SHARE * size, size)
        if word == "determined":
            continue
        what, each = _direction(vector, [names[int(c)] for c in free])
        camera = int(free[int(np.argmax(np.abs(vector)))])
        own = _verdict(
            covariance.cameras[camera].distance_stddev_m, WEAK_SHARE * size, size
        )
        cause = causes.given(own, lambda shift: abs(shift.distance_m), camera)
        known = f"{small_length(stddev, covariance.scale_stddev)}{each}"
        if cause is not None:
            sentences.append(
                f"{what} {word}: standard deviation {known} in all; {cause}"
            )
            continue
        reason, advice = geometry.reason()
        sentences.append(
            f"{what} {word} by {reason}: standard deviation {known}; {advice}"
        )
    return sentences


def _strong(vector: Array) -> NDArray[np.bool_]:
    return np.abs(vector) > 0.5 * np.abs(vector).max()


def _direction(vector: Array, names: list[str]) -> tuple[str, str]:
    """What a direction in the space of distances is called, with its verb; and "each"
    if its deviation is that of several."""
    strong = _strong(vector)
    some = [name for name, on in zip(names, strong, strict=True) if on]
    if len(some) == 1:
        return f"the port distance of {some[0]} is", ""
    same = np.all(vector[strong] > 0.0) or np.all(vector[strong] < 0.0)
    how = "together" if same else "against each other"
    which = f"{', '.join(some[:-1])} and {some[-1]}"
    return f"the port distances of {which}, moved {how}, are", " each"


def _tilts(
    result: CalibrationResult, names: Sequence[str], causes: _Causes
) -> list[str]:
    sentences = []
    for c, camera in enumerate(result.covariance.judged_cameras):
        if not result.scene.ports[c].has("normal"):
            continue
        refined = bool(result.covariance.border_cols[c, border.NORMAL][0] != HELD)
        word = normal_verdict(camera, refined)
        if word in ("weakly determined", "not determined"):
            own = normal_verdict(result.covariance.cameras[c], refined)
            cause = causes.given(own, lambda shift: shift.tilt_deg, c)
            sentences.append(
                f"the direction of the port of {names[c]} is {word}: standard "
                f"deviation {camera.normal_stddev_deg:.2f} deg, of both tilts together"
                f"{'' if cause is None else ', in all'}; "
                f"{cause or 'more points or frames would help'}"
            )
    return sentences


def _centers(
    result: CalibrationResult, names: Sequence[str], causes: _Causes
) -> list[str]:
    sentences = []
    for c, camera in enumerate(result.covariance.judged_cameras):
        port = result.scene.ports[c]
        if not isinstance(port, DomePort):
            continue
        refined = bool(result.covariance.border_cols[c, border.CENTER][0] != HELD)
        word = center_verdict(port.radius, camera, refined)
        if word in ("weakly determined", "not determined"):
            known = ", ".join(
                small_length(value, result.covariance.scale_stddev)
                for value in camera.center_stddev_m
            )
            own = center_verdict(port.radius, result.covariance.cameras[c], refined)
            cause = causes.given(own, lambda s: math.hypot(*s.center_m), c)
            advice = "hold it if it was measured better, or add nearer points and more"
            sentences.append(
                f"the centre of the dome of {names[c]} is {word}: standard deviation "
                f"{known}"
                f"{'' if cause is None else ' in all'}; {cause or advice + ' frames'}"
            )
    return sentences


def _inseparable(result: CalibrationResult, names: Sequence[str]) -> list[str]:
    """Pairs of unlike numbers that the images hardly tell apart."""
    columns, labels = _labels(result, names)
    block = result.covariance.border[np.ix_(columns, columns)]
    spread = np.sqrt(np.diag(block))
    correlation = block / np.outer(spread, spread)
    sentences = []
    for j in range(len(columns)):
        for i in range(j):
            value = float(correlation[i, j])
            if labels[i][0] != labels[j][0] and abs(value) > INSEPARABLE:
                sentences.append(
                    f"{labels[i][1]} and {labels[j][1]} can hardly be told apart "
                    f"(correlation {value:+.2f}): give a prior for one of them"
                )
    return sentences


def _labels(
    result: CalibrationResult, names: Sequence[str]
) -> tuple[list[int], list[tuple[str, str]]]:
    """Columns of the numbers that may be confused, with a kind and a name each."""
    columns: list[int] = []
    labels: list[tuple[str, str]] = []
    for c, (name, port) in enumerate(zip(names, result.scene.ports, strict=True)):
        for each in (*OF_PORTS, BASELINE, FOCAL):
            if not each.of(port):
                continue
            column = int(result.covariance.border_cols[c, each.first])
            if column != HELD and column not in columns:
                columns.append(column)
                of = "" if each is WATER_INDEX else f" of {name}"
                labels.append((each.name, f"the {each.name}{of}"))
    return columns, labels
