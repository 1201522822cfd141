"""What refraction is left in the warped images of the sample, at every pixel.

    uwsfm demo -o out && python pipelines/sample/exports.py out -o exports.png

The rendered floor is known, so the depth of every pixel is: where its ray hits the
mesh. It takes the place of the interpolated depth, and the difference in the virtual
pixel is the error of the warped image. Needs '.[render]'.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np

import uwsfm
from uwsfm.export.image_depth import ImageDepth
from uwsfm.export.pinhole import PinholeModel, pinhole_model, virtual_from_img
from uwsfm.export.warp import read_image, warp_image, warp_maps
from uwsfm.geometry import rigid3
from uwsfm.jobs.demo import sample_dir
from uwsfm.simulate.sequence import floor_in_view, sample_spec

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

STEP_PX = 4
PAINT_M = 0.01
SHOWN = (1, 0)  # camera, frame: the one with the largest errors
MAX_PX = 0.3


def true_floor():
    """The mesh of the sample, roughly painted: only its shape matters here."""
    spec = sample_spec()
    shape = replace(spec, floor=replace(spec.floor, texel=PAINT_M))
    return floor_in_view(shape), spec.rig_from_world[0]


def errors_of(
    model: uwsfm.Model, found: PinholeModel, camera: int, frame: int, floor, true_pose
):
    """At a grid of real pixels: where they belong (N, 2), and the errors (N, 2) of the
    interpolated depth and of one depth for all, and whether points surround them."""
    scene, pinhole = model.scene, found.pinholes[camera]
    lens, depth = scene.cameras[camera], found.depths[camera][frame]
    x, y = (np.arange(STEP_PX / 2, side, STEP_PX) for side in (lens.width, lens.height))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    origins, dirs = lens.ray_from_img(grid)
    # The floor is where the first estimated pose is the true one.
    true_from_world = rigid3.compose(rigid3.inverse(true_pose), scene.rig_from_world[0])
    cam_from_world = rigid3.compose(
        scene.cam_from_rig[camera], scene.rig_from_world[frame]
    )
    true_from_cam = rigid3.compose(true_from_world, rigid3.inverse(cam_from_world))
    hits = floor.cast(
        rigid3.transform(true_from_cam, origins), rigid3.rotate(true_from_cam, dirs)
    )
    points = origins + hits.distance[:, None] * dirs - pinhole.center_in_cam
    belongs = pinhole.focal_px * points[:, :2] / points[:, 2:] + pinhole.principal_point
    constant_depth = 1.0 / (pinhole.depth - pinhole.center_in_cam[2])
    constant = ImageDepth([], [], (0, 0), constant_depth)
    shown = [virtual_from_img(lens, pinhole, grid, d) for d in (depth, constant)]
    surrounded = depth.is_between_points(shown[0])
    return belongs, shown[0] - belongs, shown[1] - belongs, surrounded


def print_row(name: str, errors) -> None:
    lengths = np.linalg.norm(errors, axis=1)
    rms, worst = np.sqrt(np.mean(lengths**2)), lengths.max()
    print(f"| {name} | {rms:.4f} | {np.percentile(lengths, 99):.3f} | {worst:.3f} |")


def draw(model: uwsfm.Model, found: PinholeModel, errors, path: Path) -> None:
    """The warped image under the errors of both, arrows 100 times as long."""
    camera, frame = SHOWN
    lens, pinhole = model.scene.cameras[camera], found.pinholes[camera]
    image = read_image(sample_dir() / "images" / model.image_name(camera, frame), lens)
    maps, _ = warp_maps(lens, pinhole, found.depths[camera][frame])
    grey = cv2.cvtColor(warp_image(image, maps), cv2.COLOR_BGR2GRAY)
    belongs, interpolated, constant, _ = errors
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    titles = ("One depth for all images", "The depth between the points")
    for axis, error, title in zip(axes, (constant, interpolated), titles, strict=True):
        axis.imshow(grey, cmap="gray", extent=(0, pinhole.width, pinhole.height, 0))
        lengths = np.linalg.norm(error, axis=1)
        dots = axis.scatter(
            *belongs.T, c=lengths, s=2, cmap="inferno", vmin=0, vmax=MAX_PX, alpha=0.35
        )
        rows = np.arange(len(error)).reshape(-1, lens.width // STEP_PX)
        few = rows[5::10, 5::10].ravel()
        axis.quiver(
            *belongs[few].T,
            *(100.0 * error[few]).T,
            color="white",
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.003,
        )
        rms = np.sqrt(np.mean(lengths**2))
        axis.set_title(f"{title}: {rms:.3f} px RMS, {lengths.max():.2f} max", size=10)
        axis.set(xticks=[], yticks=[], xlim=(0, pinhole.width))
        axis.set_ylim(pinhole.height, 0)
    figure.colorbar(dots, ax=axes, label="refraction left, px (arrows x 100)")
    figure.savefig(path, dpi=75)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="output folder of uwsfm demo")
    parser.add_argument("-o", "--picture", type=Path, required=True)
    arguments = parser.parse_args()
    model = uwsfm.read_model(arguments.out)
    found = pinhole_model(model)
    floor, true_pose = true_floor()
    places = np.ndindex(len(model.scene.cameras), model.scene.num_frames)
    errors = {c: errors_of(model, found, *c, floor, true_pose) for c in places}
    _, interpolated, constant, surrounded = (
        np.concatenate(columns) for columns in zip(*errors.values(), strict=True)
    )
    print("| pixels of all images | RMS, px | 99 %, px | max, px |")
    print("|---|---|---|---|")
    print_row("one depth per camera", constant)
    print_row("depth between the points", interpolated)
    print_row("of these, surrounded by points", interpolated[surrounded])
    print_row("outside of them", interpolated[~surrounded])
    draw(model, found, errors[SHOWN], arguments.picture)


if __name__ == "__main__":
    main()
