"""The dense cloud of the coral, seen from three of its photographs.

    python pipelines/coral_tg5/dense.py OUT [--images DATA] [--cloud FILE]

OUT is that of pipeline.py, after ``uwsfm dense OUT``; DATA is the photographs' folder,
if it is no longer where it was. Prints the share of each view's pixels (at half size)
where the cloud has a point and the mean colours of photograph and cloud there, and
writes ``dense.jpg`` into OUT: the photographs above, the cloud below. ``--cloud`` looks
at another cloud in the same frame.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

import uwsfm
from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3

VIEWS = ("P5030263", "P5030299", "P5030341")
"""The whole coral from three sides."""
STEP = 2
"""Pixels of a photograph per pixel that a point fills."""


def seen_from(model: Model, cloud: uwsfm.Cloud, frame: int) -> np.ndarray:
    """(h, w, 3) blue, green, red of the nearest points; white where there is none."""
    camera = model.scene.cameras[0]
    pose = rigid3.compose(
        model.scene.cam_from_rig[0], model.scene.rig_from_world[frame]
    )
    there = rigid3.transform(pose, cloud.points)
    xy, valid = camera.img_from_point(there)
    height, width = camera.height // STEP, camera.width // STEP
    cell = np.floor(np.where(valid[:, None], xy, -1.0) / STEP).astype(np.int64)
    shown = valid & np.all((cell >= 0) & (cell < [width, height]), axis=1)
    order = np.flatnonzero(shown)
    order = order[np.argsort(-there[order, 2], kind="stable")]  # the nearest comes last
    image = np.full((height, width, 3), 255, dtype=np.uint8)
    image[cell[order, 1], cell[order, 0]] = cloud.colors[order, ::-1]
    return image


def covered(model: Model, cloud: uwsfm.Cloud, frame: int) -> np.ndarray:
    """Which of a view's pixels (h, w) have a point."""
    marked = cloud.select(np.ones(len(cloud), dtype=bool))
    marked.colors[:] = 0
    return np.all(seen_from(model, marked, frame) == 0, axis=2)


def _mean_color(image: np.ndarray, where: np.ndarray) -> str:
    """Red, green, blue."""
    return ", ".join(f"{level:.0f}" for level in image[where].mean(axis=0)[::-1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--cloud", type=Path)
    options = parser.parse_args()
    result = uwsfm.open_result(options.out, options.images)
    model, folder = result.model, result.require_images()
    cloud = uwsfm.read_cloud(options.cloud or options.out / "dense" / "cloud.ply")
    print(
        "| photograph | pixels with a point | red, green, blue there | of the cloud |"
    )
    print("|---|---|---|---|")
    columns = []
    for view in VIEWS:
        (frame,) = (k for k, name in enumerate(model.frame_names) if view in name)
        photograph = cv2.imread(str(folder / model.image_name(0, frame)))
        image = seen_from(model, cloud, frame)
        small = cv2.resize(photograph, image.shape[1::-1], interpolation=cv2.INTER_AREA)
        filled = covered(model, cloud, frame)
        both = (_mean_color(picture, filled) for picture in (small, image))
        print(f"| {view} | {filled.mean():.0%} | {' | '.join(both)} |")
        columns.append(np.vstack([small, image]))
    cv2.imwrite(str(options.out / "dense.jpg"), np.hstack(columns))


if __name__ == "__main__":
    main()
