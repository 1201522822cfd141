"""Simulated dives as the front end meets them: frames, and a database of matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import csr_array, triu

from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import Frames

MIN_MATCHES = 15
"""Images that share fewer points are not matched."""


def frames_of(rig: Rig, num_frames: int, image_dir: Path) -> Frames:
    """Frames without image files."""
    return Frames(
        image_dir=image_dir,
        folders=tuple(camera.images for camera in rig.cameras),
        names=tuple(f"{index:04d}.png" for index in range(num_frames)),
    )


def write_features(
    path: Path, scene: Scene, frames: Frames, *, wrong: float, seed: int = 0
) -> None:
    """A features database: observations as keypoints, shared points as matches.

    Images are numbered backwards: nothing may depend on COLMAP's identifiers.

    Args:
        path: of the database.
        scene: observations, none of them in an image that is not there.
        frames: names of the images.
        wrong: fraction of wrong matches.
        seed: of the wrong matches.
    """
    rng = np.random.default_rng(seed)
    images = [
        (c, f) for f in range(len(frames.names)) for c in range(len(frames.folders))
    ]
    image_of = scene.frame_idx * len(frames.folders) + scene.camera_idx
    order = np.argsort(image_of, kind="stable")
    first = np.searchsorted(image_of[order], np.arange(len(images) + 1))
    rows_of = [order[first[i] : first[i + 1]] for i in range(len(images))]
    image_id = [len(images) - i for i in range(len(images))]
    with opened(path) as database, pycolmap.DatabaseTransaction(database):
        for c, camera in enumerate(scene.cameras):
            lens = pycolmap.Camera(
                camera_id=c + 1,
                model=camera.camera.model_name,
                width=camera.width,
                height=camera.height,
                params=camera.camera.params,
            )
            database.write_camera(lens, use_camera_id=True)
        for (c, f), rows, new_id in zip(images, rows_of, image_id, strict=True):
            if not frames.has_image(c, f):
                continue
            name = frames.image_name(c, f)
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=new_id)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(new_id, scene.xy[rows].astype(np.float32))
        for a, b in _overlapping(image_of, scene.point_idx):
            of_a, of_b = (scene.point_idx[rows_of[i]] for i in (a, b))
            _, *ends = np.intersect1d(
                of_a, of_b, assume_unique=True, return_indices=True
            )
            matches = np.column_stack(ends).astype(np.uint32)
            bad = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[bad, 1] = matches[np.roll(bad, 1), 1]  # still one to one
            database.write_matches(image_id[a], image_id[b], matches)


def _overlapping(image_of: IndexArray, point_idx: IndexArray) -> list[list[int]]:
    """Pairs of images that share enough points, in the order of the images."""
    sees = csr_array((np.ones(len(image_of), dtype=np.int32), (image_of, point_idx)))
    shared = triu(sees @ sees.T, k=1).tocsr()
    shared.sort_indices()
    pairs = shared.tocoo()
    enough = pairs.data >= MIN_MATCHES
    return np.column_stack([pairs.row, pairs.col])[enough].tolist()
