"""`uwsfm check`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwsfm.cli.results import finish

if TYPE_CHECKING:
    from rich.table import Table

    from uwsfm.trust.explanation import Explanation


def check(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="The output of uwsfm reconstruct, refine or demo."
        ),
    ],
    halves: Annotated[
        bool,
        typer.Option(
            "--halves",
            help="Cross-validate instead of looking for a mistake: adjust disjoint "
            "halves of the frames, each alone, and compare them. Where they differ by "
            "significantly more than predicted, the result's standard deviations are "
            "enlarged.",
        ),
    ] = False,
) -> None:
    """Look for the mistake that explains a result, whatever its verdict is.

    Each mistake that people make in a rig file or with their images is undone and the
    result is adjusted again. A mistake without which the model explains the images
    clearly better is named, with its evidence and its remedy. The exit code is that of
    the verdict: 3 if the result does not fit.
    """
    if halves:
        _check_halves(out)
        return
    from uwsfm._base.signals import BEGINS_AGAIN
    from uwsfm.cli.console import ProgressBars

    with ProgressBars(BEGINS_AGAIN) as progress:
        from uwsfm.jobs.check import CHECK, check_result

        found = check_result(out, progress)
    from uwsfm.cli.console import console, print_verdict
    from uwsfm.results.files import read_summary

    summary = read_summary(out) or {}
    print_verdict(_without_causes(summary))
    if found.explanations:
        console.print(explanations_table(found.explanations))
    else:
        console.print("No mistake explains the images better than the rig as given.")
    finish(summary, f"written: {out / CHECK}")


def _check_halves(out: Path) -> None:
    from uwsfm._base.signals import BEGINS_AGAIN
    from uwsfm.cli.console import ProgressBars, console, print_verdict
    from uwsfm.results.files import SUMMARY, read_summary

    with ProgressBars(BEGINS_AGAIN) as progress:
        from uwsfm.jobs.check_halves import check_halves

        found = check_halves(out, progress)
    summary = read_summary(out) or {}
    print_verdict(_without_causes(summary))
    console.print(halves_table(found))
    for sentence in found["sentences"]:
        console.print(sentence, markup=False)
    finish(summary, f"written: {out / SUMMARY}")


def _without_causes(summary: dict[str, Any]) -> dict[str, Any]:
    """Those of the run: what this command finds stands in their place."""
    return {key: value for key, value in summary.items() if key != "explanations"}


def explanations_table(explanations: Iterable[Explanation]) -> Table:
    """Mistakes that explain the images, each with its evidence."""
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title="Error (px), RMS of the best 90 % of a sample of the observations",
        title_justify="left",
    )
    table.add_column("mistake", no_wrap=True)
    table.add_column("as given", justify="right", no_wrap=True)
    table.add_column("without it", justify="right", no_wrap=True)
    table.add_column("evidence and remedy")
    for one in explanations:
        before, after = f"{one.rms_before_px:.2f}", f"{one.rms_after_px:.2f}"
        table.add_row(one.code.replace("_", " "), before, after, Text(one.text))
    return table


def halves_table(cross_validation: dict[str, Any]) -> Table:
    """How far the halves of the frames differ, over what they predict."""
    from rich.table import Table

    from uwsfm.trust.halves_reason import NAMES

    table = Table(
        title="Halves of the frames: difference over prediction (1 is right)",
        title_justify="left",
    )
    table.add_column("numbers")
    splits = cross_validation["splits"]
    for split in splits:
        table.add_column(split["name"], justify="right", no_wrap=True)
    table.add_column("enlarged by", justify="right", no_wrap=True)
    rows: dict[str, list[str]] = {}
    for k, split in enumerate(splits):
        for row in split["agreements"]:
            cells = rows.setdefault(row["group"], len(splits) * ["-"])
            cells[k] = f"{row['ratio']:.2f} (p = {row['p_value']:.2g})"
    for group, cells in rows.items():
        factor = cross_validation["enlarged"].get(group)
        table.add_row(NAMES[group], *cells, "" if factor is None else f"{factor:.1f}")
    return table
