"""SIFT features of all images, in a COLMAP database that an interrupted run leaves."""

from __future__ import annotations

from pathlib import Path

import cv2
import pycolmap

from uwsfm._files import replaced_file
from uwsfm._progress import Progress, silent
from uwsfm.errors import InputError, UwsfmError
from uwsfm.rig import Rig
from uwsfm.sfm.background import opened, run_with_database
from uwsfm.sfm.images import Frames, read_gray
from uwsfm.sfm.options import FeatureOptions

ENHANCED = "clahe"  # folder of the enhanced copies, beside the database


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

    Args:
        frames: The images.
        rig: Gives each folder its image size.
        database_path: Created, or continued.
        options: How.
        num_threads: -1 for all cores.
        progress: Called with the step "features".

    Raises:
        InputError: COLMAP cannot read an image; names it.
    """
    extract_images(frames, rig, database_path, options, num_threads, progress)
    check_complete(frames, database_path)


def extract_images(
    frames: Frames,
    rig: Rig,
    database_path: Path,
    options: FeatureOptions,
    num_threads: int = -1,
    progress: Progress = silent,
) -> None:
    """`extract_features` of some frames; images that COLMAP cannot read are missing."""
    image_dir = frames.image_dir
    if options.clahe:
        image_dir = database_path.parent / ENHANCED
        write_enhanced(frames, image_dir, progress)
    database_path.parent.mkdir(parents=True, exist_ok=True)
    total = len(frames.folders) * len(frames.names)
    for c, rig_camera in enumerate(rig.cameras):
        names = [frames.image_name(c, f) for f in range(len(frames.names))]
        extraction = _extraction_options(rig_camera.camera, options, num_threads)

        def extract(
            token: pycolmap.CancellationToken,
            names: list[str] = names,
            extraction: pycolmap.FeatureExtractionOptions = extraction,
        ) -> None:
            pycolmap.extract_features(
                database_path,
                image_dir,
                image_names=names,
                camera_mode=pycolmap.CameraMode.PER_FOLDER,
                reader_options=_reader_options(options),
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        run_with_database(
            database_path,
            extract,
            lambda database: progress("features", database.num_images(), total),
        )
    progress("features", total, total)


def _reader_options(options: FeatureOptions) -> pycolmap.ImageReaderOptions:
    reader = pycolmap.ImageReaderOptions()
    if options.mask_dir is not None:
        reader.mask_path = options.mask_dir
    return reader


def store_intrinsics(frames: Frames, rig: Rig, database_path: Path) -> None:
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
            lens = lens_of[folder]
            database.update_camera(
                pycolmap.Camera(
                    camera_id=camera_id,
                    model=lens.model_name,
                    width=lens.width,
                    height=lens.height,
                    params=lens.params,
                    has_prior_focal_length=True,
                )
            )


def _extraction_options(
    camera: pycolmap.Camera, options: FeatureOptions, num_threads: int
) -> pycolmap.FeatureExtractionOptions:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = num_threads
    extraction.max_image_size = options.max_image_size
    small = camera.width * camera.height <= options.max_upsampled_px
    extraction.sift.first_octave = -1 if small else 0
    extraction.sift.peak_threshold = options.peak_threshold
    extraction.sift.max_num_features = options.max_num_features
    # A second orientation is the same position again: no second measurement.
    extraction.sift.max_num_orientations = 1
    return extraction


def check_complete(frames: Frames, database_path: Path) -> None:
    """Every image must be in the database: COLMAP only logs those it cannot read."""
    with opened(database_path) as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        for name in frames.image_names():
            if name not in images or not database.exists_keypoints(images[name]):
                raise InputError(
                    f"COLMAP cannot read image {frames.image_dir / name}: convert it "
                    "to 8-bit PNG or JPEG"
                )
        if database.num_keypoints() == 0:
            raise UwsfmError(
                f"no features were found in the images of {frames.image_dir}: "
                "are they blank?"
            )


def write_enhanced(
    frames: Frames, output_dir: Path, progress: Progress = silent
) -> None:
    """Grey copies of the images with their contrast equalised locally (CLAHE).

    Copies that exist are kept; every copy is written whole or not at all.
    """
    equalizer = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8))
    names = list(frames.image_names())
    for done, name in enumerate(names, start=1):
        target = output_dir / name
        if not target.exists():
            gray = read_gray(frames.image_dir / name)
            if gray is None:
                raise InputError(f"image {frames.image_dir / name} cannot be read")
            with replaced_file(target) as partial:
                quality = []
                if target.suffix.lower() in (".jpg", ".jpeg"):
                    quality = [cv2.IMWRITE_JPEG_QUALITY, 98]
                if not cv2.imwrite(str(partial), equalizer.apply(gray), quality):
                    raise UwsfmError(f"the enhanced image {target} cannot be written")
        progress("enhancing images", done, len(names))
