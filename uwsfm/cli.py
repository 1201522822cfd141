"""The command line: a thin shell over functions that exist without it.

Heavy packages are imported inside the commands, so that `uwsfm --help` is instant.
"""

import io
import logging
import sys
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from uwsfm.cli_export import export, init_from
from uwsfm.errors import InputError, UwsfmError

if TYPE_CHECKING:
    from uwsfm.housing_pipeline import HousingResult

app = typer.Typer(
    name="uwsfm",
    help="Refractive underwater Structure-from-Motion for rigs behind flat ports.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
simulate_app = typer.Typer(
    help="Synthetic dives with known truth.", no_args_is_help=True
)
app.add_typer(simulate_app, name="simulate")
app.command()(export)

FAILED, WRONG_INPUT = 1, 2


class Refinable(str, Enum):
    """What --refine takes: the fields refine_... of `CalibrateOptions`."""

    WATER_INDEX = "water-index"
    FOCAL = "focal"
    PRINCIPAL_POINT = "principal-point"
    DISTORTION = "distortion"


RefineOption = Annotated[
    list[Refinable] | None,
    typer.Option(
        "--refine", help="Refine this too; may be repeated.", show_default=False
    ),
]
PriorOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KEY=VALUE",
        help="What is known: distance_stddev_m, normal_stddev_deg, center_stddev_m, "
        "water_index_stddev, focal_stddev (relative), principal_point_stddev_px, "
        "distortion_stddev; may be repeated.",
        show_default=False,
    ),
]


PositionsOption = Annotated[
    Path | None,
    typer.Option(
        help="Positions of the frames (navigation, GPS): CSV with the header "
        "frame,x,y,z,sx,sy,sz in metres, in a local right-handed frame.",
        show_default=False,
    ),
]
LeverArmOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="The antenna of the positions in the frame of the first camera, metres.",
        show_default=False,
    ),
]
LengthsOption = Annotated[
    Path | None,
    typer.Option(
        help="Scale bars and distances between frames: a YAML file, see the README.",
        show_default=False,
    ),
]


@app.callback()
def _global_options(
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show COLMAP's own log.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", is_eager=True)
    ] = False,
) -> None:
    if version:
        from uwsfm import __version__

        typer.echo(f"uwsfm {__version__}")
        raise typer.Exit
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
    rig: Annotated[Path, typer.Argument(help="The rig file, see uwsfm init.")],
    images: Annotated[
        Path, typer.Argument(help="Folder that holds one folder of images per camera.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    clahe: Annotated[
        bool, typer.Option(help="Raise the local contrast first: for turbid water.")
    ] = False,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of masks, IMAGE.png beside each image path."),
    ] = None,
    matching: Annotated[
        Literal["auto", "exhaustive", "sequential"],
        typer.Option(help="Which frames are compared; auto: by their number."),
    ] = "auto",
    matcher: Annotated[
        Literal["colmap", "paper"],
        typer.Option(help="paper: kd-trees and a tolerant fundamental matrix."),
    ] = "colmap",
    mapper: Annotated[
        Literal["pinhole", "refractive"],
        typer.Option(help="refractive: water rays in every step, not only the last."),
    ] = "pinhole",
    positions: PositionsOption = None,
    lever_arm: LeverArmOption = None,
    lengths: LengthsOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all random choices.")] = 0,
    threads: Annotated[int, typer.Option(min=-1, help="-1: all cores.")] = -1,
) -> None:
    """Reconstruct a dive: images and a rig file in, a metric model out.

    Run the same command again to resume a run that was stopped.
    """
    from uwsfm.console import ProgressBars
    from uwsfm.pipeline import reconstruct as run

    with ProgressBars() as progress:
        result = run(
            rig,
            images,
            out,
            clahe=clahe,
            masks=masks,
            matching=matching,
            matcher=matcher,
            mapper=mapper,
            positions=positions,
            lever_arm=_lever_arm(lever_arm),
            lengths=lengths,
            seed=seed,
            num_threads=threads,
            progress=progress,
        )
    _print_result(result.summary)
    typer.echo(f"results in {out}")


