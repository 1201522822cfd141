"""The plots of a report as PNG, for print and for other documents."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwsfm.report.gather import Report
from uwsfm.report.halves import halves_payload
from uwsfm.report.page import Scales, cost_unit, scales_of
from uwsfm.trust.residuals import CameraResiduals, Profile, Residuals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORS = ("#0b5c8a", "#b35900", "#4d7c0f")
_MARKERS = ("o", "s", "D")
_MAP = ("#fcfcf9", "#5d9ec7")
_DPI = 110
_MOST_POINTS = 20_000
"""In the picture of the cloud."""


def draw_pictures(report: Report, folder: Path) -> None:
    """Write residuals_CAMERA.png, coverage.png, convergence.png, cloud.png, and
    halves.png if there is a cross-validation."""
    with _without_collection():
        _draw_all(report, folder)


@contextmanager
def _without_collection() -> Iterator[None]:
    """A plot is thousands of small objects: looking for cycles among them again and
    again takes a fifth of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _draw_all(report: Report, folder: Path) -> None:
    scales = scales_of(report.residuals)
    for index, camera in enumerate(report.residuals):
        figure = _residual_figure(camera, report.unit, scales)
        _save(figure, folder / f"residuals_{index}.png")
    _save(_coverage_figure(report), folder / "coverage.png")
    drawn = halves_payload(report.summary)
    if drawn:
        _save(_halves_figure(report, drawn), folder / "halves.png")
    _save(_convergence_figure(report.summary), folder / "convergence.png")
    _save(_cloud_figure(report), folder / "cloud.png")


def _panels(
    width: float, height: float, rows: int = 1, columns: int = 1
) -> tuple["Figure", Any]:
    """A figure and its axes (rows, columns); sizes of one panel in inches."""
    # Not pyplot: it would choose a window system, and keep every figure.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Automatic layouts draw everything several times: margins are set instead.
    wide, high = columns * width, rows * height
    figure = Figure(figsize=(wide, high))
    FigureCanvasAgg(figure)
    figure.subplots_adjust(
        left=0.85 / wide,
        right=1.0 - 0.2 / wide,
        bottom=0.55 / high,
        top=1.0 - 0.55 / high,
        wspace=0.25,
        hspace=0.35,
    )
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.locator_params(nbins=5)  # ticks are what drawing takes its time for
    return figure, grid


def _save(figure: "Figure", path: Path) -> None:
    figure.savefig(path, dpi=_DPI)


def _residual_figure(camera: CameraResiduals, unit: str, scales: Scales) -> "Figure":
    models = [("best pinhole", camera.pinhole), ("uwsfm", camera.refractive)]
    drawn = [(title, model) for title, model in models if model is not None]
    figure, grid = _panels(4.8, 3.1, 3, len(drawn))
    for column, (title, model) in enumerate(drawn):
        _map(grid[0, column], camera, model, scales)
        grid[0, column].set_title(
            f"{camera.name}, {title}: {model.rms_px:.3f} px RMS, "
            f"systematic {model.systematic_px:.3f}",
            fontsize="medium",
        )
        _profiles(grid[1, column], model.by_radius, "radius (px)", scales)
        _profiles(grid[2, column], model.by_depth, f"depth ({unit})", scales)
    return figure


def _map(
    axes: "Axes", camera: CameraResiduals, model: Residuals, scales: Scales
) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    width, height = camera.size
    rows, columns = camera.counts.shape
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    shown = axes.imshow(
        np.linalg.norm(model.cells_px, axis=2),
        extent=(0.0, width, height, 0.0),
        cmap=LinearSegmentedColormap.from_list("residual", _MAP),
        vmin=0.0,
        vmax=scales.map_px,
    )
    axes.quiver(
        *np.meshgrid(x, y),
        model.cells_px[..., 0],
        model.cells_px[..., 1],
        angles="xy",
        scale_units="xy",
        scale=1.0 / scales.factor,
        width=0.004,
    )
    bar = axes.figure.colorbar(shown, ax=axes, shrink=0.8)
    bar.set_label("mean (px)")


