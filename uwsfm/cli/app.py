"""The command line: a thin shell over functions that exist without it.

Heavy packages are imported inside the commands, so that `uwsfm --help` is instant.
"""

import io
import logging
import sys
import traceback
from pathlib import Path
from typing import Annotated

import typer

from uwsfm._base import signals as _signals
from uwsfm.cli.batch import batch
from uwsfm.cli.check import check
from uwsfm.cli.dense import dense
from uwsfm.cli.export import export, init_from
from uwsfm.cli.measure import measure
from uwsfm.cli.options import MapperOption, ResultsOption, RigArgument, takes
from uwsfm.cli.results import finish, print_housing, print_result
from uwsfm.cli.simulate import simulate_app
from uwsfm.cli.surface import clean, color, map_, mesh
from uwsfm.cli.view import report, view
from uwsfm.errors import InputError, UwsfmError
from uwsfm.options.jobs import (
    CalibrateHousingOptions,
    ReconstructOptions,
    RefineOptions,
)
from uwsfm.sfm.options import StartOptions

app = typer.Typer(
    name="uwsfm",
    help="Refractive underwater Structure-from-Motion behind flat and dome ports.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
START, INSPECT, EXPORT, RESEARCH = (
    "Start here",
    "Inspect and measure",
    "Export",
    "Research",
)
"""The groups of the commands in the help, in their order."""
FAILED, WRONG_INPUT = 1, 2
_debug = {"shown": False}
"""Whether tracebacks are shown: `main` needs it after the options are gone."""


def _print_version(wanted: bool) -> None:
    """Its own callback: that of the group runs only once a command is known."""
    if wanted:
        from uwsfm import __version__

        typer.echo(f"uwsfm {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", help="Show on the terminal what uwsfm.log receives."
        ),
    ] = False,
    debug: Annotated[
        bool,
        typer.Option("--debug", help="Show where in the program an error comes from."),
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            "-V",
            help="Print the version of uwsfm, and end.",
            is_eager=True,
            callback=_print_version,
        ),
    ] = False,
) -> None:
    _debug.update(shown=debug)
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(message)s"
    )


@app.command(rich_help_panel=START)
def init(
    rig_file: Annotated[Path, typer.Argument(help="The rig file to write.")] = Path(
        "rig.yaml"
    ),
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Where lenses, ports and placement are copied from: cameras.txt of "
            "Refractive COLMAP, or its text model. Default: a commented template.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a commented rig file to fill in."""
    from uwsfm._base.files import replaced_file
    from uwsfm.rig.file import template

    if rig_file.exists():
        raise InputError(f"{rig_file} exists already: name another file")
    if source is not None:
        init_from(source, rig_file)
        return
    with replaced_file(rig_file) as partial:
        partial.write_text(template(), encoding="utf-8")
    typer.echo(f"wrote {rig_file}: fill in your rig, then run uwsfm reconstruct")


@app.command(rich_help_panel=START)
def demo(
    out: ResultsOption = Path("uwsfm-demo"),
    mapper: MapperOption = StartOptions.mapper,
) -> None:
    """Run the main job on the sample that comes with the package."""
    from uwsfm.cli.console import ProgressBars, console
    from uwsfm.cli.tables import comparison_table

    with ProgressBars() as progress:
        from uwsfm.jobs.demo import run_demo

        result, comparison = run_demo(out, mapper, progress)
    print_result(result.summary)
    console.print(comparison_table(comparison))
    where = f"results in {out}: open report.html, or points.ply in MeshLab"
    finish(result.summary, where)


@app.command(rich_help_panel=START)
@takes(ReconstructOptions)
def reconstruct(
    rig: RigArgument,
    images: Annotated[
        Path, typer.Argument(help="Folder that holds one folder of images per camera.")
    ],
    out: ResultsOption,
    options: ReconstructOptions,
) -> None:
    """Reconstruct a dive: images and a rig file in, a metric model out.

    Run the same command again to resume a run that was stopped.
    """
    from uwsfm.cli.console import ProgressBars

    with ProgressBars() as progress:
        from uwsfm.jobs.reconstruct import reconstruct as run

        result = run(rig, images, out, options, progress=progress)
    print_result(result.summary)
    finish(result.summary, f"results in {out}")


@app.command(rich_help_panel=START)
@takes(RefineOptions)
def refine(
    model: Annotated[
        Path, typer.Argument(help="Folder of a COLMAP model of the raw images.")
    ],
    rig: RigArgument,
    out: ResultsOption,
    options: RefineOptions,
) -> None:
    """Turn a COLMAP model that was made without refraction into the refractive one.

    Any model of the raw images: text or binary, of any version, with or without rigs,
    calibrated in the water or not; the lenses in air are those of the rig file.
    """
    from uwsfm.cli.console import ProgressBars

    with ProgressBars(_signals.BEGINS_AGAIN) as progress:
        from uwsfm.jobs.refine_model import refine_model as run

        result = run(model, rig, out, options, progress=progress)
    print_result(result.summary)
    finish(result.summary, f"results in {out}")


@app.command(rich_help_panel=START)
@takes(CalibrateHousingOptions)
def calibrate(
    rig: RigArgument,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IMAGES_OR_MODEL",
            help="Folder of images, one folder per camera; or a COLMAP model of them.",
        ),
    ],
    out: ResultsOption,
    options: CalibrateHousingOptions,
) -> None:
    """Calibrate the housings only, from images or a COLMAP model, without a cloud.

    Writes housing.yaml with the estimated ports and placement of the cameras, and
    calibration.json with their standard deviations, the error budget and the verdict.
    """
    from uwsfm.cli.console import ProgressBars

    with ProgressBars() as progress:
        from uwsfm.jobs.calibrate_housing import calibrate_housing

        result = calibrate_housing(rig, source, out, options, progress=progress)
    print_housing(result)
    finish(result.summary, f"results in {out}")


app.command(rich_help_panel=START)(batch)
for command in (check, measure, view, report, dense, clean, color):
    app.command(rich_help_panel=INSPECT)(command)
app.command(rich_help_panel=EXPORT)(mesh)
app.command("map", rich_help_panel=EXPORT)(map_)
app.command(rich_help_panel=EXPORT)(export)
app.add_typer(simulate_app, name="simulate", rich_help_panel=RESEARCH)


def main() -> None:
    """Run the command line; every error ends in one sentence and a non-zero code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without "±" shows "?"
            stream.reconfigure(errors="replace")
    try:
        app()
    except SystemExit:
        if _signals.received.is_set():
            sys.exit(_signals.EXIT_CODE)
        raise
    except Exception as error:
        if _debug["shown"]:
            traceback.print_exception(error)
        message, code = _words(error)
        typer.echo(f"error: {message}", err=True)
        sys.exit(code)


def _words(error: Exception) -> tuple[str, int]:
    """One sentence on an error, and the exit code."""
    from uwsfm._base.last_words import is_out_of_memory, unexpected

    if isinstance(error, InputError):
        return str(error), WRONG_INPUT
    if is_out_of_memory(error):
        return (
            "out of memory: give uwsfm more, or it less to do (smaller images, fewer "
            "--threads, --submap-frames)",
            FAILED,
        )
    if isinstance(error, UwsfmError):
        return str(error), FAILED
    if isinstance(error, OSError):
        text = f"{error.strerror or error}: {error.filename or ''}"
        return text.rstrip(": "), FAILED
    from uwsfm import __version__

    return unexpected(error, __version__), FAILED
