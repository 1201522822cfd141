"""Clouds cleaned, meshed, mapped and without their water, beside the rendered truth.

    uwsfm demo -o DEMO && uwsfm dense DEMO
    python pipelines/inspection/surface.py DEMO -o WORK

The sample is rendered, so its floor, its water and its colours are known. Prints the
tables of README.md and draws color.png and surface.png; files go to WORK. Needs
'.[render,inspect]'.
"""

import argparse
import json
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import tifffile

import uwsfm
from uwsfm._base.packages import import_package
from uwsfm.color.commands import correct_colors
from uwsfm.color.encoding import light_of, values_of
from uwsfm.geometry import rigid3
from uwsfm.jobs.demo import sample_dir
from uwsfm.simulate.rendering import SensorOptions, render_image
from uwsfm.simulate.rigs import known_cam_from_rig
from uwsfm.simulate.sequence import floor_in_view, sample_spec
from uwsfm.surface.commands import clean_cloud, make_map, mesh_cloud

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SHOWN = 9  # frame of the left camera
ERROR_MM = 5.0


def run(out: Path, work: Path) -> dict[str, dict]:
    """All commands, as a user gives them; what they reported."""
    water = correct_colors(out, work / "color", encoding="sqrt", write_images=True)
    clean_cloud(out, work / "clean.ply")
    cleaned = clean_cloud(work / "color" / "cloud.ply", work / "clear.ply")
    make_map(work / "clean.ply", work / "raw_map")
    return {
        "color": water,
        "clean": cleaned,
        "map": make_map(work / "clear.ply", work / "map"),
        "mesh": mesh_cloud(work / "clear.ply", work / "mesh"),
    }


def print_water(report: dict, spec) -> None:
    print("| 1/m, 1 is white | " + " | ".join(("red", "green", "blue")) + " | truth |")
    print("|---|---|---|---|---|")
    water, exposure = spec.water, spec.sensor.exposure
    veil = exposure * np.array(water.veil)
    rows = {
        "attenuation": ("attenuation_per_m", np.array(water.attenuation_per_m)),
        "veil near the camera": ("veil_slope_per_m", veil * water.backscatter_per_m),
        "backscatter": ("backscatter_per_m", np.array(water.backscatter_per_m)),
        "veil of open water": ("veil", veil),
    }
    for title, (key, truth) in rows.items():
        cells = []
        for channel in report["channels"].values():
            entry = channel[key]
            text = f"{entry['value']:.3f} ± {entry['stddev']:.3f}"
            cells.append(text if entry["determined"] else f"({text})")
        known = ", ".join(f"{value:.3f}" for value in truth)
        print(f"| {title} | {' | '.join(cells)} | {known} |")


def compare_colors(model: uwsfm.Model, work: Path, floor, spec) -> list[np.ndarray]:
    """Images with, without and after water; the table of their differences."""
    sensor = SensorOptions(
        exposure=spec.sensor.exposure, blur_px=spec.sensor.blur_px, samples_per_side=2
    )
    pose = rigid3.compose(known_cam_from_rig(spec.rig)[0], spec.rig_from_world[SHOWN])
    camera = spec.rig.refractive_cameras()[0]
    truth = render_image(camera, pose, floor, sensor=sensor)
    name = model.image_name(0, SHOWN)
    taken = cv2.imread(str(sample_dir() / "images" / name))[..., ::-1]
    found = cv2.imread(str(work / "color" / "images" / name))[..., ::-1]
    gains = np.array(json.loads((work / "color/water.json").read_text())["gains"])
    ours = light_of(found, "sqrt") / gains
    target, light = light_of(truth, "sqrt"), light_of(taken, "sqrt")
    # The most that a white balance could do: gains that the truth gives.
    best = np.sum(light * target, axis=(0, 1)) / np.sum(light**2, axis=(0, 1))
    shown = [taken, values_of(best * light, "sqrt"), values_of(ours, "sqrt"), truth]
    print("| off from the render without water, grey levels | RMS | median |")
    print("|---|---|---|")
    titles = ("as taken", "best white balance, knowing the truth", "uwsfm color")
    for title, image in zip(titles, shown, strict=False):
        off = image.astype(float) - truth
        rms, median = np.sqrt(np.mean(off**2)), np.median(np.abs(off))
        print(f"| {title} | {rms:.1f} | {median:.0f} |")
    return shown


