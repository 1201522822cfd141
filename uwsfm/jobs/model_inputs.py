"""The COLMAP model that a job begins with, and its images: found and checked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwsfm.errors import InputError
from uwsfm.results.files import HOUSING, POINTS, SPARSE
from uwsfm.rig.rig import Rig
from uwsfm.sfm.from_colmap.colmap_model import FoundModel, find_model
from uwsfm.sfm.from_colmap.model_start import ModelStart
from uwsfm.sfm.frontend.pixels import image_fault


def found_model(source: Path) -> FoundModel:
    if not source.is_dir():
        what = "is not a folder" if source.exists() else "does not exist"
        raise InputError(f"COLMAP model {source} {what}")
    found = find_model(source)
    if found is None:
        raise InputError(
            f"{source} holds no COLMAP model: neither cameras.bin nor cameras.txt is "
            "in it, in its folder sparse or in a numbered folder of these"
        )
    return found


def is_result(model: Path) -> bool:
    """Whether a COLMAP model is that of a result folder, whose ports lie beside it."""
    beside = (HOUSING, POINTS)
    return model.name == SPARSE and all((model.parent / n).is_file() for n in beside)


def same_or_inside(folder: Path, parent: Path) -> bool:
    return folder.resolve().is_relative_to(parent.resolve())


def image_paths(images: Path, rig: Rig, names: Sequence[str]) -> list[list[Path]]:
    """[camera][frame]"""
    return [[images / camera.images / n for n in names] for camera in rig.cameras]


def check_images(images: Path, rig: Rig, start: ModelStart) -> None:
    """The images of the model are there, and the first of each camera has its size."""
    paths = image_paths(images, rig, start.model.frame_names)
    for c, item in enumerate(rig.cameras):
        there = [paths[c][f] for f in np.flatnonzero(start.model.registered[c])]
        for path in there:
            if not path.is_file():
                raise InputError(f"image {path} of the model does not exist")
        fault = image_fault(there[0], (item.camera.width, item.camera.height))
        if fault is not None:
            raise InputError(fault)
