"""Features and matches as tasks for workers elsewhere.

On one machine, threads do the same without a copy. A worker keeps its database on a
disk of its own: SQLite's locks cannot be trusted on folders that machines share. What
it found goes to a file of the workspace, and this process alone writes the database.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.disk import require_room
from uwsfm._base.files import replaced_file
from uwsfm._base.partial import scratch_folder
from uwsfm._base.progress import Progress, silent
from uwsfm._base.tasks import Workers
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import DAMAGE, damaged, opened, remove_database
from uwsfm.sfm.frontend.features import COLORS, extract_images, require_features
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.frontend.match_blocks import (
    Pair,
    match_block,
    pair_blocks,
    scratch_bytes,
)
from uwsfm.sfm.frontend.matching import chosen_pairs
from uwsfm.sfm.options import FeatureOptions, MatchOptions, StartOptions
from uwsfm.sfm.steps import fingerprint

BLOCK_FRAMES = 16
"""Whose features one task finds."""
FEATURES = "features"
MATCHES = "matches"


def workers_of(options: StartOptions, work_dir: Path) -> Workers:
    """The workers that some options ask for."""
    return Workers(options.scheduler, work_dir, options.threads)


def extract_elsewhere(
    frames: Frames,
    rig: Rig,
    database_path: Path,
    options: FeatureOptions,
    workers: Workers,
    progress: Progress = silent,
) -> None:
    """`extract_features` by workers; blocks that an interrupted run left are kept.

    Raises:
        InputError: an image cannot be read; names it.
        UwsfmError: no image has a feature.
    """
    folder = database_path.absolute().parent / FEATURES
    frames = replace(frames, image_dir=frames.image_dir.absolute())
    workers.require_sight(frames.image_dir / next(frames.image_names()))
    if options.mask_dir is not None:
        mask_dir = Path(options.mask_dir).absolute()
        options = replace(options, mask_dir=mask_dir)
        workers.require_sight(mask_dir)
    num_frames = len(frames.names)
    blocks = [
        replace(frames, names=frames.names[k : k + BLOCK_FRAMES])
        for k in range(0, num_frames, BLOCK_FRAMES)
    ]
    paths = [folder / f"{k:05d}.db" for k in range(len(blocks))]
    todo = [k for k, path in enumerate(paths) if not path.exists()]
    workers.run(
        extract_block,
        [(blocks[k], rig, paths[k], options) for k in todo],
        "features",
        _counting(progress, len(blocks) - len(todo), len(blocks)),
    )
    remove_database(database_path)
    with replaced_file(database_path) as partial:
        _join(partial, paths, frames)
    require_features(frames, database_path)
    shutil.rmtree(folder)


def extract_block(
    frames: Frames, rig: Rig, path: Path, options: FeatureOptions
) -> None:
    """Features of some frames in a database of their own."""
    with scratch_folder() as own:
        database_path = own / "block.db"
        colors_dir = path.parent.parent / COLORS
        extract_images(frames, rig, database_path, colors_dir, options, num_threads=1)
        with replaced_file(path) as partial:
            shutil.copyfile(database_path, partial)


def _join(path: Path, parts: Sequence[Path], frames: Frames) -> None:
    """One database of the images of several, one camera per folder."""
    camera_of = {folder: c + 1 for c, folder in enumerate(frames.folders)}
    written: set[int] = set()
    next_id = 1
    with opened(path) as target, pycolmap.DatabaseTransaction(target):
        for part in parts:
            with opened(part) as source:
                images = sorted(source.read_all_images(), key=lambda image: image.name)
                for image in images:
                    camera_id = camera_of[image.name.rpartition("/")[0]]
                    if camera_id not in written:
                        camera = source.read_camera(image.camera_id)
                        camera.camera_id = camera_id
                        target.write_camera(camera, use_camera_id=True)
                        written.add(camera_id)
                    old, new = image.image_id, next_id
                    next_id += 1
                    target.write_image(
                        pycolmap.Image(
                            name=image.name, camera_id=camera_id, image_id=new
                        ),
                        use_image_id=True,
                    )
                    if source.exists_keypoints(old):
                        target.write_keypoints(new, source.read_keypoints(old))
                        target.write_descriptors(new, source.read_descriptors(old))


def match_elsewhere(
    frames: Frames,
    database_path: Path,
    options: MatchOptions,
    workers: Workers,
    progress: Progress = silent,
) -> None:
    """`match_features` by workers, with COLMAP's matcher; finished blocks are kept."""
    folder = database_path.absolute().parent / MATCHES
    folder.mkdir(exist_ok=True)
    names = chosen_pairs(frames, database_path, options)
    with opened(database_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        pairs = [(ids[a], ids[b]) for a, b in names]
        todo = [pair for pair in pairs if not database.exists_matches(*pair)]
        blocks = pair_blocks(todo, [ids[name] for name in frames.image_names()], 1)
        paths = [folder / f"{fingerprint(block)}.npz" for block in blocks]
        missing = [k for k, path in enumerate(paths) if not path.exists()]
        for image in {i for k in missing for pair in blocks[k] for i in pair}:
            path = _descriptors_path(folder, image)
            if not path.exists():
                with replaced_file(path) as partial, partial.open("wb") as file:
                    np.save(file, database.read_descriptors(image).data)
    workers.run(
        match_task,
        [(folder, blocks[k], paths[k]) for k in missing],
        "matching",
        _counting(progress, len(blocks) - len(missing), len(blocks)),
    )
    with opened(database_path) as database, pycolmap.DatabaseTransaction(database):
        for block, path in zip(blocks, paths, strict=True):
            try:
                with np.load(path) as stored:
                    matches = [stored[name] for name in stored.files]
            except DAMAGE as error:
                raise damaged(path, error) from None
            for (a, b), found in zip(block, matches, strict=True):
                database.write_matches(a, b, found)
    shutil.rmtree(folder)


def match_task(folder: Path, block: Sequence[Pair], path: Path) -> None:
    """Match the pairs of a block, whose descriptors are files."""
    descriptors = {
        image: np.load(_descriptors_path(folder, image))
        for image in sorted({image for pair in block for image in pair})
    }
    with scratch_folder() as own:
        require_room(own, scratch_bytes(descriptors, len(block)), "matching")
        found = match_block(descriptors, block, own)
    with replaced_file(path) as partial, partial.open("wb") as file:
        np.savez(file, *found)


def _descriptors_path(folder: Path, image_id: int) -> Path:
    return folder / f"descriptors-{image_id}.npy"


def _counting(progress: Progress, before: int, total: int) -> Progress:
    """Tasks that are done, with those of an interrupted run."""

    def report(step: str, done: int, _: int | None) -> None:
        progress(step, before + done, total)

    return report
