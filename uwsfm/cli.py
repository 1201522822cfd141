"""The command line: a thin shell over functions that exist without it.

Heavy packages are imported inside the commands, so that `uwsfm --help` is instant.
"""

import io
import logging
import sys
import traceback
from pathlib import Path
from typing import Annotated, Literal

import typer

from uwsfm import _signals
from uwsfm.cli_batch import batch
from uwsfm.cli_check import check
from uwsfm.cli_dense import dense
from uwsfm.cli_export import export, init_from
from uwsfm.cli_measure import measure
from uwsfm.cli_options import (
    LengthsOption,
    LeverArmOption,
    MapperOption,
    MatcherOption,
    MaxFeaturesOption,
    PositionsOption,
    PriorOption,
    RefineOption,
    ReportOption,
    ResultsOption,
    RigArgument,
    SceneDistanceOption,
    SchedulerOption,
    SeedOption,
    ThreadsOption,
    lever_arm_of,
    priors_of,
    wanted_of,
)
from uwsfm.cli_results import finish, print_housing, print_result
from uwsfm.cli_simulate import simulate_app
from uwsfm.cli_surface import clean, color, map_, mesh
from uwsfm.cli_view import report, view
from uwsfm.errors import InputError, UwsfmError

app = typer.Typer(
    name="uwsfm",
    help="Refractive underwater Structure-from-Motion behind flat and dome ports.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(simulate_app, name="simulate")
app.command()(export)
app.command()(batch)
app.command()(check)
app.command()(dense)
app.command()(measure)
app.command()(clean)
app.command()(color)
app.command()(mesh)
app.command("map")(map_)
app.command()(report)
app.command()(view)

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
        bool, typer.Option("--verbose", "-v", help="Show what uwsfm.log receives, too.")
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
            help="Print the version.",
            is_eager=True,
            callback=_print_version,
        ),
    ] = False,
) -> None:
    _debug.update(shown=debug)
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(message)s"
    )


@app.command()
def init(
    rig_file: Annotated[Path, typer.Argument(help="File to write.")] = Path("rig.yaml"),
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="cameras.txt of Refractive COLMAP, or its text model: lenses, ports "
            "and placement from there.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a commented rig file to fill in."""
    from uwsfm._files import replaced_file
    from uwsfm.rig_file import template

    if rig_file.exists():
        raise InputError(f"{rig_file} exists already: name another file")
    if source is not None:
        init_from(source, rig_file)
        return
    with replaced_file(rig_file) as partial:
        partial.write_text(template(), encoding="utf-8")
    typer.echo(f"wrote {rig_file}: fill in your rig, then run uwsfm reconstruct")


@app.command()
def reconstruct(
    rig: RigArgument,
    images: Annotated[
        Path, typer.Argument(help="Folder that holds one folder of images per camera.")
    ],
    out: ResultsOption,
    clahe: Annotated[
        bool, typer.Option(help="Raise the local contrast first: for turbid water.")
    ] = False,
    max_features: MaxFeaturesOption = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of masks, IMAGE.png beside each image path."),
    ] = None,
    matching: Annotated[
        Literal["auto", "exhaustive", "sequential"],
        typer.Option(
            help="Which frames are compared; sequential: neighbours and frames that "
            "look alike; auto: exhaustive up to 60 frames."
        ),
    ] = "auto",
    matcher: MatcherOption = "colmap",
    mapper: MapperOption = "refractive",
    positions: PositionsOption = None,
    lever_arm: LeverArmOption = None,
    lengths: LengthsOption = None,
    scene_distance: SceneDistanceOption = None,
    also: RefineOption = None,
    prior: PriorOption = None,
    seed: SeedOption = 0,
    threads: ThreadsOption = -1,
    submap_frames: Annotated[
        int | None,
        typer.Option(
            min=10,
            help="Longer surveys are mapped in parts of at most so many frames; "
            "default: 200 beyond 400.",
            show_default=False,
        ),
    ] = None,
    scheduler: SchedulerOption = "local",
    report: ReportOption = True,
) -> None:
    """Reconstruct a dive: images and a rig file in, a metric model out.

    Run the same command again to resume a run that was stopped.
    """
    from uwsfm.console import ProgressBars

    with ProgressBars() as progress:
        from uwsfm.pipeline import reconstruct as run

        result = run(
            rig,
            images,
            out,
            clahe=clahe,
            max_features=max_features,
            masks=masks,
            matching=matching,
            matcher=matcher,
            mapper=mapper,
            positions=positions,
            lever_arm=lever_arm_of(lever_arm),
            lengths=lengths,
            scene_distance_m=scene_distance,
            seed=seed,
            num_threads=threads,
            submap_frames=submap_frames,
            scheduler=scheduler,
            report=report,
            progress=progress,
            **wanted_of(also or ()),
            **priors_of(prior or ()),
        )
    print_result(result.summary)
    finish(result.summary, f"results in {out}")


