"""Clouds, meshes, maps and colour."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from uwsfm._base.signals import NOTHING_WRITTEN, interruptible
from uwsfm.cli.options import ImagesOption

SourceArgument = Annotated[
    Path,
    typer.Argument(
        metavar="OUT_OR_CLOUD",
        help="A result folder, of which the dense cloud is taken, or the points if "
        "there is none; or a PLY file.",
    ),
]
UpOption = Annotated[
    Literal["plane", "x", "y", "z", "-x", "-y", "-z"] | None,
    typer.Option(
        help="Axis of the world that points up, --up=z or --up=-z. plane: the plane "
        "through the points is level. Default: plane; with positions it must be given.",
        show_default=False,
    ),
]
PartsOption = Annotated[
    Literal["main", "all"],
    typer.Option(
        help="Which points are used. main: the connected surface, and other parts with "
        "a tenth of its points or more; strays go into a file of their own. all: every "
        "point."
    ),
]


@interruptible()
def clean(
    source: SourceArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="The PLY file to write.")],
    min_views: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Least number of images of a point's track, or of depth maps that "
            "agree on it. Default: 3 images, 2 depth maps.",
            show_default=False,
        ),
    ] = None,
    max_error_px: Annotated[
        float | None,
        typer.Option(
            help="Largest mean reprojection error of a point, in pixels. Default: 2.",
            show_default=False,
        ),
    ] = None,
    max_stddev: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Largest standard deviation along the line of sight. Default: any.",
            show_default=False,
        ),
    ] = None,
    max_relative_stddev: Annotated[
        float | None,
        typer.Option(
            help="Largest standard deviation along the line of sight, as a share of "
            "the distance. Default: 0.02.",
            show_default=False,
        ),
    ] = None,
    outlier_ratio: Annotated[
        float | None,
        typer.Option(
            help="How much further a point may be from its neighbours than others from "
            "theirs, in standard deviations. Default: 4.",
            show_default=False,
        ),
    ] = None,
    parts: PartsOption = "main",
) -> None:
    """Leave out the bad points of a cloud, and count them. inf switches a limit off."""
    from uwsfm.surface.commands import clean_cloud

    limits: dict[str, Any] = {
        "min_views": min_views,
        "max_error_px": max_error_px,
        "max_stddev_m": max_stddev,
        "max_relative_stddev": max_relative_stddev,
        "outlier_ratio": outlier_ratio,
    }
    given = {name: value for name, value in limits.items() if value is not None}
    report = clean_cloud(source, out, parts, **given)
    _print_filters(report)
    typer.echo(f"wrote {out}, counts in {out.with_suffix('.json')}")


def mesh(
    source: SourceArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")],
    method: Annotated[
        Literal["poisson", "ball-pivoting"],
        typer.Option(
            help="How the surface is made. poisson: smooths over noise. ball-pivoting: "
            "keeps the points as they are."
        ),
    ] = "poisson",
    max_distance: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Largest distance of the surface from the points; what is further is "
            "a hole. Default: four of their spacings.",
            show_default=False,
        ),
    ] = None,
    up: UpOption = None,
    web_triangles: Annotated[
        int, typer.Option(help="Largest number of triangles of the decimated copy.")
    ] = 100_000,
    parts: PartsOption = "main",
    texture: Annotated[
        bool,
        typer.Option(
            "--texture",
            help="Also write textured.glb: the decimated copy with the photographs on "
            "it, exposures balanced.",
        ),
    ] = False,
    texture_side: Annotated[
        int, typer.Option(help="Largest side of the texture, in texels.")
    ] = 4096,
    images: ImagesOption = None,
) -> None:
    """Write a surface through the points: PLY, OBJ, GLB and a small GLB for the web."""
    from rich.markup import escape

    from uwsfm.cli.console import ProgressBars, console

    with ProgressBars(NOTHING_WRITTEN) as progress:
        from uwsfm.surface.commands import mesh_cloud

        report = mesh_cloud(
            source,
            out,
            progress,
            method=method,
            max_distance=max_distance,
            up=up,
            web_triangles=web_triangles,
            parts=parts,
            texture=texture,
            texture_side=texture_side,
            images=images,
        )
    from uwsfm.surface.units import length_words

    farthest = length_words(report["max_distance"], report["unit"])
    typer.echo(
        f"{report['mesh']['num_triangles']} triangles "
        f"({report['web']['num_triangles']} in web.glb), none further than "
        f"{farthest} from a point; glTF: {report['gltf']}, "
        f"{report['level']}"
    )
    written = "mesh.ply, mesh.obj, mesh.glb, web.glb, mesh.json"
    if texture:
        texel = report["texture"]
        typer.echo(
            f"texture: {texel['width']} x {texel['height']} from {texel['num_images']} "
            f"images, which see {texel['share_seen']:.0%} of the surface"
        )
        written += ", textured.glb"
    for warning in report["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    typer.echo(f"wrote {out}: {written}")


@interruptible()
def map_(
    source: SourceArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")],
    up: UpOption = None,
    resolution: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Side of a cell of the map. Default: the spacing of the points.",
            show_default=False,
        ),
    ] = None,
    max_gap: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Distance between points that is filled where the surface is smooth; "
            "what is wider stays a hole. Default: five spacings.",
            show_default=False,
        ),
    ] = None,
    parts: PartsOption = "main",
) -> None:
    """Write a height map and an orthophoto as GeoTIFF, with a picture of both."""
    from rich.markup import escape

    from uwsfm.cli.console import console
    from uwsfm.surface.commands import make_map
    from uwsfm.surface.units import length_words

    report = make_map(
        source, out, up=up, resolution=resolution, max_gap=max_gap, parts=parts
    )
    cell = length_words(report["resolution"], report["unit"])
    typer.echo(
        f"{report['num_columns']} x {report['num_rows']} cells of "
        f"{cell}, {report['share_with_data']:.0%} with data "
        f"({report['share_filled']:.0%} filled between points); {report['level']}"
    )
    for warning in report["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    typer.echo(f"wrote {out}: height.tif, ortho.tif, origin.tif, map.json, map.png")


def color(
    model: Annotated[
        Path, typer.Argument(metavar="OUT", help="The output of uwsfm reconstruct.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")],
    images: ImagesOption = None,
    write_images: Annotated[
        bool,
        typer.Option(
            "--write-images", help="Write the images without the water's colour, too."
        ),
    ] = False,
    encoding: Annotated[
        Literal["srgb", "sqrt", "linear"],
        typer.Option(
            help="How light became the numbers of the images. srgb: as in a camera's "
            "JPEG. sqrt: as uwsfm simulate writes them. linear: developed without a "
            "curve."
        ),
    ] = "srgb",
    white_balance: Annotated[
        Literal["none", "gray"],
        typer.Option(
            help="Which colour becomes grey. none: no colour is changed for it. gray: "
            "that of the median point."
        ),
    ] = "none",
) -> None:
    """Estimate what the water does to colours, and take it from points and images.

    From points that were seen from near and from far: attenuation and veil of each
    channel, by day light; lamps that move with the camera are found out and refused.
    """
    from rich.markup import escape

    from uwsfm.cli.console import ProgressBars, console

    with ProgressBars(NOTHING_WRITTEN) as progress:
        from uwsfm.color.commands import correct_colors

        report = correct_colors(
            model,
            out,
            images=images,
            write_images=write_images,
            encoding=encoding,
            gray=white_balance == "gray",
            progress=progress,
        )
    _print_water(report)
    typer.echo(
        f"encoding: {report['encoding']}; say with --encoding if the images are "
        "otherwise: a wrong one gives wrong numbers with small deviations"
    )
    for warning in report["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    written = [path.name for path in sorted(out.iterdir())]
    typer.echo(f"wrote {out}: {', '.join(written)}; assumed: {report['assumed']}")


def _print_water(report: dict[str, Any]) -> None:
    from rich.table import Table

    from uwsfm.cli.console import console
    from uwsfm.surface.units import short_unit

    short = short_unit(report["unit"])
    table = Table(title="Water: ± is one standard deviation", title_justify="left")
    table.add_column("channel")
    rows = {
        f"attenuation, 1/{short}": "attenuation_per_m",
        f"veil near the camera, 1/{short}": "veil_slope_per_m",
        f"backscatter, 1/{short}": "backscatter_per_m",
        "veil of open water": "veil",
    }
    for title in rows:
        table.add_column(title, justify="right")
    for name, channel in report["channels"].items():
        cells = [_estimate(channel[key]) for key in rows.values()]
        table.add_row(name, *cells)
    console.print(table)


def _estimate(entry: dict[str, Any]) -> str:
    if not entry["determined"]:
        return "not determined"
    return f"{entry['value']:.3f} ± {entry['stddev']:.3f}"


def _print_filters(report: dict[str, Any]) -> None:
    from rich.table import Table

    from uwsfm.cli.console import console

    table = Table(title="Points left out", title_justify="left")
    table.add_column("by", no_wrap=True)
    for column in ("limit", "tested", "left out", "of these unknown"):
        table.add_column(column, justify="right")
    for item in report["filters"]:
        limit = "" if item["limit"] is None else f"{item['limit']:g}"
        counts = (item[f"num_{key}"] for key in ("tested", "removed", "unknown"))
        table.add_row(item["name"], limit, *map(str, counts))
    table.add_section()
    kept, count = report["num_kept"], report["num_points"]
    table.add_row("all", "", str(count), str(count - kept), "")
    console.print(table)
