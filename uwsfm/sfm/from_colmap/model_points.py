"""Points of a COLMAP model that has poses only, from the matches in its database.

What COLMAP's `point_triangulator` does, by COLMAP's own triangulation. Its poses and
lenses stay as they are: the points are pinholes' points, a start as those of any other
model.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.partial import scratch_folder
from uwsfm.errors import InputError
from uwsfm.sfm.frontend.background import opened, quiet_colmap


@contextmanager
def copied_database(path: Path) -> Iterator[pycolmap.Database]:
    """A copy of a database that somebody else made, open until the end.

    Opening a database writes, and may bring it to COLMAP's present format.

    Raises:
        InputError: it does not exist, or is no database of COLMAP.
    """
    if not path.is_file():
        raise InputError(f"database {path} does not exist")
    with scratch_folder() as folder, quiet_colmap():
        copy = folder / "database.db"
        for suffix in ("", "-wal"):
            if Path(f"{path}{suffix}").is_file():
                shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
        try:
            with pycolmap.Database.open(copy) as database:
                yield database
        except RuntimeError as error:
            raise InputError(f"{path} is not a COLMAP database: {error}") from None


def triangulated(
    model: pycolmap.Reconstruction, folder: Path, database_path: Path
) -> pycolmap.Reconstruction:
    """A model with points, from its poses and the verified matches of a database.

    Args:
        model: Poses and cameras; of its images only those with a pose count.
        folder: Where the model came from, for messages.
        database_path: Keypoints and matches; images are found by their names.

    Raises:
        InputError: there is no such database, it lacks an image of the model, or its
            verified matches make no point with these poses.
    """
    with scratch_folder() as scratch, quiet_colmap():
        path, out = scratch / "poses.db", scratch / "model"
        out.mkdir()
        with copied_database(database_path) as source, opened(path) as target:
            bare = _with_keypoints(model, folder, source)
            with pycolmap.DatabaseTransaction(target):
                _write(target, bare)
                num_pairs = _copy_matches(source, target, bare)
        if num_pairs == 0:
            raise InputError(
                f"{folder} has poses without points, and its database no verified "
                "matches between their images to make points from: match them with "
                "COLMAP (exhaustive_matcher) first"
            )
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1  # the same points in every run
        options.extract_colors = False
        found = pycolmap.triangulate_points(bare, path, scratch, out, options=options)
    if found.num_points3D() == 0:
        raise InputError(
            f"{folder} has poses without points, and the matches of its database agree "
            "with no point at these poses: are they poses of these images, as COLMAP "
            "has them (cam_from_world)?"
        )
    return found


def _with_keypoints(
    model: pycolmap.Reconstruction, folder: Path, source: pycolmap.Database
) -> pycolmap.Reconstruction:
    """Its registered images, each free and with the keypoints of the database."""
    bare = pycolmap.Reconstruction()
    ids = {image.name: image.image_id for image in source.read_all_images()}
    for image_id in sorted(model.images):
        image = model.images[image_id]
        if not image.has_pose:
            continue
        if image.name not in ids:
            raise InputError(
                f"the database has no image {image.name}, which {folder} has a pose of"
            )
        if not bare.exists_camera(image.camera_id):
            bare.add_camera_with_trivial_rig(model.cameras[image.camera_id])
        stored = source.read_keypoints(ids[image.name])
        copy = pycolmap.Image(
            name=image.name,
            keypoints=stored[:, :2].astype(np.float64).reshape(-1, 2),
            camera_id=image.camera_id,
            image_id=image_id,
        )
        bare.add_image_with_trivial_frame(copy, image.cam_from_world())
    return bare


def _write(target: pycolmap.Database, bare: pycolmap.Reconstruction) -> None:
    """Cameras, rigs, frames and images of a model, under the same identifiers."""
    for camera in bare.cameras.values():
        target.write_camera(camera, use_camera_id=True)
    for rig in bare.rigs.values():
        target.write_rig(rig, use_rig_id=True)
    for image in bare.images.values():
        frame = pycolmap.Frame(
            frame_id=image.frame_id, rig_id=bare.frames[image.frame_id].rig_id
        )
        frame.add_data_id(image.data_id)
        target.write_image(
            pycolmap.Image(
                name=image.name, camera_id=image.camera_id, image_id=image.image_id
            ),
            use_image_id=True,
        )
        target.write_frame(frame, use_frame_id=True)
        xy = np.array([point.xy for point in image.points2D], dtype=np.float32)
        target.write_keypoints(image.image_id, xy.reshape(-1, 2))


def _copy_matches(
    source: pycolmap.Database,
    target: pycolmap.Database,
    bare: pycolmap.Reconstruction,
) -> int:
    """Verified matches between the images of a model; the number of pairs."""
    id_of = {image.name: image.image_id for image in bare.images.values()}
    new_id = {
        image.image_id: id_of[image.name]
        for image in source.read_all_images()
        if image.name in id_of
    }
    count = 0
    for pair_id, geometry in zip(*source.read_two_view_geometries(), strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        matches = geometry.inlier_matches
        if a not in new_id or b not in new_id or not len(matches):
            continue
        # Written in the order of the new identifiers by COLMAP itself.
        target.write_matches(new_id[a], new_id[b], matches)
        copy = pycolmap.TwoViewGeometry(config=geometry.config, inlier_matches=matches)
        target.write_two_view_geometry(new_id[a], new_id[b], copy)
        count += 1
    return count
