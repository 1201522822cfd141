"""Draw the manual's two diagrams: python docs/figures.py

They are kept in docs/images, so that a build of the manual needs no drawing.
"""

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyBboxPatch, Rectangle

import uwsfm

IMAGES = Path(__file__).parent / "images"
plt.rcParams["svg.hashsalt"] = "uwsfm"
AIR, GLASS, WATER, RAY, INK = "#ffffff", "#cfd8dc", "#d6ecf7", "#c62828", "#263238"


def refraction() -> None:
    """A flat port, drawn with the rays that the program computes."""
    import pycolmap

    d, t, h = 0.05, 0.03, 0.1
    lens = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=400, height=400, params=[200, 200, 200]
    )
    port = uwsfm.FlatPort(distance=d, thickness=t, n_glass=1.5, n_water=1.333)
    camera = uwsfm.RefractiveCamera(lens, port)
    origin, ray = (values[0] for values in camera.ray_from_img([[200.0, 340.0]]))
    point = origin + ray * (h / ray[2])
    slope = 140.0 / 200.0
    enter = np.array([d, slope * d])
    leave, end = origin[[2, 1]], point[[2, 1]]

    figure, axes = plt.subplots(figsize=(7.2, 3.6))
    low, high = -0.045, 0.13
    for left, width, color in (
        (-0.03, d + 0.03, AIR),
        (d, t, GLASS),
        (d + t, h + 0.03, WATER),
    ):
        axes.add_patch(Rectangle((left, low), width, high - low, color=color, zorder=0))
    axes.plot([-0.03, d + t + h + 0.03], [0, 0], color=INK, lw=0.8, ls=(0, (6, 4)))
    corners = np.array([[0.0, 0.0], enter, leave, end])
    axes.plot(*corners.T, color=RAY, lw=1.8)
    back = leave - ray[[2, 1]] * (leave[1] / ray[1])
    axes.plot(*np.array([back, leave]).T, color=RAY, lw=1.0, ls=":")
    axes.plot(*end, "o", color=INK)
    axes.plot([end[0], end[0]], [0.0, end[1]], color=INK, lw=0.8, ls=":")
    axes.plot(0.0, 0.0, "o", color=INK)
    axes.annotate("", (d, 0.0), (0.0, 0.0), arrowprops={"arrowstyle": "->", "lw": 1.4})
    for text, x, y in (
        ("camera centre", -0.026, -0.013),
        ("$n$", 0.022, 0.006),
        ("air", 0.004, high - 0.014),
        ("glass", d + 0.006, high - 0.014),
        ("water", d + t + 0.04, high - 0.014),
        ("$X_i$", enter[0] - 0.014, enter[1] + 0.004),
        ("$X_o$", leave[0] + 0.003, leave[1] - 0.012),
        ("$X$", end[0] + 0.004, end[1] - 0.003),
        ("$|r|$", end[0] + 0.003, 0.5 * end[1]),
        ("$r_a$", 0.02, 0.024),
        ("$r_w$", 0.5 * (leave[0] + end[0]), 0.5 * (leave[1] + end[1]) + 0.006),
    ):
        axes.text(x, y, text, fontsize=12, color=INK)
    for text, x0, x1 in (("$d$", 0.0, d), ("$t$", d, d + t), ("$h$", d + t, end[0])):
        y = -0.03
        axes.annotate("", (x1, y), (x0, y), arrowprops={"arrowstyle": "<->", "lw": 1.0})
        axes.text(0.5 * (x0 + x1) - 0.002, y + 0.003, text, fontsize=12, color=INK)
    axes.set_xlim(-0.03, d + t + h + 0.03)
    axes.set_ylim(low, high)
    axes.set_aspect("equal")
    axes.axis("off")
    save(figure, "refraction")


ROWS = (
    ("command line", "cli"),
    ("whole jobs", "jobs"),
    ("from a result", "report · surface · dense · color · measuring · export"),
    ("results, verdict", "results · trust"),
    ("images to map", "options · sfm · colmap · simulate · inputs · rig"),
    ("what is refined", "calibration"),
    ("least squares", "solver · residuals · scene"),
    ("rays", "models · geometry"),
)


def architecture() -> None:
    """Layers, the highest first; each uses those below."""
    figure, axes = plt.subplots(figsize=(7.2, 4.4))
    for index, (title, names) in enumerate(ROWS):
        y = len(ROWS) - index
        arrays = index >= len(ROWS) - 3
        color = "#e3f2fd" if arrays else "#f1f4f6"
        box = FancyBboxPatch(
            (0.0, y), 10.0, 0.62, boxstyle="round,pad=0.08", fc=color, ec="#90a4ae"
        )
        axes.add_patch(box)
        axes.text(0.15, y + 0.31, title, va="center", fontsize=10, weight="bold")
        axes.text(2.75, y + 0.31, names, va="center", fontsize=9.5, color=INK)
    axes.annotate(
        "", (10.6, 1.0), (10.6, len(ROWS) + 0.6), arrowprops={"arrowstyle": "->"}
    )
    axes.text(10.8, 4.8, "imports", rotation=270, va="center", fontsize=9)
    axes.set_xlim(-0.2, 11.3)
    axes.set_ylim(0.7, len(ROWS) + 1.0)
    axes.axis("off")
    save(figure, "architecture")


def save(figure: plt.Figure, name: str) -> None:
    """Write an SVG with a line per group: matplotlib writes one per vertex."""
    path = IMAGES / f"{name}.svg"
    figure.savefig(
        path, bbox_inches="tight", facecolor="white", metadata={"Date": None}
    )
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"\s*\n\s*(?!\s*<g )", " ", text).strip() + "\n", "utf-8")
    plt.close(figure)


if __name__ == "__main__":
    refraction()
    architecture()