@app.command()
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
    strategy: Annotated[
        Literal["joint", "nested"],
        typer.Option(
            help="joint: one adjustment of everything. nested: the two nested loops of "
            "the 2011 paper."
        ),
    ] = "joint",
    error: Annotated[
        Literal[
            "reprojection", "virtual_camera", "virtual_camera_tangential", "point_3d"
        ]
        | None,
        typer.Option(
            help="Error that is minimised. Default: reprojection; with --strategy "
            "nested: virtual_camera.",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        Literal["virtual", "paper", "pairs"],
        typer.Option(
            help="How the adjustment starts. virtual: from pinholes fitted to the "
            "ports. paper: from pinholes of 1.333 f with radial distortion, adjusted "
            "as in the paper. pairs: from single stereo pairs, which determine normals "
            "only."
        ),
    ] = "virtual",
    refine: RefineOption = None,
    prior: PriorOption = None,
    positions: PositionsOption = None,
    lever_arm: LeverArmOption = None,
    lengths: LengthsOption = None,
    matcher: MatcherOption = "colmap",
    fundamental_max_error: Annotated[
        float | None,
        typer.Option(
            metavar="PIXELS",
            help="Tolerance of the fundamental matrix of --matcher paper, in raw "
            "pixels; default: a hundredth of the image's longer side.",
            show_default=False,
        ),
    ] = None,
    mapper: MapperOption = "pinhole",
    max_features: MaxFeaturesOption = None,
    scene_distance: SceneDistanceOption = None,
    seed: SeedOption = 0,
    threads: ThreadsOption = -1,
) -> None:
    """Calibrate the housings only, from images or a COLMAP model, without a cloud.

    Writes housing.yaml with the estimated ports and placement of the cameras, and
    calibration.json with their standard deviations, the error budget and the verdict.
    """
    from uwsfm.console import ProgressBars

    with ProgressBars() as progress:
        from uwsfm.housing_pipeline import calibrate_housing
        from uwsfm.sfm.options import FeatureOptions, MatchOptions, StartOptions

        matching = MatchOptions(
            matcher=matcher, fundamental_max_error_px=fundamental_max_error
        )
        front_end = StartOptions(
            features=FeatureOptions(max_num_features=max_features),
            matching=matching,
            mapper=mapper,
            seed=seed,
            num_threads=threads,
        )
        result = calibrate_housing(
            rig,
            source,
            out,
            start=start,
            positions=positions,
            lever_arm=lever_arm_of(lever_arm),
            lengths=lengths,
            scene_distance_m=scene_distance,
            front_end=front_end,
            progress=progress,
            strategy=strategy,
            error=error,
            **wanted_of(refine or ()),
            **priors_of(prior or ()),
        )
    print_housing(result)
    finish(result.summary, f"results in {out}")


@app.command()
def refine(
    model: Annotated[
        Path, typer.Argument(help="Folder of a COLMAP model of the raw images.")
    ],
    rig: RigArgument,
    out: ResultsOption,
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of the cameras' folders, for the points' colours."),
    ] = None,
    positions: PositionsOption = None,
    lever_arm: LeverArmOption = None,
    lengths: LengthsOption = None,
    database: Annotated[
        Path | None,
        typer.Option(
            help="COLMAP's database: more matches, frames that the model lost, and "
            "points where it has poses only."
        ),
    ] = None,
    scene_distance: SceneDistanceOption = None,
    also: RefineOption = None,
    prior: PriorOption = None,
    report: ReportOption = True,
) -> None:
    """Turn a COLMAP model that was made without refraction into the refractive one.

    Any model of the raw images: text or binary, of any version, with or without rigs,
    calibrated in the water or not; the lenses in air are those of the rig file.
    """
    from uwsfm.console import ProgressBars

    with ProgressBars(_signals.BEGINS_AGAIN) as progress:
        from uwsfm.refine_pipeline import refine_model as run

        result = run(
            model,
            rig,
            out,
            images=images,
            positions=positions,
            lever_arm=lever_arm_of(lever_arm),
            lengths=lengths,
            database=database,
            scene_distance_m=scene_distance,
            report=report,
            progress=progress,
            **wanted_of(also or ()),
            **priors_of(prior or ()),
        )
    print_result(result.summary)
    finish(result.summary, f"results in {out}")


@app.command()
def demo(
    out: ResultsOption = Path("uwsfm-demo"),
    mapper: MapperOption = "refractive",
) -> None:
    """Run the main job on the sample that comes with the package."""
    from uwsfm.console import ProgressBars, console
    from uwsfm.result_tables import comparison_table

    with ProgressBars() as progress:
        from uwsfm.demo import run_demo

        result, comparison = run_demo(out, mapper, progress)
    print_result(result.summary)
    console.print(comparison_table(comparison))
    where = f"results in {out}: open report.html, or points.ply in MeshLab"
    finish(result.summary, where)


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
    from uwsfm._last_words import is_out_of_memory, unexpected

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
