"""uwsfm simulate: synthetic dives with known truth."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from uwsfm._base.signals import NOTHING_WRITTEN, interruptible
from uwsfm.cli.options import SeedOption

MAX_RANGE_M = 10
"""Beyond it the water hides the floor."""


def _number(low: float, high: float, what: str) -> Any:
    """An option in a range. Typer's own would refuse nan as too large."""

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise typer.BadParameter(
                f"must be a number from {low:g} to {high:g}, got {text}"
            )
        return value

    return typer.Option(parser=parsed, metavar=f"{low:g} to {high:g}", help=what)


simulate_app = typer.Typer(
    help="Synthetic dives with known truth.", no_args_is_help=True
)


@simulate_app.command("images")
def simulate_images(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The folder to write, new or empty.")
    ],
    preset: Annotated[
        str,
        typer.Option(
            help="Which dive is rendered. sample: that of the package. small: few and "
            "small images. dome: behind domes. near: 0.3 m away, ports far off and "
            "tilted."
        ),
    ] = "sample",
    frames: Annotated[
        int | None,
        typer.Option(
            help="Number of frames, the first of the preset. Default: all of them.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Seed of the floor and of the noise; rig and motion stay the same. "
            "Default: that of the preset.",
            show_default=False,
        ),
    ] = None,
    clear_water: Annotated[
        bool,
        typer.Option(
            "--clear-water", help="Render without attenuation and without veil."
        ),
    ] = False,
) -> None:
    """Render stereo pairs through their ports, with a rig file and the truth."""
    from uwsfm.cli.console import ProgressBars

    with ProgressBars(NOTHING_WRITTEN) as progress:
        from uwsfm.simulate.commands import simulate_images as run

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
@interruptible()
def simulate_observations(
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npz file to write.")],
    trajectory: Annotated[
        Literal["rich", "strip", "lawn-mower"],
        typer.Option(help="How the rig moves over the floor."),
    ] = "rich",
    frames: Annotated[
        int, typer.Option(min=2, max=100_000, help="Number of stereo pairs taken.")
    ] = 15,
    altitude_m: Annotated[
        float, _number(0.01, MAX_RANGE_M, "Mean height above the floor, in metres.")
    ] = 2.0,
    relief_m: Annotated[
        float,
        _number(0, MAX_RANGE_M, "Standard deviation of the floor's height, in metres."),
    ] = 0.2,
    points: Annotated[
        int,
        typer.Option(
            min=1, max=10_000_000, help="Number of points, each seen at least twice."
        ),
    ] = 800,
    noise_px: Annotated[
        float, _number(0, 100, "Standard deviation of an image coordinate, in pixels.")
    ] = 0.5,
    outliers: Annotated[
        float, _number(0, 1, "Share of the observations that are wrong, 0 to 1.")
    ] = 0.0,
    distance_m: Annotated[
        float, _number(0, 0.5, "Distance of both ports from their cameras, in metres.")
    ] = 0.02,
    thickness_m: Annotated[
        float, _number(0, 0.5, "Thickness of the glass of both ports, in metres.")
    ] = 0.005,
    focal_px: Annotated[
        float, _number(100, 100_000, "Focal length of both cameras, in pixels.")
    ] = 1000.0,
    seed: SeedOption = 0,
) -> None:
    """Simulate what a stereo rig observes, with ground truth, as arrays.

    Observations: xy, camera_idx, frame_idx, point_idx. Truth: true_xy, is_outlier,
    points, rig_from_world, cam_from_rig, port_rows; the lenses are camera_model,
    camera_size and camera_params. uwsfm.simulate.read_observations makes a Scene of
    them, for uwsfm.calibrate in Python: see docs/howto/python.md.
    """
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
