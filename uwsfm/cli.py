"""The command line: a thin shell over functions that exist without it.

Heavy packages are imported inside the commands, so that `uwsfm --help` is instant.
"""

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from uwsfm.errors import InputError, UwsfmError

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

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130


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
) -> None:
    """Write a commented rig file to fill in."""
    from uwsfm._files import replaced_file
    from uwsfm.rig_file import template

    if rig_file.exists():
        raise InputError(f"{rig_file} exists already: name another file")
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
        str, typer.Option(help="exhaustive, sequential, or auto by frame count.")
    ] = "auto",
    seed: Annotated[int, typer.Option(help="Of all random choices.")] = 0,
    threads: Annotated[int, typer.Option(help="-1: all cores.")] = -1,
) -> None:
    """Reconstruct a dive: images and a rig file in, a metric model out.

    Run the same command again to resume a run that was stopped.
    """
    from uwsfm.console import ProgressBars
    from uwsfm.reconstruct import reconstruct as run

    with ProgressBars() as progress:
        result = run(
            rig,
            images,
            out,
            clahe=clahe,
            masks=masks,
            matching=matching,
            seed=seed,
            num_threads=threads,
            progress=progress,
        )
    _print_result(result.summary)
    typer.echo(f"results in {out}")


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


def _print_result(summary: dict) -> None:
    from uwsfm.console import console, housing_table, result_table, timings_table

    console.print(result_table(summary))
    console.print(housing_table(summary))
    for warning in summary["warnings"]:
        console.print(f"[yellow]note:[/yellow] {warning}")
    console.print(timings_table(summary["timings_s"]))


def main() -> None:
    """Run the command line; every error ends in one sentence and a non-zero code."""
    try:
        app()
    except InputError as error:
        _fail(str(error), WRONG_INPUT)
    except UwsfmError as error:
        _fail(str(error), FAILED)
    except (OSError, MemoryError) as error:
        _fail(f"{type(error).__name__}: {error}", FAILED)
    except KeyboardInterrupt:
        _fail("interrupted; the same command resumes the run", INTERRUPTED)


def _fail(message: str, code: int) -> None:
    typer.echo(f"error: {message}", err=True)
    sys.exit(code)
