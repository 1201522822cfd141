"""What a reconstruction leaves on disk, and how it is read back."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uwsfm._base.checksums import check_checksums
from uwsfm._base.files import read_json, replaced_dir
from uwsfm._base.ply import write_ply
from uwsfm.cloud import UNKNOWN_UNIT
from uwsfm.colmap.model import (
    Model,
    from_reconstruction,
    read_reconstruction,
    to_reconstruction,
    write_model,
)
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.calibration_file import RUN_AGAIN
from uwsfm.rig.file import load_rig

SPARSE, HOUSING, POINTS, SUMMARY = (
    "sparse",
    "housing.yaml",
    "points.ply",
    "summary.json",
)
RIG_GIVEN = "rig_given.yaml"
"""The rig file that a result was made with, every number as it was given."""
HOUSING_SUMMARY = "calibration.json"
"""What `uwsfm calibrate` writes in the place of a model and its summary."""
MAX_SUMMARY = 100_000_000
"""Bytes of summary.json: far more than that of a thousand dives."""
WORK = "uwsfm-work"
"""Folder inside the output folder where the steps keep their results."""


def read_model(folder: str | Path) -> Model:
    """Read the output folder of `uwsfm reconstruct`.

    Raises:
        InputError: the folder lacks the model or the housing, or they do not agree.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    made = (folder / SPARSE).is_dir() or (folder / SUMMARY).is_file()
    if not made and (folder / WORK).is_dir():
        raise InputError(
            f"{folder} holds no result yet: its run was stopped; give the same command "
            "again, which goes on"
        )
    reconstruction = read_reconstruction(folder / SPARSE)
    check_checksums(folder / HOUSING)
    return from_reconstruction(reconstruction, load_rig(folder / HOUSING))


def read_summary(folder: str | Path) -> dict[str, Any] | None:
    """summary.json of a result folder; None if there is none.

    Raises:
        InputError: it is damaged.
    """
    path = Path(folder) / SUMMARY
    if not path.exists():
        return None
    try:
        summary = read_json(path, MAX_SUMMARY)
    except InputError:
        summary = None
    if not isinstance(summary, dict):
        raise InputError(f"{path} is damaged: {RUN_AGAIN}")
    return summary


def unit_of_model(folder: str | Path) -> str:
    """What the lengths of a result are in, by its summary; `UNKNOWN_UNIT` without.

    Raises:
        InputError: the summary is damaged.
    """
    summary = read_summary(folder) or {}
    return summary.get("scale", {}).get("unit", UNKNOWN_UNIT)


def export_colmap(model: Model, folder: str | Path) -> None:
    """Write a COLMAP binary model: cameras, rigs, frames, images, points3D."""
    reconstruction = to_reconstruction(model)
    with replaced_dir(Path(folder)) as partial:
        write_model(reconstruction, partial)


def export_ply(
    model: Model,
    path: str | Path,
    points_cov: ArrayLike | None = None,
    *,
    unit: str = "metre",
) -> None:
    """Write the points as a binary PLY.

    Properties: x y z (float, metres, world), red green blue (uchar), id (int, of
    COLMAP's model), track_length (int), reprojection_error_px (float, mean true error)
    and depth_stddev_m (float).

    Args:
        model: what to write.
        path: the file.
        points_cov: (P, 3, 3) covariances; without them there is no depth_stddev_m.
        unit: of lengths, for the comment in the file.
    """
    scene = model.scene
    fields: list[tuple[str, str]] = [(axis, "<f4") for axis in "xyz"]
    fields += [(color, "u1") for color in ("red", "green", "blue")]
    fields += [("id", "<i4"), ("track_length", "<i4")]
    fields += [("reprojection_error_px", "<f4")]
    if points_cov is not None:
        fields.append(("depth_stddev_m", "<f4"))
    rows = np.zeros(scene.num_points, dtype=fields)
    for index, axis in enumerate("xyz"):
        rows[axis] = scene.points[:, index]
    for index, color in enumerate(("red", "green", "blue")):
        rows[color] = model.colors[:, index]
    count = np.bincount(scene.point_idx, minlength=scene.num_points)
    total = np.bincount(scene.point_idx, model.errors_px(), minlength=scene.num_points)
    rows["id"] = np.arange(scene.num_points) + 1  # as `to_reconstruction` counts
    rows["track_length"] = count
    rows["reprojection_error_px"] = total / np.maximum(count, 1)
    if points_cov is not None:
        rows["depth_stddev_m"] = depth_stddev(model, np.asarray(points_cov, float))
    comment = f"unit: {unit}; made by uwsfm"
    write_ply(Path(path), [("vertex", rows)], comment=comment)


def depth_stddev(model: Model, points_cov: Array) -> Array:
    """Standard deviation of the points along the mean line of sight (P,), metres."""
    scene = model.scene
    cam_from_world = rigid3.compose(
        scene.cam_from_rig[scene.camera_idx], scene.rig_from_world[scene.frame_idx]
    )
    centers = rigid3.inverse(cam_from_world)[:, 4:]
    sight = scene.points[scene.point_idx] - centers
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    mean = np.zeros_like(scene.points)
    np.add.at(mean, scene.point_idx, sight)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    return np.sqrt(np.einsum("pi,pij,pj->p", mean, points_cov, mean))
