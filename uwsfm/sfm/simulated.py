"""Simulated dives as the front end meets them: frames, and a database of matches."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.background import opened
from uwsfm.sfm.images import Frames

MIN_MATCHES = 15
"""Images that share fewer points are not matched."""


def frames_of(rig: Rig, num_frames: int, image_dir: Path) -> Frames:
    """Frames without image files."""
    return Frames(
        image_dir=image_dir,
        folders=tuple(camera.images for camera in rig.cameras),
        names=tuple(f"{index:04d}.png" for index in range(num_frames)),
        unmatched=(),
    )


def write_features(
    path: Path, scene: Scene, frames: Frames, *, wrong: float, seed: int = 0
) -> None:
    """A features database: observations as keypoints, shared points as matches.

    Images are numbered backwards: nothing may depend on COLMAP's identifiers.

    Args:
        path: of the database.
        scene: observations.
        frames: names of the images.
        wrong: fraction of wrong matches.
        seed: of the wrong matches.
    """
    rng = np.random.default_rng(seed)
    images = [
        (c, f) for f in range(len(frames.names)) for c in range(len(frames.folders))
    ]
    keypoint_of: dict[tuple[int, int], dict[int, int]] = {}
    image_id = {place: len(images) - i for i, place in enumerate(images)}
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
        for c, f in images:
            rows = np.flatnonzero((scene.camera_idx == c) & (scene.frame_idx == f))
            points = scene.point_idx[rows].tolist()
            keypoint_of[c, f] = dict(zip(points, range(len(rows)), strict=True))
            name, new_id = frames.image_name(c, f), image_id[c, f]
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=new_id)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(new_id, scene.xy[rows].astype(np.float32))
        for a, b in combinations(images, 2):
            common = sorted(keypoint_of[a].keys() & keypoint_of[b].keys())
            if len(common) < MIN_MATCHES:
                continue
            ends = [(keypoint_of[a][p], keypoint_of[b][p]) for p in common]
            matches = np.array(ends, dtype=np.uint32)
            bad = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[bad, 1] = matches[np.roll(bad, 1), 1]  # still one to one
            database.write_matches(image_id[a], image_id[b], matches)
