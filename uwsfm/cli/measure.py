"""`uwsfm measure`."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwsfm._base.signals import interruptible
from uwsfm.errors import InputError

if TYPE_CHECKING:
    from uwsfm.measuring.picks import Pick

_PICK = (
    "a point id (1234), a place in the cloud (0.1,-0.4,1.9), or pixels "
    "(left/01.png:412.5,300+right/01.png:380,311)"
)


@interruptible()
def measure(
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="The output of uwsfm reconstruct.")
    ],
    measurements: Annotated[
        Path | None,
        typer.Argument(
            help="A YAML file of what to measure: distances, polylines, areas, "
            "heights, angles and scale bars, see docs/howto/measuring.md. Default: one "
            "distance, --from and --to.",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="PICK",
            help=f"One end of a distance: {_PICK}. Default: what the file names.",
            show_default=False,
        ),
    ] = None,
    end: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="PICK",
            help="The other end of the distance, written as the first. Default: what "
            "the file names.",
            show_default=False,
        ),
    ] = None,
    known: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Known length of the distance, if it is a scale bar that is to be "
            "checked. Default: it is not known.",
            show_default=False,
        ),
    ] = None,
    click_stddev: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Standard deviation of clicked pixels, per coordinate. Default: 1.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="The JSON file to write. Default: no file, only the table.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Measure in a result: lengths, areas, angles, with their standard deviations."""
    from rich.markup import escape

    from uwsfm.cli.console import console
    from uwsfm.measuring.measure import measure as run
    from uwsfm.measuring.table import measurement_table

    what: Path | dict[str, Any]
    if measurements is not None:
        if start or end or known is not None or click_stddev is not None:
            raise InputError(
                f"{measurements} says what to measure: --from, --to, --known and "
                "--click-stddev are for a single distance"
            )
        what = measurements
    else:
        what = _single(start, end, known, click_stddev)
    try:
        found = run(out, what, report)
    except InputError as error:
        raise InputError(_as_typed(str(error), measurements)) from None
    console.print(measurement_table(found))
    for warning in found.warnings:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    if report is not None:
        typer.echo(f"wrote {report}")


def _single(
    start: str | None, end: str | None, known: float | None, click_stddev: float | None
) -> dict[str, Any]:
    """The measurements.yaml of one distance."""
    if not start or not end:
        raise InputError(
            "name what to measure: a measurements.yaml, or --from and --to"
        )
    picks = [_pick("--from", start), _pick("--to", end)]
    if picks[0] == picks[1]:
        raise InputError(f"--from and --to: both ends are the same {picks[0]}")
    for option, value in (("--known", known), ("--click-stddev", click_stddev)):
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"{option} must be positive and finite, got {value:g}")
    item: dict[str, Any] = {"name": "distance", "ends": picks}
    content: dict[str, Any] = {"version": 1}
    if click_stddev is not None:
        content["click_stddev_px"] = click_stddev
    if known is None:
        return {**content, "distances": [item]}
    return {**content, "scale_bars": [{**item, "length_m": known}]}


def _pick(option: str, text: str) -> "Pick":
    from uwsfm.measuring.picks import IN_YAML, parsed_pick

    try:
        return parsed_pick(text)
    except ValueError as error:
        raise InputError(f"{option} {str(error).removesuffix(IN_YAML)}") from None


_KEY = re.compile(r"^(?:distances|scale_bars)\[0\](?:\.ends\[([01])\]| \(distance\))")


def _as_typed(text: str, measurements: Path | None) -> str:
    """A message with the options that were typed, where there is no file with keys."""
    if measurements is not None:
        return text
    return _KEY.sub(
        lambda found: ("--from", "--to")[int(found[1])] if found[1] else "--from, --to",
        text,
    )