def height_errors(model: uwsfm.Model, work: Path, floor, spec) -> np.ndarray:
    """Map minus true floor along the map's up (rows, columns), metres."""
    report = json.loads((work / "map" / "map.json").read_text())
    height = tifffile.imread(work / "map" / "height.tif")
    row, column = np.indices(height.shape) + 0.5
    x = report["west"] + report["resolution"] * column
    y = report["north"] - report["resolution"] * row
    pose = report["world_from_map"]
    world_from_map = np.array(pose["rotation_xyzw"] + pose["translation"])
    # The floor is where the first estimated pose is the true one.
    true_from_world = rigid3.compose(
        rigid3.inverse(spec.rig_from_world[0]), model.scene.rig_from_world[0]
    )
    true_from_map = rigid3.compose(true_from_world, world_from_map)
    above = np.stack([x.ravel(), y.ravel(), np.full(height.size, 1.0)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (len(above), 1))
    hits = floor.cast(
        rigid3.transform(true_from_map, above), rigid3.rotate(true_from_map, down)
    )
    return height - (1.0 - hits.distance).reshape(height.shape)


def view_of_mesh(work: Path, size=(900, 560)) -> np.ndarray:
    """The web copy from one side, by casting rays."""
    open3d = import_package("open3d", "a picture of the mesh", "render")
    mesh = open3d.io.read_triangle_mesh(str(work / "mesh" / "web.glb"))
    vertices = np.asarray(mesh.vertices)  # glTF: y up
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    middle, extent = np.median(vertices, axis=0), np.ptp(vertices, axis=0).max()
    eye = middle + extent * np.array([0.2, 0.8, 1.1])
    # Open3D's "up" is down in the picture.
    rays = scene.create_rays_pinhole(40.0, middle, eye, [0.0, -1.0, 0.0], *size)
    hits = scene.cast_rays(rays)
    there = np.isfinite(hits["t_hit"].numpy())
    corners = np.asarray(mesh.triangles)[hits["primitive_ids"].numpy()[there]]
    u, v = hits["primitive_uvs"].numpy()[there].T
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    colors = np.asarray(mesh.vertex_colors)[corners]
    picture = np.full((size[1], size[0], 3), 255, dtype=np.uint8)
    light = np.einsum("nc,nck->nk", weights, colors)
    picture[there] = values_of(light, "srgb")
    return picture


def draw_colors(shown: list[np.ndarray], path: Path) -> None:
    titles = (
        "as taken",
        "best white balance, knowing the truth",
        "uwsfm color",
        "rendered without water",
    )
    figure, axes = plt.subplots(2, 2, figsize=(10, 7.7), layout="constrained")
    for axis, image, title in zip(axes.flat, shown, titles, strict=True):
        axis.imshow(image)
        axis.set_title(title, size=10)
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=64)


def draw_surface(work: Path, errors: np.ndarray, path: Path) -> None:
    report = json.loads((work / "map" / "map.json").read_text())
    side = report["resolution"]
    west, north = report["west"], report["north"]
    extent = (
        west,
        west + side * report["num_columns"],
        north - side * report["num_rows"],
        north,
    )
    figure, axes = plt.subplots(2, 2, figsize=(10, 7.6), layout="constrained")
    for axis, name, title in (
        (axes[0, 0], "raw_map", "orthophoto"),
        (axes[0, 1], "map", "without water (uwsfm color)"),
    ):
        axis.imshow(tifffile.imread(work / name / "ortho.tif"), extent=extent)
        axis.set_title(title, size=10)
    drawn = axes[1, 0].imshow(
        1e3 * errors, extent=extent, cmap="RdBu", vmin=-ERROR_MM, vmax=ERROR_MM
    )
    axes[1, 0].set_title("height minus the true floor", size=10)
    figure.colorbar(drawn, ax=axes[1, 0], label="mm", shrink=0.8)
    for axis in (axes[0, 0], axes[0, 1], axes[1, 0]):
        axis.set_facecolor("0.9")
        axis.set_xlabel("x, m", size=8)
    axes[1, 1].imshow(view_of_mesh(work))
    axes[1, 1].set_title("web.glb, 100 000 triangles", size=10)
    axes[1, 1].axis("off")
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="of uwsfm demo, with a dense cloud")
    parser.add_argument("-o", "--work", type=Path, required=True)
    arguments = parser.parse_args()
    work = arguments.work
    work.mkdir(parents=True)
    reports = run(arguments.out, work)
    model = uwsfm.read_model(arguments.out)
    spec = sample_spec()
    floor = floor_in_view(spec)
    print_water(reports["color"], spec)
    shown = compare_colors(model, work, floor, spec)
    errors = height_errors(model, work, floor, spec)
    there = np.abs(errors[np.isfinite(errors)])
    grid, mesh = reports["map"], reports["mesh"]
    print(
        f"map: {grid['num_columns']} x {grid['num_rows']} cells of "
        f"{1e3 * grid['resolution']:.2g} mm, {grid['share_with_data']:.0%} with "
        f"data; off by {1e3 * np.median(there):.2f} mm (median), "
        f"{1e3 * np.percentile(there, 90):.2f} mm (90 %)"
    )
    print(
        f"mesh: {mesh['mesh']['num_triangles']} triangles, "
        f"{mesh['mesh']['area']:.2f} m2, at most "
        f"{1e3 * mesh['max_distance']:.1f} mm from a point; cleaned: "
        f"{reports['clean']['num_kept']} of {reports['clean']['num_points']} points"
    )
    draw_colors(shown, work / "color.png")
    draw_surface(work, errors, work / "surface.png")


if __name__ == "__main__":
    main()
