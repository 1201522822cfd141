"""The picture in the README: the sample's images, cloud, rig path and housings.

uwsfm demo -o uwsfm-demo
python pipelines/sample/figure.py uwsfm-demo -o pipelines/sample/result.png
"""

import argparse
import json
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import uwsfm
from uwsfm.geometry import rigid3
from uwsfm.jobs.demo import sample_dir


def camera_frusta(model: uwsfm.Model, depth: float = 0.12) -> list[np.ndarray]:
    """Outline (k, 3) of each camera's view to a depth in metres, in the world."""
    outlines = []
    scene = model.scene
    for index, camera in enumerate(scene.cameras):
        width, height = camera.width, camera.height
        corners = [[0, 0], [width, 0], [width, height], [0, height]]
        _, dirs = camera.ray_from_img(np.array(corners, float))
        rim = depth * dirs / dirs[:, 2:]
        loop = np.vstack([np.zeros(3), rim[[0, 1]], np.zeros(3), rim[[2, 3]], rim[[0]]])
        loop = np.vstack([loop, np.zeros(3), rim[1], rim[2], np.zeros(3), rim[3]])
        for pose in scene.rig_from_world:
            cam_from_world = rigid3.compose(scene.cam_from_rig[index], pose)
            outlines.append(rigid3.transform(rigid3.inverse(cam_from_world), loop))
    return outlines


def draw_cloud(axes, model: uwsfm.Model) -> None:
    """Coloured points and the cameras above them; the sea floor lies flat."""
    points, colors = model.scene.points, model.colors / 255.0
    # The floor's own plane is the ground of the picture.
    center = np.median(points, axis=0)
    axes_of_floor = np.linalg.svd(points - center, full_matrices=False)[2]
    if np.linalg.det(axes_of_floor) < 0:
        axes_of_floor[1] *= -1
    frusta = [(f - center) @ axes_of_floor.T for f in camera_frusta(model)]
    points = (points - center) @ axes_of_floor.T
    if np.mean([f[0, 2] for f in frusta]) < 0:  # cameras belong above
        flip = np.array([1.0, -1.0, -1.0])
        points, frusta = points * flip, [f * flip for f in frusta]
    axes.scatter(*points.T, c=colors, s=5.0, linewidths=0, depthshade=False)
    for outline in frusta:
        axes.plot(*outline.T, color="#d9480f", linewidth=0.7, alpha=0.9)
    low, high = points.min(axis=0), points.max(axis=0)
    reach = np.max([np.abs(f[0]) for f in frusta], axis=0)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], reach[2] + 0.1)
    axes.set_box_aspect(
        (high[0] - low[0], high[1] - low[1], reach[2] + 0.1 - low[2]), zoom=1.1
    )
    axes.view_init(elev=34, azim=-62)
    axes.set_xlabel("m", labelpad=-4)
    axes.set_ylabel("m", labelpad=-4)
    axes.tick_params(labelsize=7, pad=-2)
    axes.set_zticks([0.0, 0.5, 1.0])
    axes.set_facecolor("none")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_visible(False)
    frames, count = model.scene.num_frames, model.scene.num_points
    title = f"{count} points and {frames} stereo poses, metric"
    axes.figure.text(0.68, 0.955, title, fontsize=10, ha="center")


def draw_distances(axes, summary: dict, truth: dict) -> None:
    """Port distances: start, estimate with three standard deviations, truth."""
    for row, camera in enumerate(summary["cameras"]):
        true = 1e3 * truth["cameras"][row]["distance_m"]
        axes.plot([true, true], [row - 0.3, row + 0.3], color="#2b8a3e", linewidth=2)
        axes.plot(10.0, row, "x", color="#868e96")
        axes.errorbar(
            1e3 * camera["distance_m"],
            row,
            xerr=3e3 * camera["distance_stddev_m"],
            fmt="o",
            markersize=4,
            capsize=3,
            color="#d9480f",
        )
    names = [camera["name"] for camera in summary["cameras"]]
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlim(8, 22)
    axes.set_xlabel("port distance, mm (cross: start, line: truth, dot: result ±3σ)")
    axes.xaxis.label.set_size(8)
    axes.tick_params(labelsize=8)
    axes.set_title("housings, from the images alone", fontsize=10)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    model = uwsfm.read_model(options.demo)
    summary = json.loads((options.demo / "summary.json").read_text())
    truth = json.loads((sample_dir() / "truth.json").read_text())
    figure = plt.figure(figsize=(10, 6), dpi=110)
    grid = figure.add_gridspec(
        3, 2, width_ratios=(1.15, 2), height_ratios=(2.4, 2.4, 1)
    )
    for row, side in enumerate(("left", "right")):
        image = cv2.imread(str(sample_dir() / "images" / side / model.frame_names[2]))
        axes = figure.add_subplot(grid[row, 0])
        axes.imshow(image[:, :, ::-1])
        axes.set_axis_off()
        axes.set_title(f"{side} image of one pair", fontsize=10)
    draw_distances(figure.add_subplot(grid[2, 0]), summary, truth)
    draw_cloud(figure.add_subplot(grid[:, 1], projection="3d"), model)
    figure.tight_layout()
    figure.savefig(options.out)


if __name__ == "__main__":
    main()
