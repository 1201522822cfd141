"""`uwsfm report` and `uwsfm view`."""

from pathlib import Path
from typing import Annotated

import typer

from uwsfm._base.signals import interruptible

OutArgument = Annotated[
    Path, typer.Argument(metavar="OUT", help="The result folder of a run.")
]


@interruptible()
def report(out: OutArgument) -> None:
    """Write report.html of a result folder again, with what has come since."""
    from uwsfm.report.files import write_report

    typer.echo(f"wrote {write_report(out)}")


@interruptible()
def view(
    out: OutArgument,
    rerun: Annotated[
        bool,
        typer.Option(
            "--rerun",
            help="Write OUT/view.rrd, a recording for the Rerun viewer, and open it.",
        ),
    ] = False,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder where the images are now, with --rerun. Default: where they "
            "were.",
            show_default=False,
        ),
    ] = None,
    open_: Annotated[
        bool,
        typer.Option(
            "--open/--no-open", help="Open the page or the recording once it is there."
        ),
    ] = True,
) -> None:
    """Open the 3-D view of a report in the browser, or a recording in Rerun."""
    from uwsfm.errors import InputError

    if rerun:
        from uwsfm.report.recording import show_recording, write_recording

        path = write_recording(out, images)
        typer.echo(f"wrote {path}")
        if open_:
            show_recording(path)
        return
    if images is not None:
        raise InputError("--images has no effect without --rerun")
    _open_page(out, open_)


def _open_page(out: Path, open_: bool) -> None:
    import webbrowser

    from uwsfm.report.files import PAGE, write_report

    page = out / PAGE
    if not page.is_file():
        page = write_report(out)
    shown = open_ and webbrowser.open(f"{page.resolve().as_uri()}#view")
    typer.echo(f"opened {page}" if shown else f"the report is {page}: open it yourself")
