"""Pictures of the study."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from board import Fused
from reef import ASSUMED_PX, Truth

from uwsfm.cloud import Cloud

FRAME = 8


def errors(truth: Truth, maps: dict[str, list], path: Path) -> None:
    """Errors of one frame in standard deviations, of each kind."""
    figure, axes = plt.subplots(1, 1 + len(maps), figsize=(15, 4), layout="constrained")
    shown = axes[0].imshow(truth.ranges[FRAME], cmap="viridis")
    figure.colorbar(shown, ax=axes[0], label="true range, m", shrink=0.8)
    for axis, (name, of_frames) in zip(axes[1:], maps.items(), strict=True):
        _, ranges, sensitivity = of_frames[FRAME]
        error = (ranges - truth.ranges[FRAME]) / (ASSUMED_PX * sensitivity)
        shown = axis.imshow(error, cmap="coolwarm", vmin=-2, vmax=2)
        axis.set_title(name)
        figure.colorbar(shown, ax=axis, label="error / sd of 0.3 px", shrink=0.8)
    for axis in axes:
        axis.set_axis_off()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def cloud(cloud: Cloud, path: Path) -> None:
    """From above and from the side, as it is coloured, and its deviations."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    order = np.argsort(-cloud.points[:, 2])  # z points down: the highest last
    points, colors = cloud.points[order], cloud.colors[order] / 255.0
    axes[0].scatter(points[:, 0], points[:, 1], c=colors, s=0.1)
    turned = points @ _oblique().T
    order = np.argsort(-turned[:, 2])
    axes[1].scatter(turned[order, 0], turned[order, 1], c=colors[order], s=0.1)
    shown = axes[2].scatter(
        cloud.points[:, 0],
        cloud.points[:, 1],
        c=1e3 * cloud.stddev,
        s=0.1,
        vmax=np.percentile(1e3 * cloud.stddev, 98),
    )
    figure.colorbar(shown, ax=axes[2], label="standard deviation, mm")
    for axis in axes:
        axis.set_aspect("equal")
        axis.invert_yaxis()
        axis.set_axis_off()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _oblique() -> np.ndarray:
    """Seen from 55 degrees off the vertical."""
    angle = np.radians(55.0)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


def board(found: Fused, path: Path) -> None:
    """The board's heights over its plane."""
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    shown = axis.scatter(
        *found.xy_mm.T, c=found.heights_mm, s=0.4, cmap="coolwarm",
        vmin=-3, vmax=3,
    )  # fmt: skip
    figure.colorbar(shown, label="mm off the plane")
    axis.set_aspect("equal")
    axis.set_xlabel("mm")
    figure.savefig(path, dpi=80)
    plt.close(figure)
