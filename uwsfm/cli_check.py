"""`uwsfm check`."""

from pathlib import Path
from typing import Annotated

import typer


def check(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="The output of uwsfm reconstruct, refine or demo."
        ),
    ],
) -> None:
    """Look for the mistake that explains a result that does not fit.

    Each mistake that people make in a rig file or with their images is undone and the
    result adjusted again: what explains the images clearly better is named.
    """
    from uwsfm._signals import BEGINS_AGAIN
    from uwsfm.console import ProgressBars

    with ProgressBars(BEGINS_AGAIN) as progress:
        from uwsfm.check import CHECK, check_result

        found = check_result(out, progress)
    from uwsfm.console import console, explanations_table

    if found.verdict is not None:
        console.print(f"verdict: {found.verdict}", markup=False)
    for reason in found.reasons:
        console.print(reason["text"], markup=False)
    if found.explanations:
        console.print(explanations_table(one.to_json() for one in found.explanations))
    else:
        console.print("No mistake explains the images better than the rig as given.")
    typer.echo(f"written: {out / CHECK}")
