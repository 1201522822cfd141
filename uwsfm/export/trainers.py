"""What trainers of radiance fields want beside a COLMAP model of pinholes.

Names: the reference implementation of Gaussian splatting looks for images by their
last part alone, and tells them apart by what stands before the first dot in it.
`transforms.json`: nerfstudio's format, in the world of the model, which is not turned.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from uwsfm._base.ply import RGB, XYZ, stacked_rows, write_ply
from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.summary import write_json

TRANSFORMS = "transforms.json"
POINTS = "sparse_pc.ply"
IMAGES, MASKS = "images", "masks"

Place = tuple[int, int]
"""Camera and frame of an image."""


def image_places(model: Model) -> list[Place]:
    """Camera and frame of the images that are there, camera by camera."""
    shape = len(model.scene.cameras), model.scene.num_frames
    return [(c, f) for c, f in np.ndindex(shape) if model.has_image(c, f)]


def image_names(model: Model, *, flat: bool) -> dict[Place, str]:
    """Names of the images of an export, by camera and frame.

    Args:
        model: whose images they are.
        flat: without folders: ``left_0001.jpg`` for ``left/0001.jpg``. They differ
            before their only dot.
    """
    names = {place: model.image_name(*place) for place in image_places(model)}
    if not flat:
        return names
    paths = [PurePosixPath(name) for name in names.values()]
    stems = [
        "_".join([*path.parent.parts, path.stem]).replace(".", "_") for path in paths
    ]
    if len(set(stems)) < len(stems):
        stems = [f"{number:06d}_{stem}" for number, stem in enumerate(stems)]
    return {
        place: stem + path.suffix
        for place, stem, path in zip(names, stems, paths, strict=True)
    }


def mask_names(image_name: str, *, flat: bool) -> list[str]:
    """Names of an image's mask, white where the image is good.

    COLMAP's is ``0001.jpg.png``; flat ones are there as ``0001.png`` too, as trainers
    that look for the same stem want them.
    """
    names = [f"{image_name}.png"]
    if flat:
        names.append(PurePosixPath(image_name).with_suffix(".png").as_posix())
    return names


def write_transforms(
    folder: Path, model: Model, names: Mapping[Place, str], *, flat: bool
) -> None:
    """Write nerfstudio's ``transforms.json`` and the points that it names.

    Args:
        folder: of the export, with ``images`` and ``masks``.
        model: of pinholes.
        names: of its images.
        flat: as of `mask_names`.
    """
    frames = []
    for (camera, frame), name in names.items():
        pose = rigid3.compose(
            model.scene.cam_from_rig[camera], model.scene.rig_from_world[frame]
        )
        entry: dict[str, Any] = {
            "file_path": f"{IMAGES}/{name}",
            "mask_path": f"{MASKS}/{mask_names(name, flat=flat)[-1]}",
            "transform_matrix": _world_from_opengl(pose).tolist(),
        }
        frames.append(entry | _intrinsics(model, camera))
    write_json(
        {"camera_model": "PINHOLE", "ply_file_path": POINTS, "frames": frames},
        folder / TRANSFORMS,
    )
    _write_points(folder / POINTS, model)


def _world_from_opengl(cam_from_world: Array) -> Array:
    """(4, 4) camera to world, of a camera that looks along -z with y upwards."""
    pose = rigid3.inverse(cam_from_world)
    matrix = np.eye(4)
    matrix[:3, :3] = rigid3.rotmat_from_quat(pose[:4]) * [1.0, -1.0, -1.0]
    matrix[:3, 3] = pose[4:]
    return matrix


def _intrinsics(model: Model, camera: int) -> dict[str, float]:
    lens = model.rig.cameras[camera].camera
    focal_x, focal_y, x, y = (float(value) for value in lens.params)
    return {
        "fl_x": focal_x,
        "fl_y": focal_y,
        "cx": x,
        "cy": y,
        "w": lens.width,
        "h": lens.height,
    }


def _write_points(path: Path, model: Model) -> None:
    table = stacked_rows(XYZ + RGB, [model.scene.points], [model.colors])
    write_ply(path, [("vertex", table)], comment="points of the model; uwsfm")
