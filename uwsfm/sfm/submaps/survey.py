"""A survey too large for one map: split, mapped part by part, merged."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm._base.progress import Progress, silent
from uwsfm._base.tasks import Workers
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.frontend.background import DAMAGE, damaged
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.submaps.splitting import split
from uwsfm.sfm.submaps.submap import Submap, map_submap, read_submaps, write_input

PARTS = "parts.npz"


def map_parts(
    correspondences: Correspondences,
    rig: Rig,
    cam_from_rig: Array,
    max_frames: int,
    options: StartOptions,
    folder: Path,
    workers: Workers,
    progress: Progress = silent,
) -> None:
    """Split a survey and map its parts; those that are finished are not made again.

    Args:
        correspondences: Of the whole survey.
        rig: As of `map_incrementally`.
        cam_from_rig: (C, 7) that fits the initial ports.
        max_frames: That a part may have, without those it borrows.
        options: Those of the mapping.
        folder: Receives a file per part; all workers see it.
        workers: Who maps.
        progress: Called with the step "submaps", in parts.
    """
    folder = folder.absolute()  # workers have other places of their own
    parts = _parts(folder / PARTS, correspondences, max_frames)
    todo = [k for k in range(len(parts)) if not submap_path(folder, k).exists()]
    for k in todo:
        write_input(_input_path(folder, k), correspondences, parts[k])
    arguments = [
        (_input_path(folder, k), submap_path(folder, k), rig, cam_from_rig, options)
        for k in sorted(todo, key=lambda k: -len(parts[k]))  # the longest first
    ]
    begun = len(parts) - len(todo)
    workers.run(
        map_submap,
        arguments,
        "submaps",
        lambda step, done, _: progress(step, begun + done, len(parts)),
    )
    for k in range(len(parts)):
        _input_path(folder, k).unlink(missing_ok=True)


def submap_path(folder: Path, index: int) -> Path:
    return folder / f"{index:03d}.npz"


def _input_path(folder: Path, index: int) -> Path:
    return folder / f"{index:03d}-matches.npz"


def read_all(folder: Path) -> list[Submap]:
    """The maps of all parts; a part may have none, or several.

    Raises:
        UwsfmError: a file is damaged.
    """
    count = len(_read_parts(folder / PARTS))
    return [m for k in range(count) for m in read_submaps(submap_path(folder, k))]


def _parts(
    path: Path, correspondences: Correspondences, max_frames: int
) -> Sequence[IndexArray]:
    """Frames of each part, as an interrupted run has split them, or anew."""
    if not path.exists():
        parts = split(correspondences.links(correspondences.verified), max_frames)
        arrays = {f"{k:03d}": part.frames for k, part in enumerate(parts)}
        with replaced_file(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
    return _read_parts(path)


def _read_parts(path: Path) -> list[IndexArray]:
    try:
        with np.load(path) as stored:
            return [stored[name] for name in stored.files]
    except DAMAGE as error:
        raise damaged(path, error) from None
