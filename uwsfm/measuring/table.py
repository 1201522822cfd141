"""Measurements for the terminal."""

from __future__ import annotations

import math

from rich.markup import escape
from rich.table import Table

from uwsfm.measuring.measure import Measurement, MeasureResult, bar_check
from uwsfm.measuring.spots import Spot


def measurement_table(result: MeasureResult) -> Table:
    """Name, value, standard deviation, and what there is to say."""
    arbitrary = result.unit != "metre"
    title = "measured" + (" (scale arbitrary)" if arbitrary else "")
    table = Table(title=title, title_justify="left")
    for column in ("", "kind"):
        table.add_column(column)
    table.add_column("value ± in all", justify="right")
    table.add_column("± images", justify="right")
    table.add_column("")
    for item in result.measurements:
        table.add_row(
            escape(item.task.name),
            item.task.kind,
            *_number(item, arbitrary),
            escape("; ".join(_remarks(item, arbitrary))),
        )
    bars = result.scale_bars
    if bars is not None and bars["num_bars"] > 1 or bars is not None and arbitrary:
        factor = f"{bars['known_over_measured']:.5f} ± {bars['stddev']:.5f}"
        table.add_row("known / measured", "scale bars", factor, "", bars["verdict"])
    return table


def _number(item: Measurement, arbitrary: bool) -> tuple[str, str]:
    """The value with its deviation in all, and the deviation from the images."""
    if item.value is None or item.stddev_in_all is None or item.stddev is None:
        return "not determined", ""
    scale, unit = 1.0, ""
    if item.task.kind == "angle":
        unit = " deg"
    elif not arbitrary:
        scale, unit = _small(item.value, item.task.kind == "area")
    number = rounded(scale * item.value, scale * item.stddev_in_all)
    return f"{number}{unit}", rounded(0.0, scale * item.stddev).split()[-1]


def _small(value: float, is_area: bool) -> tuple[float, str]:
    """Factor and unit that a length or an area is read in."""
    if is_area:
        return (1e4, " cm2") if value < 1.0 else (1.0, " m2")
    return (1e3, " mm") if value < 1.0 else (1.0, " m")


def rounded(value: float, stddev: float) -> str:
    """Both to two digits of the standard deviation."""
    digits = 6
    if stddev > 0.0:
        digits = max(0, 1 - math.floor(math.log10(stddev)))
    return f"{value:.{digits}f} ± {stddev:.{digits}f}"


def _remarks(item: Measurement, arbitrary: bool) -> list[str]:
    found = []
    if item.task.length_m is not None:
        check = bar_check(item, arbitrary)
        text = f"known {item.task.length_m:g} m"
        if "ratio" in check:
            text += (
                f", off by {1e3 * check['deviation_m']:+.3f} mm, "
                f"{check['ratio']:+.1f} std. dev."
            )
        hint = f" ({check['hint']})" if check.get("hint") else ""
        found.append(f"{text}: {check['verdict']}{hint}")
    if item.flatness is not None and item.task.kind == "area":
        rms = math.sqrt(float((item.flatness**2).mean()))
        off = f"{rms:.2g}" if arbitrary else f"{1e3 * rms:.2g} mm"
        found.append(f"corners {off} RMS off their plane")
    found += dict.fromkeys(filter(None, (_how(s, arbitrary) for s in item.spots)))
    return found + list(item.notes)


def _how(spot: Spot, arbitrary: bool) -> str:
    """How a spot was placed; empty where its pick says it all."""
    if spot.moved_by is not None:
        scale, unit = (1.0, "") if arbitrary else _small(spot.moved_by, False)
        place, _, rest = spot.how.partition("; ")
        away = f"{place}, {scale * spot.moved_by:.2g}{unit} from {spot.pick}"
        return f"{away}; {rest}" if rest else away
    if spot.how.startswith("clicked in one"):
        return spot.how
    return ""
