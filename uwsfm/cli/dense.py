"""`uwsfm dense`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from uwsfm.cli.options import ImagesOption, ThreadsOption

if TYPE_CHECKING:
    from rich.table import Table


def dense(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", help="The output of uwsfm reconstruct or uwsfm refine."
        ),
    ],
    images: ImagesOption = None,
    voxel: Annotated[
        float | None,
        typer.Option(
            help="Side of the voxels that points are merged in, in the unit of the "
            "model. Default: the footprint of a pixel.",
            show_default=False,
        ),
    ] = None,
    min_views: Annotated[
        int,
        typer.Option(min=1, help="Number of depth maps that have to agree on a point."),
    ] = 2,
    keep_single: Annotated[
        bool, typer.Option(help="Keep the points that only one depth map sees, too.")
    ] = False,
    noise_px: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a disparity, in pixels. Default: estimated "
            "from the differences between depth maps.",
            show_default=False,
        ),
    ] = None,
    quality: Annotated[
        Literal["high", "medium", "low"],
        typer.Option(
            help="Size to which large images are reduced: high, medium or low. medium "
            "is 0.6 megapixels with patchmatch, 2.4 with stereo."
        ),
    ] = "medium",
    matcher: Annotated[
        Literal["auto", "stereo", "patchmatch"],
        typer.Option(
            help="Way to find depths. stereo: rectified pairs of cameras, which is "
            "fast. patchmatch: each image with six others of any camera. auto: stereo "
            "where cameras can be rectified."
        ),
    ] = "auto",
    max_memory: Annotated[
        str,
        typer.Option(help="Most memory of the whole process, as 2GB or 800MB."),
    ] = "2GB",
    threads: ThreadsOption = -1,
) -> None:
    """Make a dense cloud: every pixel's depth along its exact water ray.

    Run the same command again to go on with a run that was stopped.
    """
    from uwsfm.cli.console import ProgressBars, console

    with ProgressBars() as progress:
        from uwsfm.dense.options import bytes_of
        from uwsfm.dense.run import dense_cloud

        result = dense_cloud(
            out,
            images,
            progress=progress,
            voxel=voxel,
            min_views=min_views,
            keep_single=keep_single,
            noise_px=noise_px,
            quality=quality,
            matcher=matcher,
            max_memory=bytes_of(max_memory),
            num_threads=threads,
        )
    console.print(_table(result.summary))
    if result.summary["voxel"] > result.summary["voxel_asked"]:
        typer.echo(_larger_voxels(result.summary))
    reused = sum(entry["reused"] for entry in result.summary["depth_maps"])
    if reused:
        done = f"{reused} of {len(result.summary['depth_maps'])} depth maps"
        typer.echo(f"{done} were there from an earlier run; the fusion was repeated")
    typer.echo(f"wrote {result.path}")


def _larger_voxels(summary: dict[str, Any]) -> str:
    """Memory decided on the cloud's detail, in place of what was asked for."""
    from uwsfm.surface.units import length_words

    size, asked = (
        length_words(summary[key], summary["unit"]) for key in ("voxel", "voxel_asked")
    )
    return (
        f"note: voxels are {size} and not {asked}, which did not fit the memory: a "
        "larger --max-memory keeps more detail"
    )


def _table(summary: dict[str, Any]) -> "Table":
    """What the cloud holds, and how well its points are known."""
    from rich.table import Table

    from uwsfm.surface.units import length_words

    unit = summary["unit"]
    table = Table(title="Dense cloud", title_justify="left", show_header=False)
    maps = summary["depth_maps"]
    shares = [entry["share_matched"] for entry in maps]
    slabs = sum((entry["num_slabs"] or 1) > 1 for entry in maps)
    table.add_row("depth maps", f"{len(maps)}")
    table.add_row("pixels with a depth", f"{100 * sum(shares) / len(shares):.0f} %")
    table.add_row("depth range split", f"in {slabs} of them")
    table.add_row("confirmed by others", f"{summary['num_confirmed']}")
    table.add_row("contradicted", f"{summary['num_contradicted']}")
    table.add_row("seen by too few", f"{summary['num_unchecked']}")
    table.add_row("points", f"{summary['num_points']}")
    if summary["num_plain"]:
        table.add_row("in plain areas, from what is around", f"{summary['num_plain']}")
    table.add_row("voxel", length_words(summary["voxel"], unit))
    table.add_row(
        "noise of a disparity", f"{summary['noise_px']:.2f} px, {summary['noise_from']}"
    )
    spread = summary["stddev_percentiles"]
    known = [v for v in summary["calibration_stddev_max"].values() if v is not None]
    label = "standard deviation along the sight, 5 50 95 %"
    if not known:
        label += ", calibration not counted"
    table.add_row(
        label, ", ".join(length_words(value, unit) for value in spread.values())
    )
    return table
