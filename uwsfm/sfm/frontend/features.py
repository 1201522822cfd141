"""SIFT features of all images, in a COLMAP database that an interrupted run leaves."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from functools import partial
from pathlib import Path

import pycolmap

from uwsfm._base.disk import require_room
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend import background
from uwsfm.sfm.frontend.background import opened, quiet_colmap
from uwsfm.sfm.frontend.colors import write_colors
from uwsfm.sfm.frontend.image_features import (
    FEATURE_BYTES,
    ImageFeatures,
    find_features,
    scratch_bytes,
)
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.options import FeatureOptions, thread_count

CHUNK = 4
"""Images of one job: an interrupted run loses no more for each thread."""
FINDING = "finding features"
LEAST_SHARE = 0.1
"""Of the features that images may have: fewer are found where there is hardly
anything to see. Of others, the room is asked for as they come."""
COLORS = "colors"  # folder of the keypoints' colours, beside the database


def extract_features(
    frames: Frames,
    rig: Rig,
    database_path: Path,
    options: FeatureOptions,
    *,
    num_threads: int = -1,
    progress: Progress = silent,
) -> None:
    """Write keypoints and descriptors; images that have them already are skipped.

    The colours beneath the keypoints go beside the database, see
    `uwsfm.sfm.frontend.colors`.

    Args:
        frames: The images.
        rig: Gives each folder its image size.
        database_path: Created, or continued.
        options: How.
        num_threads: -1 for all cores. The result does not depend on it.
        progress: Called with the step "features".

    Raises:
        InputError: An image cannot be read, or has another size; names it.
        UwsfmError: No image has a feature.
    """
    database_path.parent.mkdir(parents=True, exist_ok=True)
    colors_dir = database_path.parent / COLORS
    extract_images(
        frames, rig, database_path, colors_dir, options, num_threads, progress
    )
    require_features(frames, database_path)


def extract_images(
    frames: Frames,
    rig: Rig,
    database_path: Path,
    colors_dir: Path,
    options: FeatureOptions,
    num_threads: int = -1,
    progress: Progress = silent,
) -> None:
    """`extract_features` of some frames, which may have none."""
    threads = thread_count(num_threads)
    total = frames.num_images
    sizes = {c.images: (c.camera.width, c.camera.height) for c in rig.cameras}
    stopped = threading.Event()
    work_dir = database_path.parent

    def watch() -> None:
        if stopped.is_set():
            raise InterruptedError

    def found(names: list[str]) -> list[ImageFeatures]:
        size = sizes[names[0].rpartition("/")[0]]
        # Every thread may ask before any of them has written.
        needed = threads * scratch_bytes(size, len(names), options)
        require_room(work_dir, needed, FINDING)
        return find_features(frames.image_dir, names, size, options, work_dir, watch)

    with opened(database_path) as database, quiet_colmap():
        cameras = _cameras(database, frames, rig)
        chunks = _missing(database, frames)
        missing = sum(map(len, chunks))
        largest = max(options.num_features(*size) for size in sizes.values())
        needed = LEAST_SHARE * missing * largest * FEATURE_BYTES
        require_room(work_dir, needed, FINDING)
        done = total - missing
        with ThreadPoolExecutor(threads) as pool:
            try:
                # In order, so that the database is the same for any threads.
                jobs = deque(pool.submit(found, names) for names in chunks)
                for names in chunks:
                    report = partial(progress, "features", done, total)
                    features = _awaited(jobs.popleft(), report)
                    for name, each in zip(names, features, strict=True):
                        write_colors(colors_dir, name, each.colors)
                        camera_id = cameras[name.rpartition("/")[0]]
                        _write_image(database, name, camera_id, each)
                    done += len(names)
                    progress("features", done, total)
            finally:
                stopped.set()
    progress("features", total, total)


def _awaited(
    job: Future[list[ImageFeatures]], watch: Callable[[], None]
) -> list[ImageFeatures]:
    while True:
        try:
            return job.result(timeout=background.POLL_SECONDS)
        except StillRunning:
            if job.done():
                raise
            watch()


def _cameras(database: pycolmap.Database, frames: Frames, rig: Rig) -> dict[str, int]:
    """The camera of each folder, from an earlier run if there was one."""
    found = {
        image.name.rpartition("/")[0]: image.camera_id
        for image in database.read_all_images()
    }
    for folder in frames.folders:
        if folder not in found:
            (lens,) = (c.camera for c in rig.cameras if c.images == folder)
            found[folder] = database.write_camera(_in_air(lens))
    return found


def _in_air(lens: pycolmap.Camera, camera_id: int | None = None) -> pycolmap.Camera:
    camera = pycolmap.Camera(
        model=lens.model_name,
        width=lens.width,
        height=lens.height,
        params=lens.params,
        has_prior_focal_length=True,
    )
    if camera_id is not None:
        camera.camera_id = camera_id
    return camera


def _missing(database: pycolmap.Database, frames: Frames) -> list[list[str]]:
    """Chunks of images without features, each of one folder, along the dive."""
    there = {
        image.name
        for image in database.read_all_images()
        if database.exists_descriptors(image.image_id)
    }
    chunks = []
    for begin in range(0, len(frames.names), CHUNK):
        for c in range(len(frames.folders)):
            block = range(begin, min(begin + CHUNK, len(frames.names)))
            names = [frames.image_name(c, f) for f in block if frames.has_image(c, f)]
            chunks.append([name for name in names if name not in there])
    return [names for names in chunks if names]


def _write_image(
    database: pycolmap.Database, name: str, camera_id: int, features: ImageFeatures
) -> None:
    """All of an image or nothing: a process may be killed at any point."""
    with pycolmap.DatabaseTransaction(database):
        image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        database.write_keypoints(image_id, features.keypoints)
        database.write_descriptors(
            image_id,
            pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, features.descriptors
            ),
        )


def store_intrinsics(rig: Rig, database_path: Path) -> None:
    """Give the database's cameras the rig's intrinsics in air; features do not change.

    An interrupted run may leave several cameras for one folder: all are set.
    """
    with opened(database_path) as database:
        lens_of = {c.images: c.camera for c in rig.cameras}
        folder_of = {
            image.camera_id: image.name.rpartition("/")[0]
            for image in database.read_all_images()
        }
        for camera_id, folder in folder_of.items():
            database.update_camera(_in_air(lens_of[folder], camera_id))


def require_features(frames: Frames, database_path: Path) -> None:
    """Refuse blank images.

    Raises:
        UwsfmError: no image has a feature.
    """
    with opened(database_path) as database:
        if database.num_keypoints() == 0:
            raise UwsfmError(
                f"no features were found in the images of {frames.image_dir}: "
                "are they blank?"
            )
