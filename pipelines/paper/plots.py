"""How the figures look."""

from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from uwsfm._base.files import replaced_file

BLUE, ORANGE, TEAL, VIOLET, GRAY = "#1c7ed6", "#d9480f", "#0c8599", "#7048e8", "#868e96"
COLORS = {
    "reprojection": BLUE,
    "virtual_camera": ORANGE,
    "virtual_camera_tangential": TEAL,
    "point_3d": VIOLET,
    "joint": BLUE,
    "nested": ORANGE,
    "left": BLUE,
    "right": ORANGE,
    "joint, 30 mm of glass": TEAL,
}
"""The same thing has the same colour in all figures."""

plt.rcParams.update(
    {
        "font.size": 8.5,
        "axes.titlesize": 9.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "#e9ecef",
        "axes.axisbelow": True,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "lines.linewidth": 1.4,
    }
)


def new_figure(width: float, height: float) -> Any:
    """A figure of this size in inches, 110 dots each."""
    return plt.figure(figsize=(width, height), dpi=110, layout="constrained")


def save(figure: Any, path: Path) -> None:
    with replaced_file(path) as partial:
        buffer = BytesIO()
        figure.savefig(buffer, format="png")
        # A palette: a third of the bytes, and no difference to the eye.
        image = Image.open(buffer).convert("RGB").quantize(128)
        image.save(partial, format="png", optimize=True)
    plt.close(figure)


def bars(axes: Any, x: Any, mean: Any, stddev: Any, name: str, shift: float) -> None:
    """Means with one standard deviation up and down, beside those of other names."""
    axes.errorbar(
        [value + shift for value in x],
        mean,
        yerr=stddev,
        fmt="o-",
        markersize=3.5,
        capsize=2.5,
        linewidth=1.1,
        elinewidth=0.9,
        color=COLORS[name],
        label=name.replace("_", " "),
    )
