"""Options that several commands share, and how their texts are read."""

from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

import typer

from uwsfm.errors import InputError


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
RigArgument = Annotated[Path, typer.Argument(help="The rig file, see uwsfm init.")]
ResultsOption = Annotated[
    Path, typer.Option("--out", "-o", help="Folder for the results.")
]
MatcherOption = Annotated[
    Literal["colmap", "paper"],
    typer.Option(help="paper: kd-trees and a tolerant fundamental matrix."),
]
MaxFeaturesOption = Annotated[
    int | None,
    typer.Option(
        min=100,
        help="Features per image, about. Default: by the size of the images, 8192 up "
        "to 2 megapixels, 12288 from 4.5. More features take more time.",
        show_default=False,
    ),
]
SeedOption = Annotated[
    int,
    typer.Option(
        min=0,
        max=2**31 - 1,
        help="Seed of the random number generator. The same seed gives the same "
        "result.",
    ),
]
ThreadsOption = Annotated[int, typer.Option(min=-1, help="-1: all cores.")]
MapperOption = Annotated[
    Literal["pinhole", "refractive"],
    typer.Option(help="pinhole: COLMAP's, and water rays in the last step only."),
]
SceneDistanceOption = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        help="Rough distance from a single camera to its scene. Default: 1. Not for "
        "rigs of two or more cameras, which measure it.",
        show_default=False,
    ),
]
SchedulerOption = Annotated[
    str,
    typer.Option(
        metavar="local|tcp://HOST:PORT",
        help="Where parallel work is done. local: in processes of this machine. An "
        "address: by the workers of the Dask scheduler there, on which all folders "
        "have the same paths as here.",
    ),
]
ReportOption = Annotated[
    bool, typer.Option("--report/--no-report", help="Write report.html.")
]
PositionsOption = Annotated[
    Path | None,
    typer.Option(
        help="Positions of the frames (navigation, GPS): CSV with the header "
        "frame,x,y,z,sx,sy,sz in metres, in a local right-handed frame; or "
        "frame,depth,sdepth where only depths are known.",
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


def lever_arm_of(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise InputError(f"--lever-arm {text}: write three numbers X,Y,Z in metres")
    return values


def wanted_of(what: Iterable[Refinable]) -> dict[str, bool]:
    """--refine, as fields of `CalibrateOptions`."""
    return {f"refine_{item.value.replace('-', '_')}": True for item in what}


def priors_of(texts: Iterable[str]) -> dict[str, float]:
    """KEY=VALUE, as fields of `CalibrateOptions`."""
    from uwsfm.calibration.problem import PRIORS
    from uwsfm.rig_values import checked_accuracy

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
        try:
            checked_accuracy(key, found[key])
        except InputError as error:
            raise InputError(f"--prior {text}: {error}") from None
    return found
