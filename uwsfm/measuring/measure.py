"""`uwsfm.measure`: what people point at in a result, measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import checked_target
from uwsfm.calibration.length_verdicts import ASK_FOR_LENGTH, scale_verdict
from uwsfm.calibration.propagation import Places, Propagation
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.measuring import quantities
from uwsfm.measuring.measurements_file import Task, load_measurements
from uwsfm.measuring.quantities import Quantity
from uwsfm.measuring.spots import Spot, Spotter
from uwsfm.results.folder import Result, open_result
from uwsfm.results.summary import versions, write_json
from uwsfm.results.verdict_summary import shown_word, verdict_note
from uwsfm.trust.verdict import FITS

DOUBTFUL, CONTRADICTION = 2.0, 4.0
"""Standard deviations that a scale bar may be off by."""

STDDEV = (
    "one sigma, from the full covariance of rig, ports, poses and points; stddev is "
    "from the images, the larger of two: every observation errs alone, or those of a "
    "quarter of an image together; stddev_in_all adds the errors of what was given: "
    "lens, glass, water, baseline and whatever else was held"
)

_COMPUTE = {
    "distance": quantities.distance,
    "polyline": quantities.polyline,
    "area": quantities.area,
    "height": quantities.height,
    "angle": quantities.angle,
    "scale bar": quantities.distance,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """One number, and what is known of it.

    In metres, square metres or degrees; in powers of the model's own unit if nothing
    determines its scale.
    """

    task: Task
    value: float | None
    """None: the data do not determine it."""
    stddev: float | None
    """The larger of the next two, or None."""
    stddev_alone: float | None
    stddev_clustered: float | None
    stddev_in_all: float | None
    """With the errors of what was given."""
    spots: tuple[Spot, ...]
    points: Array
    """(k, 3) places in the world."""
    places_stddev: Array
    """(k,) of the places, RMS over the axes' sum, relative to the held first frame."""
    flatness: Array | None
    """Of areas and heights: distances (k,) from the fitted plane."""
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasureResult:
    """What `measure` found."""

    unit: str
    """"metre" or "scale arbitrary"."""
    measurements: tuple[Measurement, ...]
    scale_bars: dict[str, Any] | None
    """What all scale bars say together of the scale; None without any."""
    warnings: tuple[str, ...]
    summary: dict[str, Any]
    """The same as JSON."""


def measure(
    out: str | Path | Result,
    measurements: str | Path | Mapping[str, Any],
    report: str | Path | None = None,
) -> MeasureResult:
    """Measure distances, polylines, areas, heights and angles in a result.

    Args:
        out: Folder of `reconstruct` or `refine_model`, or what `open_result` gives.
        measurements: A measurements.yaml, or its content; see
            `uwsfm.measuring.measurements_file`.
        report: JSON file to write; must not exist.

    Raises:
        InputError: there is a report already, the folder or the file is not usable, or
            a pick cannot be placed; one sentence that names it.
    """
    if report is not None:
        checked_target(report)
    tasks = load_measurements(measurements)
    result = out if isinstance(out, Result) else open_result(out)
    propagation = Propagation(result.calibration)
    spotter = Spotter(result, propagation)
    rows = [spotter.rows_of(task) for task in tasks]
    places = spotter.places()
    found = [_computed(t, places.points[r]) for t, r in zip(tasks, rows, strict=True)]
    slopes = np.zeros((len(tasks), len(places), 3))
    for slope, quantity, r in zip(slopes, found, rows, strict=True):
        np.add.at(slope, r, quantity.slope)
    both = (
        propagation.covariance(places, slopes),
        propagation.clustered_covariance(places, slopes),
    )
    given = propagation.given_covariance(places, slopes)
    known = _Known(result, propagation, places, spotter.spots, both, given)
    items = tuple(
        known.measurement(i, task, quantity, r, spotter.entered(task))
        for i, (task, quantity, r) in enumerate(zip(tasks, found, rows, strict=True))
    )
    bars = known.scale_bars(items)
    warnings = (*verdict_note(result.summary), *known.warnings)
    answer = MeasureResult(
        unit=result.unit,
        measurements=items,
        scale_bars=bars,
        warnings=warnings,
        summary=_summary(result, items, bars, warnings),
    )
    if report is not None:
        write_json(answer.summary, report)
    return answer


