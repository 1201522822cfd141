"""A picture of a map, with a scale bar (matplotlib)."""

from pathlib import Path

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm.surface.height_map import HeightMap
from uwsfm.surface.units import short_unit

_MAX_SIDE = 1600  # pixels of the map that are drawn
_HEIGHT_IN, _DPI = 5.0, 130


def write_preview(found: HeightMap, path: Path, title: str, unit: str) -> None:
    """Draw the orthophoto beside the shaded heights.

    Args:
        found: the map.
        path: the PNG file.
        title: above both.
        unit: of lengths.
    """
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    step = max(1, -(-max(found.height.shape) // _MAX_SIDE))
    height, rgba = found.height[::step, ::step], found.colors[::step, ::step]
    rows, columns = found.height.shape
    east = found.west + columns * found.resolution
    south = found.north - rows * found.resolution
    extent = (found.west, east, south, found.north)
    width_in = float(np.clip(_HEIGHT_IN * columns / rows, 3.0, 9.0))
    figure = Figure((2 * width_in + 2.2, _HEIGHT_IN + 0.8), layout="constrained")
    figure.suptitle(title, size=10)
    left, right = figure.subplots(1, 2, sharey=True)
    left.imshow(rgba, extent=extent, interpolation="nearest")
    low, high = np.nanpercentile(height, [1.0, 99.0])
    shade = _hillshade(height, found.resolution * step)
    norm = Normalize(low, max(high, low + 1e-9))
    drawn = right.imshow(
        height, extent=extent, norm=norm, cmap="viridis", interpolation="nearest"
    )
    right.imshow(shade, extent=extent, cmap="gray", alpha=0.35, vmin=0.0, vmax=1.0)
    short = short_unit(unit)
    figure.colorbar(drawn, ax=right, label=f"height, {short}", shrink=0.9)
    for axes, name in ((left, "orthophoto"), (right, "height")):
        axes.set_title(name, size=9)
        axes.set_facecolor("0.92")
        axes.set_xlabel(f"x, {short}", size=8)
        axes.tick_params(labelsize=7)
        _scale_bar(axes, extent, short)
    left.set_ylabel(f"y, {short}", size=8)
    with replaced_file(path) as partial:
        figure.savefig(partial, dpi=_DPI)


def _hillshade(height: np.ndarray, cell: float) -> np.ndarray:
    """Light from the north-west, 45 degrees up: 0 to 1, NaN where there is no data."""
    if min(height.shape) < 2:
        return np.where(np.isfinite(height), 0.7, np.nan)
    south, east = np.gradient(height.astype(np.float64), cell)
    normal = np.stack([-east, south, np.ones_like(east)])  # rows run south
    normal /= np.linalg.norm(normal, axis=0)
    light = np.array([-0.5, 0.5, np.sqrt(0.5)])
    return np.clip(np.einsum("i,irc->rc", light, normal), 0.0, 1.0)


def _scale_bar(axes, extent: tuple[float, float, float, float], unit: str) -> None:
    west, east, south, north = extent
    length = _round_length(0.3 * (east - west))
    x, y = west + 0.04 * (east - west), south + 0.04 * (north - south)
    thick = 0.012 * (north - south)
    axes.add_patch(_rectangle(x, y, length / 2, thick, "black"))
    axes.add_patch(_rectangle(x + length / 2, y, length / 2, thick, "white"))
    box = {"facecolor": "white", "alpha": 0.75, "pad": 1.5, "edgecolor": "none"}
    text = f"{length:g} {unit}"
    axes.text(x, y + 2.0 * thick, text, size=8, va="bottom", bbox=box)


def _rectangle(x: float, y: float, width: float, height: float, color: str):
    from matplotlib.patches import Rectangle

    return Rectangle(
        (x, y), width, height, facecolor=color, edgecolor="black", linewidth=0.6
    )


def _round_length(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten below a length."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(f for f in (1.0, 2.0, 5.0) if f * power <= value * 1.001))
