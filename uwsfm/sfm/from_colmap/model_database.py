"""What COLMAP's database knows beyond a model: more matches, and images that it lost.

Pinholes verified the matches and registered the images; with the ports calibrated,
water rays decide again, on all matches, which tracks there are and which frames fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.paths import check_image_names
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.from_colmap.colmap_model import ImageModel, places_in_rig
from uwsfm.sfm.from_colmap.model_points import copied_database
from uwsfm.sfm.from_colmap.model_start import Tracks
from uwsfm.sfm.frontend.images import natural_key
from uwsfm.sfm.mapping.adjustment import adjust_locally, neighbours
from uwsfm.sfm.mapping.correspondences import Correspondences, in_rows
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.registration import Ranking, register_next
from uwsfm.sfm.refine import MAX_ERROR_PX, Refined
from uwsfm.sfm.scene_points import MIN_ANGLE_DEG

SAME_PIXEL = 0.01
"""Databases hold pixels in single precision."""
MIN_INLIERS = 12
"""Of a frame that the model lacks: the map is good to a fraction of a pixel, so that
fewer points are enough than while it grows."""
SEED = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageDatabase:
    """Keypoints and matches of all images of a rig's folders."""

    frame_names: tuple[str, ...]
    """(F,) of all images, in the model or not, in natural order."""
    correspondences: Correspondences
    model_idx: IndexArray
    """(N,) index of each keypoint's observation in the `ImageModel`; -1: none."""
    warnings: tuple[str, ...]
    """What the user should know, one sentence each."""


def read_image_database(path: Path, model: ImageModel, rig: Rig) -> ImageDatabase:
    """Read a database that a model was made from.

    Raises:
        InputError: not a database, or one of other images or features.
    """
    with copied_database(path) as database:
        return _read(path, database, model, rig)


def _read(
    path: Path, database: pycolmap.Database, model: ImageModel, rig: Rig
) -> ImageDatabase:
    folders = [camera.images for camera in rig.cameras]
    ids = {image.name: image.image_id for image in database.read_all_images()}
    check_image_names(path, ids)
    places = {ids[name]: place for name, place in places_in_rig(list(ids), rig).items()}
    stray = sorted(name for name in ids if ids[name] not in places)
    names = sorted(
        {name for _, name in places.values()} | set(model.frame_names), key=natural_key
    )
    index_of = {name: index for index, name in enumerate(names)}
    keypoints = [np.empty((0, 2)) for _ in range(len(names) * len(folders))]
    image_of = {}
    for image_id, (camera, name) in places.items():
        image_of[image_id] = index_of[name] * len(folders) + camera
        xy = database.read_keypoints(image_id)[:, :2].astype(np.float64)
        keypoints[image_of[image_id]] = xy.reshape(-1, 2)
    first = np.concatenate([[0], np.cumsum([len(xy) for xy in keypoints])])
    matches, verified = _matches(database, image_of, first)
    frames = np.array([index_of[name] for name in model.frame_names])
    images = frames[model.frame_idx] * len(folders) + model.camera_idx
    _require_same(path, model, rig, keypoints, frames)
    model_idx = np.full(first[-1], -1, dtype=np.int64)
    model_idx[first[images] + model.keypoint_idx] = np.arange(len(images))
    return ImageDatabase(
        frame_names=tuple(names),
        correspondences=Correspondences(
            num_cameras=len(folders),
            num_frames=len(names),
            first=first,
            xy=np.concatenate(keypoints),
            image=np.repeat(np.arange(len(keypoints)), np.diff(first)),
            matches=matches,
            verified=verified,
        ),
        model_idx=model_idx,
        warnings=(
            (
                f"{len(stray)} images of the database were left out, for instance "
                f"{stray[0]}: they are in no folder of the rig",
            )
            if stray
            else ()
        ),
    )