def _computed(task: Task, points: Array) -> Quantity:
    try:
        return _COMPUTE[task.kind](points)
    except InputError as error:
        raise InputError(f"{task.where} ({task.name}): {error}") from None


@dataclass(frozen=True, eq=False)
class _Known:
    """Covariances of all numbers, and what they mean."""

    result: Result
    propagation: Propagation
    places: Places
    spots: Sequence[Spot]
    both: tuple[Array, Array]
    """(K, K) if every observation errs alone, and if neighbours err together."""
    given: Array
    """(K, K) from errors of what was given."""

    @property
    def scale_stddev(self) -> float | None:
        return self.result.calibration.covariance.judged_scale_stddev

    @property
    def warnings(self) -> tuple[str, ...]:
        word = scale_verdict(self.scale_stddev)
        if word == "arbitrary":
            return (
                "scale arbitrary: nothing determines it, so lengths and areas are in "
                f"an arbitrary unit; {ASK_FOR_LENGTH}",
            )
        if word == "not determined" or not self.propagation.determined:
            return (
                "the images leave something of the rig or the scale open: nothing that "
                f"is measured is determined; {ASK_FOR_LENGTH}",
            )
        if word == "weakly determined":
            assert self.scale_stddev is not None
            return (
                f"the scale is weakly determined, {1e2 * self.scale_stddev:.0f} %, "
                f"which all standard deviations here hold; {ASK_FOR_LENGTH}",
            )
        return ()

    def measurement(
        self, i: int, task: Task, quantity: Quantity, rows: Sequence[int], entered: bool
    ) -> Measurement:
        unit = math.degrees(1.0) if task.kind == "angle" else 1.0
        stddevs = [unit * math.sqrt(c[i, i]) for c in self.both]
        stddev = max(stddevs) if all(map(math.isfinite, stddevs)) else math.nan
        if (
            task.kind != "angle"
            and scale_verdict(self.scale_stddev) == "not determined"
        ):
            stddev = math.nan
        in_all = math.hypot(stddev, unit * math.sqrt(max(self.given[i, i], 0.0)))
        known = math.isfinite(in_all)
        spots = tuple(self.spots[row] for row in rows)
        notes = [spot.note for spot in spots if spot.note is not None]
        if not known:
            notes.insert(0, "not determined by the images")
        elif task.length_m is not None and entered:
            notes.append(_ENTERED)
        elif task.kind in ("distance", "polyline", "height", "area"):
            notes += _of_its_size(quantity.value, in_all)
        return Measurement(
            task=task,
            value=unit * quantity.value if known else None,
            stddev=stddev if known else None,
            stddev_alone=stddevs[0] if known else None,
            stddev_clustered=stddevs[1] if known else None,
            stddev_in_all=in_all if known else None,
            spots=spots,
            points=self.places.points[list(rows)],
            places_stddev=self._stddevs_of_places(rows),
            flatness=quantity.flatness,
            notes=tuple(notes),
        )

    def _stddevs_of_places(self, rows: Sequence[int]) -> Array:
        slopes = np.zeros((3 * len(rows), len(self.places), 3))
        for k, row in enumerate(rows):
            slopes[3 * k : 3 * k + 3, row] = np.eye(3)
        variances = np.diag(self.propagation.covariance(self.places, slopes))
        return np.sqrt(variances.reshape(-1, 3).sum(axis=1))

    def scale_bars(self, items: Sequence[Measurement]) -> dict[str, Any] | None:
        """The factor that brings all bars to what they are known to be: a weighted
        mean, with the errors of rig and poses that bars share in its deviation."""
        rows = [
            i
            for i, item in enumerate(items)
            if item.task.kind == "scale bar" and item.value is not None
        ]
        if not rows:
            return None
        value = np.array([items[i].value for i in rows], dtype=np.float64)
        known = np.array([items[i].task.length_m for i in rows], dtype=np.float64)
        own = np.array([items[i].task.stddev_m for i in rows]) ** 2
        stddevs = [items[i].stddev_in_all for i in rows]
        variance = np.array(stddevs, dtype=np.float64) ** 2
        weight = value / (variance + own)
        weight /= float(weight @ value)
        factor = float(weight @ known)
        block = np.ix_(rows, rows)
        shared = max(float(weight @ c[block] @ weight) for c in self.both)
        shared += max(float(weight @ self.given[block] @ weight), 0.0)
        stddev = math.sqrt(shared + float(weight**2 @ own))
        ratio = (factor - 1.0) / stddev
        return {
            "num_bars": len(rows),
            "known_over_measured": factor,
            "stddev": stddev,
            "ratio": ratio,
            "verdict": self._agreement(ratio),
        }

    def _agreement(self, ratio: float) -> str:
        if self.scale_stddev is None:
            return "no check: the scale is arbitrary"
        return agreement(ratio)