@app.command()
def calibrate(
    rig: Annotated[Path, typer.Argument(help="The rig file, see uwsfm init.")],
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IMAGES_OR_MODEL",
            help="Folder of images, one folder per camera; or a COLMAP model of them.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    strategy: Annotated[
        Literal["joint", "nested"],
        typer.Option(help="All at once, or the two loops of the 2011 paper."),
    ] = "joint",
    error: Annotated[
        Literal[
            "reprojection", "virtual_camera", "virtual_camera_tangential", "point_3d"
        ]
        | None,
        typer.Option(
            help="What is minimised; default: reprojection, nested: virtual_camera.",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        Literal["virtual", "paper", "pairs"],
        typer.Option(
            help="Pinholes fitted to the ports; or adjusted as in the paper, with "
            "1.333 f and radial distortion; or single stereo pairs, for normals only."
        ),
    ] = "virtual",
    refine: RefineOption = None,
    prior: PriorOption = None,
    matcher: Annotated[
        Literal["colmap", "paper"],
        typer.Option(help="paper: kd-trees and a tolerant fundamental matrix."),
    ] = "colmap",
    seed: Annotated[int, typer.Option(min=0, help="Of all random choices.")] = 0,
    threads: Annotated[int, typer.Option(min=-1, help="-1: all cores.")] = -1,
) -> None:
    """Calibrate the ports only: housing.yaml, and what the images tell of it."""
    from uwsfm.console import ProgressBars
    from uwsfm.housing_pipeline import calibrate_housing
    from uwsfm.sfm.options import MatchOptions, StartOptions

    front_end = StartOptions(
        matching=MatchOptions(matcher=matcher), seed=seed, num_threads=threads
    )
    with ProgressBars() as progress:
        result = calibrate_housing(
            rig,
            source,
            out,
            start=start,
            front_end=front_end,
            progress=progress,
            strategy=strategy,
            error=error,
            **_wanted(refine or ()),
            **_priors(prior or ()),
        )
    _print_housing(result)
    typer.echo(f"results in {out}")


@app.command()
def refine(
    model: Annotated[
        Path, typer.Argument(help="Folder of a COLMAP model of the raw images.")
    ],
    rig: Annotated[Path, typer.Argument(help="The rig file, see uwsfm init.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    images: Annotated[
        Path | None,
        typer.Option(help="Folder of the cameras' folders, for the points' colours."),
    ] = None,
    positions: PositionsOption = None,
    lever_arm: LeverArmOption = None,
    lengths: LengthsOption = None,
    database: Annotated[
        Path | None,
        typer.Option(help="COLMAP's database: more matches, frames that it lost."),
    ] = None,
    scene_distance: Annotated[
        float,
        typer.Option(
            metavar="METRES", help="Of one camera's scene, about: no baseline tells."
        ),
    ] = 1.0,
    also: RefineOption = None,
    prior: PriorOption = None,
) -> None:
    """Turn a COLMAP model that was made without refraction into the refractive one.

    Any model of the raw images: text or binary, of any version, with or without rigs,
    calibrated in the water or not; the lenses in air are those of the rig file.
    """
    from uwsfm.console import ProgressBars
    from uwsfm.refine_pipeline import refine_model as run

    with ProgressBars() as progress:
        result = run(
            model,
            rig,
            out,
            images=images,
            positions=positions,
            lever_arm=_lever_arm(lever_arm),
            lengths=lengths,
            database=database,
            scene_distance_m=scene_distance,
            progress=progress,
            **_wanted(also or ()),
            **_priors(prior or ()),
        )
    _print_result(result.summary)
    typer.echo(f"results in {out}")


def _lever_arm(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise InputError(f"--lever-arm {text}: write three numbers X,Y,Z in metres")
    return values


def _wanted(what: Iterable[Refinable]) -> dict[str, bool]:
    """--refine, as fields of `CalibrateOptions`."""
    return {f"refine_{item.value.replace('-', '_')}": True for item in what}


def _priors(texts: Iterable[str]) -> dict[str, float]:
    """KEY=VALUE, as fields of `CalibrateOptions`."""
    from uwsfm.calibration.problem import PRIORS

    found = {}
    for text in texts:
        key, _, value = text.partition("=")
        if key not in PRIORS:
            raise InputError(f"--prior {text}: the key is one of {', '.join(PRIORS)}")
        if key in found:
            raise InputError(f"--prior {text}: {key} is given twice")
        try:
            found[key] = float(value)
        except ValueError:
            raise InputError(
                f"--prior {text}: {value!r} is not a number; write KEY=VALUE"
            ) from None
    return found


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the results.")
    ] = Path("uwsfm-demo"),
) -> None:
    """Run the main job on the sample that comes with the package."""
    from uwsfm.console import ProgressBars, comparison_table, console
    from uwsfm.demo import run_demo

    with ProgressBars() as progress:
        result, comparison = run_demo(out, progress=progress)
    _print_result(result.summary)
    console.print(comparison_table(comparison))
    typer.echo(f"results in {out}: open points.ply in MeshLab, sparse/ in COLMAP")


