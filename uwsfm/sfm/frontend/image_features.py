"""SIFT features of a few images, and the colours beneath them: a job of its own.

An image is decoded once. COLMAP's extractor takes files only (its binding to arrays
keeps Python's lock), so it gets the grey values in a file without compression, which
lives as long as the job.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm._base.partial import scratch_folder
from uwsfm.errors import InputError
from uwsfm.sfm.frontend.background import opened, run_with_database
from uwsfm.sfm.frontend.colors import pixel_colors
from uwsfm.sfm.frontend.images import mask_path
from uwsfm.sfm.frontend.pixels import read_color, size_fault
from uwsfm.sfm.options import FeatureOptions


@dataclass(frozen=True, kw_only=True)
class ImageFeatures:
    """What is kept of an image."""

    keypoints: NDArray[np.float32]
    """(N, 6) pixel and shape, as COLMAP has them."""
    descriptors: NDArray[np.uint8]
    """(N, 128)"""
    colors: NDArray[np.uint8]
    """(N, 3) RGB of the pixel that holds the keypoint."""


FEATURE_BYTES = 128 + 24 + 3
"""A descriptor, a keypoint and its colour."""


def scratch_bytes(
    size: tuple[int, int], num_images: int, options: FeatureOptions
) -> float:
    """Room that `find_features` may take for a while, in bytes.

    The images in grey, their masks, and a database with its journal.
    """
    num_features = options.num_features(*size)
    pixels = size[0] * size[1] * (1 if options.mask_dir is None else 2)
    return num_images * (pixels + 2 * num_features * FEATURE_BYTES)


def find_features(
    image_dir: Path,
    names: Sequence[str],
    size: tuple[int, int],
    options: FeatureOptions,
    work_dir: Path,
    watch: Callable[[], None],
) -> list[ImageFeatures]:
    """Features of some images of one camera, in one thread.

    Args:
        image_dir: Folder of the cameras' folders.
        names: "folder/name".
        size: Width and height that they must have.
        options: How.
        work_dir: Receives files that are removed at the end.
        watch: Called a few times per second; what it raises stops the work.

    Raises:
        InputError: an image cannot be decoded, or has another size; names it.
    """
    with scratch_folder(work_dir) as folder:
        raw, path = folder / "raw", folder / "features.db"
        raw.mkdir()
        images = []
        for k, name in enumerate(names):
            watch()
            image = read_color(image_dir / name)
            fault = size_fault(image_dir / name, image, size)
            if fault is not None:
                raise InputError(fault)
            cv2.imwrite(str(raw / f"{k}.pgm"), _gray(image, options))
            if options.mask_dir is not None:
                _copy_mask(options.mask_dir, name, size, raw / f"{k}.pgm.png")
            images.append(image)
        reader = pycolmap.ImageReaderOptions()
        if options.mask_dir is not None:
            reader.mask_path = raw

        def extract(token: pycolmap.CancellationToken) -> None:
            pycolmap.extract_features(
                path,
                raw,
                image_names=[f"{k}.pgm" for k in range(len(names))],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=_extraction_options(size, options),
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        run_with_database(path, extract, lambda _: watch())
        with opened(path) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            return [
                _features(database, ids[f"{k}.pgm"], image)
                for k, image in enumerate(images)
            ]


def _copy_mask(mask_dir: Path, name: str, size: tuple[int, int], target: Path) -> None:
    """The mask of an image, white where it has none: COLMAP wants one for each."""
    source = mask_path(mask_dir, name)
    if source is not None:
        shutil.copyfile(source, target)
    else:
        cv2.imwrite(str(target), np.full(size[::-1], 255, dtype=np.uint8))


def _gray(image: Any, options: FeatureOptions) -> NDArray[np.uint8]:
    """Grey values as COLMAP weighs the colours, with more contrast if asked for."""
    rgb = np.ascontiguousarray(image[:, :, ::-1])
    gray = pycolmap.Bitmap.from_array(rgb).clone_as_grey().to_array()
    gray = gray.reshape(image.shape[:2])
    if not options.clahe:
        return gray
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(gray)


def _features(
    database: pycolmap.Database, image_id: int, image: NDArray[np.uint8]
) -> ImageFeatures:
    keypoints = database.read_keypoints(image_id)
    return ImageFeatures(
        keypoints=keypoints,
        descriptors=database.read_descriptors(image_id).data,
        colors=pixel_colors(image, keypoints[:, :2]),
    )


def _extraction_options(
    size: tuple[int, int], options: FeatureOptions
) -> pycolmap.FeatureExtractionOptions:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = 1
    extraction.max_image_size = options.max_image_size
    small = size[0] * size[1] <= options.max_upsampled_px
    extraction.sift.first_octave = -1 if small else 0
    extraction.sift.peak_threshold = options.peak_threshold
    extraction.sift.max_num_features = options.num_features(*size)
    # A second orientation is the same position again: no second measurement.
    extraction.sift.max_num_orientations = 1
    return extraction