_ENTERED = "the adjustment was given this length: no independent check"


def agreement(ratio: float) -> str:
    """Whether a deviation agrees with its standard deviation: a word for people."""
    if abs(ratio) <= DOUBTFUL:
        return "agrees"
    return "doubtful" if abs(ratio) <= CONTRADICTION else "contradicts"


_WRONG_UNITS = {1e3: "millimetres", 1e2: "centimetres", 1e1: "decimetres"}
_NEARLY = 1.5


def unit_hint(known: float, measured: float) -> str | None:
    """What a known length may have been given in, if not in metres."""
    if not measured > 0.0:
        return None
    for factor, name in _WRONG_UNITS.items():
        if 1.0 / _NEARLY < known / measured / factor < _NEARLY:
            return f"{factor:g} times what was measured: {name}?"
        if 1.0 / _NEARLY < measured / known / factor < _NEARLY:
            return f"{factor:g} times too short: is it in metres?"
    return None


def _of_its_size(value: float, stddev: float) -> list[str]:
    if value > DOUBTFUL * stddev:
        return []
    return ["not told from zero: it is no larger than what its errors make of nothing"]


def _summary(
    result: Result,
    items: Sequence[Measurement],
    bars: dict[str, Any] | None,
    warnings: Sequence[str],
) -> dict[str, Any]:
    arbitrary = result.calibration.covariance.scale_stddev is None
    entries = [entry(item, arbitrary) for item in items]
    for row in entries:
        row["verdict"] = shown_word(row["verdict"], result.summary.get("verdict", FITS))
    return {
        "result": str(result.folder.absolute()),
        "model": result.fingerprint,
        "unit": result.unit,
        "stddev": STDDEV,
        "measurements": entries,
        "scale_bars": bars,
        "warnings": list(warnings),
        "versions": versions(),
    }


_UNITS = {"area": ("m2", "unit2"), "angle": ("deg", "deg")}


def entry(item: Measurement, arbitrary: bool) -> dict[str, Any]:
    """One measurement as JSON."""
    task = item.task
    found: dict[str, Any] = {
        "name": task.name,
        "kind": task.kind,
        "value": item.value,
        "unit": _UNITS.get(task.kind, ("m", "unit"))[arbitrary],
        "stddev": item.stddev,
        "stddev_alone": item.stddev_alone,
        "stddev_clustered": item.stddev_clustered,
        "stddev_in_all": item.stddev_in_all,
        "verdict": "not determined" if item.value is None else "determined",
    }
    if item.flatness is not None:
        off = item.flatness[np.isfinite(item.flatness)]
        found["off_plane_rms_m"] = float(np.sqrt(np.mean(off**2)))
        found["off_plane_max_m"] = float(np.abs(off).max())
    if task.length_m is not None:
        found["scale_bar"] = bar_check(item, arbitrary)
    found["places"] = [
        {
            "pick": str(spot.pick),
            "how": spot.how,
            "xyz": point.tolist(),
            "stddev_m": float(stddev) if math.isfinite(stddev) else None,
            "num_images": spot.num_images,
            "moved_by_m": spot.moved_by,
            "miss_px": spot.miss_px,
        }
        for spot, point, stddev in zip(
            item.spots, item.points, item.places_stddev, strict=True
        )
    ]
    found["notes"] = list(item.notes)
    return found


def bar_check(item: Measurement, arbitrary: bool) -> dict[str, Any]:
    """How a scale bar came out beside what it is known to be."""
    task = item.task
    assert task.length_m is not None
    check: dict[str, Any] = {"known_m": task.length_m, "known_stddev_m": task.stddev_m}
    if item.value is None or item.stddev_in_all is None or arbitrary:
        return {**check, "verdict": "no check: nothing determines the length"}
    deviation = item.value - task.length_m
    stddev = math.hypot(item.stddev_in_all, task.stddev_m)
    return {
        **check,
        "deviation_m": deviation,
        "stddev_m": stddev,
        "ratio": deviation / stddev,
        "verdict": agreement(deviation / stddev),
        "hint": unit_hint(task.length_m, item.value),
    }