@simulate_app.command("images")
def simulate_images(
    out: Annotated[Path, typer.Option("--out", "-o", help="A new or empty folder.")],
    preset: Annotated[
        str,
        typer.Option(
            help="sample: the one in datasets; small: quick; dome: behind domes; "
            "near: 0.3 m away, ports far off and tilted."
        ),
    ] = "sample",
    frames: Annotated[
        int | None, typer.Option(help="Only the first frames of the preset.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Another floor and noise; same rig and motion.")
    ] = None,
    clear_water: Annotated[
        bool, typer.Option("--clear-water", help="No attenuation, no veil.")
    ] = False,
) -> None:
    """Render stereo pairs through their ports, with a rig file and the truth."""
    from uwsfm.console import ProgressBars
    from uwsfm.simulate.commands import simulate_images as run

    with ProgressBars() as progress:
        run(
            out,
            preset=preset,
            num_frames=frames,
            seed=seed,
            clear_water=clear_water,
            progress=progress,
        )
    typer.echo(f"wrote {out}: try uwsfm reconstruct {out}/rig.yaml {out}/images")


@simulate_app.command("observations")
def simulate_observations(
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npz file.")],
    trajectory: Annotated[
        Literal["rich", "strip", "lawn-mower"], typer.Option(help="How the rig moves.")
    ] = "rich",
    frames: Annotated[int, typer.Option(help="Stereo pairs.")] = 15,
    altitude_m: Annotated[float, typer.Option(help="Mean height above ground.")] = 2.0,
    relief_m: Annotated[float, typer.Option(help="Its standard deviation.")] = 0.2,
    points: Annotated[int, typer.Option(help="Seen at least twice.")] = 800,
    noise_px: Annotated[float, typer.Option(help="Per image coordinate.")] = 0.5,
    outliers: Annotated[float, typer.Option(help="Share of the observations.")] = 0.0,
    distance_m: Annotated[float, typer.Option(help="Of both ports.")] = 0.02,
    thickness_m: Annotated[float, typer.Option(help="Of both glasses.")] = 0.005,
    focal_px: Annotated[float, typer.Option(help="Of both cameras.")] = 1000.0,
    seed: Annotated[int, typer.Option(help="Of floor, points and noise.")] = 0,
) -> None:
    """Simulate what a stereo rig observes, with ground truth, as arrays."""
    from uwsfm.simulate.commands import simulate_observations as run

    simulated = run(
        out,
        trajectory=trajectory,
        num_frames=frames,
        altitude=altitude_m,
        relief=relief_m,
        num_points=points,
        noise_px=noise_px,
        outlier_ratio=outliers,
        distance=distance_m,
        thickness=thickness_m,
        focal_px=focal_px,
        seed=seed,
    )
    scene = simulated.scene
    typer.echo(
        f"wrote {out}: {scene.num_observations} observations of {scene.num_points} "
        f"points in {scene.num_frames} frames"
    )


def _print_result(summary: dict) -> None:
    from rich.markup import escape

    from uwsfm.console import console, housing_table, result_table, timings_table

    console.print(result_table(summary))
    console.print(housing_table(summary))
    for warning in summary["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    console.print(timings_table(summary["timings_s"]))


def _print_housing(result: "HousingResult") -> None:
    from rich.markup import escape

    from uwsfm.console import budget_table, calibration_table, console, housing_table

    console.print(calibration_table(result.summary))
    console.print(housing_table(result.summary))
    console.print(budget_table(result.summary))
    for warning in result.summary["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")


def main() -> None:
    """Run the command line; every error ends in one sentence and a non-zero code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without "±" shows "?"
            stream.reconfigure(errors="replace")
    try:
        app()
    except InputError as error:
        _fail(str(error), WRONG_INPUT)
    except UwsfmError as error:
        _fail(str(error), FAILED)
    except OSError as error:
        _fail(f"{error.strerror or error}: {error.filename or ''}".rstrip(": "), FAILED)
    except MemoryError:
        _fail("out of memory", FAILED)


def _fail(message: str, code: int) -> None:
    typer.echo(f"error: {message}", err=True)
    sys.exit(code)
