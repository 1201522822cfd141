"""One submap: what a worker needs to make it, and what it leaves."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.frontend.background import DAMAGE, damaged
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.incremental import map_incrementally
from uwsfm.sfm.options import StartOptions

INPUT = ("num_cameras", "num_frames", "first", "xy", "image", "matches", "verified")


class Submap(NamedTuple):
    """A map of some frames; indices are those of the whole survey."""

    frames: IndexArray
    """(F',) registered ones, rising."""
    rig_from_world: Array
    """(F', 7)"""
    points: Array
    """(P, 3)"""
    keypoints: IndexArray
    """(N',) that see a point, rising."""
    point_of: IndexArray
    """(N',) the point that each sees."""
    num_seen: IndexArray
    """(F',) keypoints of each frame among them."""
    cam_from_rig: Array
    """(C, 7)"""
    ports: Array
    """(C, PORT_SIZE)"""
    lenses: Array
    """(C, LENS_SIZE)"""


def write_input(path: Path, of: Correspondences, frames: IndexArray) -> None:
    """Write the matches within some frames (n,), and the keypoints that they join."""
    there = np.zeros(of.num_frames, dtype=bool)
    there[frames] = True
    inside = there[of.frame[of.matches]].all(axis=1)
    keypoints, matches = np.unique(of.matches[inside], return_inverse=True)
    local = np.searchsorted(frames, of.frame[keypoints])
    image = local * of.num_cameras + of.camera[keypoints]
    arrays: dict[str, Any] = {
        "num_cameras": of.num_cameras,
        "num_frames": len(frames),
        "first": np.searchsorted(image, np.arange(len(frames) * of.num_cameras + 1)),
        "xy": of.xy[keypoints],
        "image": image,
        "matches": matches.reshape(-1, 2),
        "verified": of.verified[inside],
    }
    with replaced_file(path) as partial, partial.open("wb") as file:
        np.savez(file, frames=frames, keypoints=keypoints, **arrays)


def map_submap(
    input_path: Path,
    output_path: Path,
    rig: Rig,
    cam_from_rig: Array,
    options: StartOptions,
) -> None:
    """Map what `write_input` wrote; frames that join no map are in none.

    Args:
        input_path: Is left as it is.
        output_path: Receives the maps, whole or not at all.
        rig: As of `map_incrementally`.
        cam_from_rig: (C, 7)
        options: Those of the mapping.
    """
    with np.load(input_path) as stored:
        fields = {name: stored[name] for name in INPUT}
        frames, keypoints = stored["frames"], stored["keypoints"]
    for name in ("num_cameras", "num_frames"):
        fields[name] = int(fields[name])
    try:
        maps = map_incrementally(Correspondences(**fields), rig, cam_from_rig, options)
    except UwsfmError:  # its frames may be in the neighbours' maps
        maps = []
    arrays = {}
    for index, growing in enumerate(maps):
        submap = _in_survey(growing, frames, keypoints)
        arrays.update({f"{index}.{n}": a for n, a in submap._asdict().items()})
    with replaced_file(output_path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def _in_survey(
    growing: GrowingMap, frames: IndexArray, keypoints: IndexArray
) -> Submap:
    registered = np.flatnonzero(growing.registered)
    seen = np.flatnonzero(growing.point_of >= 0)
    return Submap(
        frames=frames[registered],
        rig_from_world=growing.rig_from_world[registered],
        points=growing.points,
        keypoints=keypoints[seen],
        point_of=growing.point_of[seen],
        num_seen=np.bincount(
            growing.correspondences.frame[seen], minlength=len(frames)
        )[registered],
        cam_from_rig=growing.cam_from_rig,
        ports=np.array([camera.port.row for camera in growing.cameras]),
        lenses=np.array([camera.lens for camera in growing.cameras]),
    )


def read_submaps(path: Path) -> list[Submap]:
    """The maps of `map_submap`, the largest first.

    Raises:
        UwsfmError: the file is damaged.
    """
    try:
        with np.load(path) as stored:
            count = len(stored.files) // len(Submap._fields)
            return [
                Submap(*(stored[f"{index}.{name}"] for name in Submap._fields))
                for index in range(count)
            ]
    except DAMAGE as error:
        raise damaged(path, error) from None