def _matches(
    database: pycolmap.Database, image_of: dict[int, int], first: IndexArray
) -> tuple[IndexArray, np.ndarray]:
    """Keypoints (M, 2) that match, raw or verified, and which are verified (M,)."""
    raw = dict(zip(*database.read_all_matches(), strict=True))
    good = {
        pair_id: geometry.inlier_matches
        for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True)
    }
    none = np.empty((0, 2), dtype=np.uint32)
    pairs, flags = [none.astype(np.int64)], [np.empty(0, dtype=bool)]
    for pair_id in sorted(raw.keys() | good.keys()):
        ids = pycolmap.pair_id_to_image_pair(pair_id)
        if not all(image_id in image_of for image_id in ids):
            continue
        inliers = good.get(pair_id, none).reshape(-1, 2)
        rows = np.unique(  # guided matching verifies what was not matched before
            np.concatenate([raw.get(pair_id, none).reshape(-1, 2), inliers]), axis=0
        )
        images = np.array([image_of[image_id] for image_id in ids])
        ends = first[images] + rows.astype(np.int64)
        pairs.append(ends if images[0] < images[1] else ends[:, ::-1])
        flags.append(in_rows(rows, inliers))
    return np.concatenate(pairs), np.concatenate(flags)


def _require_same(
    path: Path,
    model: ImageModel,
    rig: Rig,
    keypoints: list[Array],
    frames: IndexArray,
) -> None:
    """Refuse a database whose keypoints are not those of the model."""
    for c, f in np.argwhere(model.registered).tolist():
        mine = model.keypoints[c][f]
        theirs = keypoints[frames[f] * len(rig.cameras) + c]
        name = f"{rig.cameras[c].images}/{model.frame_names[f]}"
        if len(mine) != len(theirs):
            raise InputError(
                f"{path} is not the database of {model.folder}: image {name} has "
                f"{len(theirs)} keypoints in it, {len(mine)} in the model"
            )
        if np.any(np.abs(mine - theirs) > SAME_PIXEL):
            raise InputError(
                f"{path} is not the database of {model.folder}: the keypoints of image "
                f"{name} are others"
            )


def with_database(
    known: ImageDatabase,
    refined: Refined,
    frame_names: tuple[str, ...],
    progress: Progress = silent,
) -> Tracks:
    """Make the tracks again from all matches, and register the frames that fit.

    Args:
        known: Keypoints and matches.
        refined: Ports, rig and frames, as far as the model went.
        frame_names: (F,) of the frames of ``refined``.
        progress: Called with the step "registering", in frames.
    """
    of, scene = known.correspondences, refined.scene
    growing = GrowingMap(
        of, scene.cameras, scene.cam_from_rig, float(np.radians(MIN_ANGLE_DEG))
    )
    index_of = {name: index for index, name in enumerate(known.frame_names)}
    there = np.unique(scene.frame_idx)
    frames = np.array([index_of[frame_names[f]] for f in there])
    poses = growing.rig_from_world.copy()
    poses[frames] = scene.rig_from_world[there]
    growing.place(frames, poses)
    growing.retriangulate(MAX_ERROR_PX)
    ranking = Ranking(growing, MIN_INLIERS)
    while True:
        progress("registering", growing.num_registered, of.num_frames)
        added = register_next(growing, ranking, MAX_ERROR_PX, SEED)
        if added is None:
            break
        points = adjust_locally(growing, neighbours(growing, added))
        growing.filter(points, MAX_ERROR_PX)
    growing.finish_points(MAX_ERROR_PX)
    scene, seen = growing.scene()
    keypoints = [
        of.xy[of.first[image] : of.first[image + 1]]
        for image in range(of.num_frames * of.num_cameras)
    ]
    return Tracks(
        scene=scene,
        frame_names=known.frame_names,
        keypoints=tuple(
            tuple(keypoints[c :: of.num_cameras]) for c in range(of.num_cameras)
        ),
        keypoint_idx=of.keypoint_idx(seen),
        model_idx=known.model_idx[seen],
    )
