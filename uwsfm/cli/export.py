"""What goes to other programs, and what comes from them."""

import textwrap
from pathlib import Path
from typing import Annotated, Literal

import typer

from uwsfm._base.signals import NOTHING_WRITTEN, interruptible
from uwsfm.errors import InputError


def export(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="The output of uwsfm reconstruct; for las and laz also a PLY file.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The folder or file to write.")
    ],
    to: Annotated[
        Literal["pinhole", "splatting", "refractive-colmap", "ply", "las", "laz"],
        typer.Option(
            help="The format to write. pinhole: a central COLMAP model for stock "
            "tools, without refraction. splatting: the same with the names that "
            "trainers of Gaussian splatting want, --images needed. refractive-colmap: "
            "the text format of Refractive COLMAP. ply: points, cameras and ports in "
            "one file. las, laz: the dense cloud, or the points if there is none."
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the images that were reconstructed, which pinhole and "
            "splatting warp by the depth. Default: no images are written.",
            show_default=False,
        ),
    ] = None,
    flat_names: Annotated[
        bool | None,
        typer.Option(
            "--flat-names/--folder-names",
            help="How images are named: left_0001.jpg or left/0001.jpg. Default: flat "
            "for splatting, with folders for pinhole.",
            show_default=False,
        ),
    ] = None,
    centered: Annotated[
        bool | None,
        typer.Option(
            "--centered/--not-centered",
            help="Whether the principal point is the middle of the image, which is "
            "some pixels wider for it. Default: centred.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a reconstruction for other programs."""
    pinholes = to in ("pinhole", "splatting")
    for option, given in (
        ("--images", images),
        ("--flat-names", flat_names),
        ("--centered", centered),
    ):
        if given is not None and not pinholes:
            raise InputError(f"{option}: --to {to} writes no images")
    if to == "splatting" and images is None:
        raise InputError(
            "--to splatting writes images for a trainer: give the folder that was "
            "reconstructed with --images"
        )
    if to in ("las", "laz"):
        _export_las(model, out, to)
        if model.is_dir():
            _note_verdict(model)
        return
    if model.is_file():
        raise InputError(f"{model} is a file: only --to las and laz take a PLY")
    if pinholes:
        flat = to == "splatting" if flat_names is None else flat_names
        _export_pinhole(model, out, images, flat, centered is not False)
    else:
        _export_whole(model, out, to)
    _note_verdict(model)
    typer.echo(f"wrote {out}")


def _note_verdict(folder: Path) -> None:
    """Files for other programs do not carry the verdict: print it once more."""
    from rich.markup import escape

    from uwsfm.cli.console import console
    from uwsfm.results.files import read_summary
    from uwsfm.results.verdict_summary import verdict_note

    for note in verdict_note(read_summary(folder) or {}):
        console.print(f"[yellow]note:[/yellow] {escape(note)}")


@interruptible()
def _export_whole(model: Path, out: Path, to: str) -> None:
    from uwsfm.export.refractive_colmap import export_refractive_colmap
    from uwsfm.export.scene_ply import export_scene_ply
    from uwsfm.results.files import read_model, unit_of_model

    found = read_model(model)
    if to == "refractive-colmap":
        export_refractive_colmap(found, out)
    else:
        export_scene_ply(found, out, unit=unit_of_model(model))


@interruptible()
def _export_las(source: Path, out: Path, suffix: str) -> None:
    from rich.markup import escape

    from uwsfm.cli.console import console
    from uwsfm.surface.commands import export_las
    from uwsfm.surface.source import find_source

    cloud = export_las(source, out, suffix)
    for warning in find_source(source).warnings():
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    typer.echo(f"wrote {out}: {len(cloud)} points")


def _export_pinhole(
    model: Path, out: Path, images: Path | None, flat_names: bool, centered: bool
) -> None:
    from uwsfm.cli.console import ProgressBars, console
    from uwsfm.cli.tables import pinhole_table

    with ProgressBars(NOTHING_WRITTEN) as progress:
        from uwsfm.export.pinhole_files import export_pinhole, pinhole_report
        from uwsfm.results.files import read_model

        found = export_pinhole(
            read_model(model),
            out,
            images,
            progress,
            flat_names=flat_names,
            centered=centered,
        )
    console.print(pinhole_table(pinhole_report(found)))


def init_from(source: Path, rig_file: Path) -> None:
    """`uwsfm init --from`."""
    from rich.markup import escape

    from uwsfm.cli.console import console
    from uwsfm.rig.file import dump_rig
    from uwsfm.sfm.from_colmap.refractive_colmap import (
        ports_missing,
        rig_of_refractive_colmap,
    )

    rig = rig_of_refractive_colmap(source)
    missing = ports_missing(rig)
    header = "The rig of a COLMAP model."
    if rig.baseline_m is not None:
        header += "\nThe cameras' placement is in the unit of that model: check it."
    if missing:
        header += "\n" + textwrap.fill(missing[0].upper() + missing[1:] + ".", 86)
    dump_rig(rig, rig_file, header)
    length = "" if rig.baseline_m is None else f", baseline {rig.baseline_m:g} m"
    folders = ", ".join(camera.images for camera in rig.cameras)
    typer.echo(f"wrote {rig_file}: image folders {folders}{length}; check them")
    if missing:
        console.print(f"[yellow]note:[/yellow] {escape(missing)}")
