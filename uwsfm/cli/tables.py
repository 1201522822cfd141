"""Tables of results, as the command line prints them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from uwsfm.cli.console import STYLES
from uwsfm.models.ports.port import kind_of_word
from uwsfm.report.tables import lengths_note
from uwsfm.report.words import tilts_of
from uwsfm.results.verdict_summary import WITHHELD

if TYPE_CHECKING:
    from uwsfm.jobs.batch import Outcome
    from uwsfm.jobs.evaluate import Comparison

# Three numbers and their deviations side by side do not fit a narrow terminal.
_CENTER: tuple[tuple[str, slice], ...] = (("x, y", slice(0, 2)), ("z", slice(2, 3)))


def housing_table(summary: dict[str, Any]) -> Table:
    """The refined housings, each number with its standard deviation."""
    table = Table(
        title="Housing: ± is one standard deviation, from the images and in all (with "
        "the errors of what was given)",
        title_justify="left",
    )
    table.add_column("camera", no_wrap=True)
    table.add_column("port")
    for column in ("estimate", "± images", "± in all"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("verdict", justify="right")
    for camera in summary["cameras"]:
        for row in _port_rows(camera, summary["scale"]["small_unit"]):
            table.add_row(Text(camera["name"]), *row)
    return table


def _port_rows(camera: dict[str, Any], unit: str) -> list[tuple[str, ...]]:
    """What, estimate, standard deviations and verdict of what a port has."""
    kind = kind_of_word(camera["port"])
    if not kind.refracts:
        return [(kind.word, "", "", "", "")]
    if kind.has("center"):
        center = camera["center_m"]
        both = (camera["center_stddev_m"], camera["center_stddev_in_all_m"])
        return [
            (
                f"dome centre {axes} ({unit})",
                _millimetres(center[part]),
                *("-" if None in own else _millimetres(own[part]) for own in both),
                camera["center_verdict"],
            )
            for axes, part in _CENTER
        ]
    tilts = tilts_of(camera)
    return [
        *(
            (
                f"tilt {axis} (deg)",
                f"{value:+.3f}",
                _number(images, "{:.3f}"),
                _number(in_all, "{:.3f}"),
                camera["normal_verdict"],
            )
            for axis, (value, images, in_all) in zip("xy", tilts, strict=True)
        ),
        *_paper_rows(camera),
        (
            f"distance ({unit})",
            f"{1e3 * camera['distance_m']:.2f}",
            _number(camera["distance_stddev_m"], "{:.2f}", 1e3),
            _number(camera["distance_stddev_in_all_m"], "{:.2f}", 1e3),
            camera["distance_verdict"],
        ),
    ]


def _paper_rows(camera: dict[str, Any]) -> list[tuple[str, ...]]:
    """Azimuth phi and tilt theta of the normal, as Sedlazeck and Koch print them."""
    return [
        (
            f"{key} (deg)",
            f"{camera[f'{key}_deg']:.3f}",
            _number(camera[f"{key}_stddev_deg"], "{:.3f}"),
            _number(camera[f"{key}_stddev_in_all_deg"], "{:.3f}"),
            "",
        )
        for key in ("azimuth", "tilt")
    ]


def result_table(summary: dict[str, Any]) -> Table:
    """How much was reconstructed, and how well it fits."""
    table = Table(title="Reconstruction", title_justify="left", show_header=False)
    rms = summary["reprojection_rms_px"]
    frames = f"{summary['num_registered_frames']} of {summary['num_frames']}"
    table.add_row("frames registered", frames)
    if "num_images" in summary and len(summary["cameras"]) > 1:
        images = f"{summary['num_registered_images']} of {summary['num_images']}"
        table.add_row("images registered", images)
    table.add_row("points", f"{summary['num_points']}")
    table.add_row("observations", f"{summary['num_observations']}")
    table.add_row("invalid observations", f"{summary['num_invalid']}")
    table.add_row("RMS error of these observations", f"{rms['after']:.3f} px")
    table.add_row("  before the adjustment", f"{rms['before']:.3f} px")
    table.add_row("scale", _scale(summary["scale"]))
    _add_positions(table, summary.get("positions"))
    if "colmap_model" in summary:
        found = summary["colmap_model"]
        own, ours = (
            found[key]
            for key in ("mean_error_of_common_px", "refractive_error_of_common_px")
        )
        table.add_row(
            "mean error of those that the COLMAP model has", _number(ours, "{:.3f} px")
        )
        table.add_row("  with the COLMAP model", _number(own, "{:.3f} px"))
    _add_refined(table, summary.get("refined", ()))
    return table


def calibration_table(summary: dict[str, Any]) -> Table:
    """What was calibrated from what, and what else was refined."""
    table = Table(title="Calibration", title_justify="left", show_header=False)
    table.add_row("strategy, error", f"{summary['strategy']}, {summary['error']}")
    table.add_row("start", summary["start"])
    table.add_row(
        "frames, points", f"{summary['num_registered_frames']}, {summary['num_points']}"
    )
    table.add_row("observations", f"{summary['num_observations']}")
    rms = summary["reprojection_rms_px"]
    table.add_row("RMS error of these observations", f"{rms:.3f} px")
    table.add_row("scale", _scale(summary["scale"]))
    _add_refined(table, summary["refined"])
    return table


def _add_refined(table: Table, entries: Iterable[dict[str, Any]]) -> None:
    for entry in entries:
        own, total = (
            _number(entry[key], "{:.3g}") for key in ("stddev", "stddev_in_all")
        )
        text = f"{entry['value']:.7g} ± {own} from the images, ± {total} in all"
        if "verdict" in entry:
            text += f": {entry['verdict']}"
        table.add_row(Text(entry["name"]), text)


_SHIFTS = {
    "normal": "tilt (deg)",
    "distance_m": "distance ({})",
    "center_m": "centre x, y, z ({})",
}
"""Of the numbers of a port."""


BUDGET_ROWS = 12
"""Effects that the console shows of a calibration; the files have all of them."""
FEW_BUDGET_ROWS = 4
"""The same, of a reconstruction."""


def budget_table(summary: dict[str, Any], num_rows: int = BUDGET_ROWS) -> Table:
    """What errors of the given numbers would do to the housing, the largest first."""
    *rows, total = summary["error_budget"]
    note = lengths_note(summary)
    table = Table(
        title="If a given number is wrong by one standard deviation, then (the largest "
        "effect, for the ± in all, first)",
        title_justify="left",
        caption=note or None,
        caption_justify="left",
    )
    table.add_column("given")
    table.add_column("by", justify="right")
    for camera in summary["cameras"]:
        name = camera["name"]
        for what in (text for key, text in _SHIFTS.items() if key in camera):
            text = what.format(summary["scale"]["small_unit"])
            table.add_column(f"{name}\n{text}", justify="right")
    table.add_column("lengths\n(%)", justify="right")
    for row in rows[:num_rows]:
        by = f"{row['amount']} ({row['deviation']})"
        table.add_row(row["if"], by, *_budget_cells(summary, row, "+"))
    if len(rows) > num_rows:
        table.add_row(f"and {len(rows) - num_rows} smaller ones: see the file")
    table.add_section()
    table.add_row("all, correlated (±)", "", *_budget_cells(summary, total, ""))
    return table


def _budget_cells(
    summary: dict[str, Any], row: dict[str, Any], sign: str
) -> Iterable[str]:
    number = "{:" + sign + ".2f}"
    for camera, shift in zip(summary["cameras"], row["cameras"], strict=True):
        if "normal" in camera:
            yield _number(shift["tilt_deg"], "{:.3f}")
            yield _number(shift["distance_m"], number, 1e3)
        if "center_m" in camera:
            yield _millimetres(shift["center_m"])
    yield _number(row["scale"], number, 1e2)


def comparison_table(comparison: Comparison) -> Table:
    """Estimate, standard deviation and truth, side by side."""
    table = Table(
        title="Estimate against truth (± and error of a tilt: of its whole angle)",
        title_justify="left",
    )
    table.add_column("", no_wrap=True)
    for column in ("estimate", "±", "truth", "error"):
        table.add_column(column, justify="right", no_wrap=True)
    for camera in comparison.cameras:
        table.add_row(
            Text(f"{camera.name}: tilt x, y (deg)"),
            _tilt(camera.normal),
            _number(camera.tilt_stddev_deg, "{:.3f}"),
            _tilt(camera.true_normal),
            f"{camera.tilt_error_deg:.3f}",
        )
        table.add_row(
            Text(f"{camera.name}: distance (mm)"),
            f"{1e3 * camera.distance_m:.2f}",
            _number(camera.distance_stddev_m, "{:.2f}", 1e3),
            f"{1e3 * camera.true_distance_m:.2f}",
            f"{1e3 * camera.distance_error_m:+.2f}",
        )
    for dome in comparison.domes:
        for axes, part in _CENTER:
            found, true = list(dome.center_m)[part], list(dome.true_center_m)[part]
            known = list(dome.center_stddev_m)[part]
            error = math.dist(found, true)
            table.add_row(
                Text(f"{dome.name}: centre {axes} (mm)"),
                _millimetres(found),
                _millimetres(known),
                _millimetres(true),
                f"{1e3 * error:.2f}",
            )
    registered, given = str(comparison.num_frames), str(comparison.num_true_frames)
    table.add_row("frames", registered, "", given, "")
    after, before = comparison.center_rms_m, comparison.start_center_rms_m
    table.add_row("rig centres (mm RMS)", "", "", "", f"{1e3 * after:.2f}")
    table.add_row("  before the end", "", "", "", f"{1e3 * before:.2f}")
    return table


MAX_IMAGE_ROWS = 40


def pinhole_table(report: dict[str, Any]) -> Table:
    """What refraction is left in each image of a central model, the worst first."""
    table = Table(
        title="Refraction left (px), at points that were left out",
        title_justify="left",
    )
    table.add_column("image", no_wrap=True)
    for column in ("points", "RMS", "max", "one depth: RMS", "max"):
        table.add_column(column, justify="right")
    images = sorted(report["images"], key=lambda image: -(image["rms_px"] or 0.0))
    for image in images[:MAX_IMAGE_ROWS]:
        cells = [_number(image[key], "{:.3f}") for key in _PINHOLE_COLUMNS]
        table.add_row(Text(image["name"]), f"{image['num_points']}", *cells)
    if len(images) > MAX_IMAGE_ROWS:
        table.add_row(f"and {len(images) - MAX_IMAGE_ROWS} better ones")
    table.add_section()
    cells = [_number(report[key], "{:.3f}") for key in _PINHOLE_COLUMNS]
    table.add_row("all", f"{report['num_observations']}", *cells)
    return table


_PINHOLE_COLUMNS = ("rms_px", "max_px", "constant_rms_px", "constant_max_px")


def batch_table(outcomes: Iterable[Outcome]) -> Table:
    """What became of each dive."""
    table = Table(title="Dives", title_justify="left")
    table.add_column("dive", no_wrap=True)
    table.add_column("result")
    table.add_column("verdict", no_wrap=True)
    for column in ("frames", "RMS (px)", "minutes"):
        table.add_column(column, justify="right", no_wrap=True)
    for outcome in outcomes:
        frames, rms, verdict = "", "", Text(outcome.verdict or "")
        result = Text(f"failed: {outcome.reason}", style="red")
        if outcome.reason is None:
            frames = f"{outcome.num_registered_frames} of {outcome.num_frames}"
            rms, result = f"{outcome.rms_px:.3f}", Text("done")
        minutes = outcome.seconds / 60.0
        time = _number(None if math.isnan(minutes) else minutes, "{:.1f}")
        if outcome.cause is not None:
            result = Text(outcome.cause)
        verdict.stylize(STYLES.get(outcome.verdict or "", ""))
        table.add_row(Text(outcome.name), result, verdict, frames, rms, time)
    return table


def timings_table(timings: dict[str, float], earlier: Collection[str] = ()) -> Table:
    """Where the time went; steps that an earlier run has done are not in the total."""
    total = sum(seconds for step, seconds in timings.items() if step not in earlier)
    table = Table(title="Time", title_justify="left", show_header=False)
    for step, seconds in timings.items():
        share = "earlier run"
        if step not in earlier:
            share = f"{seconds / total if total else 0.0:.0%}"
        table.add_row(step, f"{seconds:.1f} s", share)
    table.add_row("total", f"{total:.1f} s", "")
    return table


def _scale(scale: dict[str, Any]) -> str:
    """The verdict, and the standard deviations if there are any."""
    own, total = scale["relative_stddev"], scale["relative_stddev_in_all"]
    if own is None or total is None or scale["verdict"] == WITHHELD:
        return scale["verdict"]
    return (
        f"{scale['verdict']}, ± {1e2 * total:.2g} % of every length in all "
        f"(± {1e2 * own:.2g} % from the images)"
    )


def _add_positions(table: Table, positions: dict[str, Any] | None) -> None:
    if positions is None:
        return
    used = positions["num_positions"] - len(positions["outliers"])
    table.add_row("positions used", f"{used} of {positions['num_positions']}")
    table.add_row("they miss the model by", f"{positions['rms_miss_m']:.3g} m RMS")
    place = ", ".join(_number(v, "{:.2g}") for v in positions["place_stddev_m"])
    turn = positions["turn_stddev_deg"]
    table.add_row("± of the model's place", f"{place} m; its turn {turn:.2g} deg")


def _tilt(normal: list[float] | tuple[float, ...]) -> str:
    """The normal's slopes against the optical axis, which people can imagine."""
    x, y = (math.degrees(math.asin(value)) for value in normal[:2])
    return f"{x:+.3f}, {y:+.3f}"


def _millimetres(values: Iterable[float | None]) -> str:
    return ", ".join(_number(value, "{:.2f}", 1e3) for value in values)


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "-" if value is None else form.format(scale * value)