def _profiles(
    axes: "Axes", profiles: tuple[Profile, ...], label: str, scales: Scales
) -> None:
    for profile, color, sign in zip(profiles, _COLORS, _MARKERS, strict=False):
        axes.errorbar(
            profile.at,
            profile.mean_px,
            profile.stderr_px,
            color=color,
            marker=sign,
            markersize=4,
            linewidth=1.2,
            label=profile.name,
        )
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(
        xlabel=label,
        ylabel="along radius (px)",
        ylim=(-scales.profile_px, scales.profile_px),
    )
    axes.legend(fontsize="small", frameon=False)


def _coverage_figure(report: Report) -> "Figure":
    from matplotlib.colors import LinearSegmentedColormap

    figure, grid = _panels(4.8, 3.6, columns=len(report.residuals))
    cmap = LinearSegmentedColormap.from_list("counts", _MAP)
    for axes, camera in zip(grid[0], report.residuals, strict=True):
        width, height = camera.size
        shown = axes.imshow(
            camera.counts, extent=(0.0, width, height, 0.0), cmap=cmap, vmin=0
        )
        figure.colorbar(shown, ax=axes, shrink=0.8, label="observations")
        axes.set_title(camera.name)
    return figure


def _halves_figure(report: Report, drawn: dict[str, Any]) -> "Figure":
    """By how much two halves of the frames project differently, per camera."""
    from matplotlib.colors import LinearSegmentedColormap

    cameras = report.residuals
    figure, grid = _panels(5.2, 4.2, columns=len(cameras))
    colors = LinearSegmentedColormap.from_list("map", _MAP)
    for axes, camera, values in zip(grid[0], cameras, drawn["halves"], strict=True):
        image = axes.imshow(
            np.array(values, dtype=np.float64),
            extent=(0, camera.size[0], camera.size[1], 0),
            vmin=0.0,
            vmax=drawn["halves_limit"],
            cmap=colors,
        )
        figure.colorbar(image, ax=axes, label="difference (px)", shrink=0.8)
        axes.set_title(f"{camera.name}: projections of two halves")
        axes.set_xlabel("x (px)")
        axes.set_ylabel("y (px)")
    return figure


def _convergence_figure(summary: dict[str, Any]) -> "Figure":
    from matplotlib.ticker import LogLocator, NullLocator

    figure, ((axes,),) = _panels(6.4, 3.6)
    first, named = 0, set()
    for solve in summary["solves"]:
        loss = solve["loss"]
        costs = np.sqrt(2.0 * np.array(solve["costs"]) / solve["num_observations"])
        axes.plot(
            first + np.arange(len(costs)),
            costs,
            color=_COLORS[loss != "l2"],
            marker=_MARKERS[loss != "l2"],
            markersize=4,
            label=None if loss in named else loss,
        )
        named.add(loss)
        first += len(costs)
    axes.set(xlabel="step", ylabel=f"cost ({cost_unit(summary)})", yscale="log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter("{x:.3g}")
    axes.legend(frameon=False)
    return figure


def _cloud_figure(report: Report) -> "Figure":
    """The cloud as the cameras look at it, from far away, and from their side."""
    view = report.view
    right = np.cross(view.sight, view.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, view.sight)
    rows = np.linspace(0, len(view.points) - 1, min(len(view.points), _MOST_POINTS))
    rows = rows.astype(np.int64)
    figure, grid = _panels(4.6, 4.4, columns=2)
    for axes, across, title in zip(
        grid[0],
        (up, -view.sight),
        ("along the line of sight", "from above the images"),
        strict=True,
    ):
        frame = np.stack([right, across], axis=1)  # (3, 2)
        x, y = (view.points[rows] @ frame).T
        axes.scatter(x, y, s=0.6, c=view.colors[rows] / 255.0, linewidths=0)
        for lines, color in zip(view.frusta, _COLORS * 9, strict=False):
            axes.plot(*(lines @ frame).T, color=color, linewidth=0.3)
        axes.plot(*(view.trajectory @ frame).T, color="0.2", linewidth=0.8)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(title)
        axes.set_xlabel(report.unit)
    return figure
