"""The folder that `uwsfm export --to pinhole` writes."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import checked_target, replaced_dir
from uwsfm._base.paths import inside
from uwsfm._base.progress import Progress, silent
from uwsfm.colmap.model import Model, to_reconstruction, write_model
from uwsfm.errors import InputError
from uwsfm.export.pinhole import PinholeModel, pinhole_model
from uwsfm.export.trainers import (
    IMAGES,
    MASKS,
    Place,
    image_names,
    image_places,
    mask_names,
    write_transforms,
)
from uwsfm.export.warp import read_image, warp_image, warp_maps, write_image
from uwsfm.results.summary import write_json

REPORT = "pinhole.json"


def export_pinhole(
    model: Model,
    folder: str | Path,
    images: str | Path | None = None,
    progress: Progress = silent,
    *,
    flat_names: bool = False,
    centered: bool = True,
) -> PinholeModel:
    """Write a central COLMAP model, and the images warped to it if they are given.

    The layout is that of COLMAP's undistorter: ``sparse/0``, ``images`` and ``masks``
    (COLMAP's naming; black: nothing was photographed, or no points surround the
    pixel and its depth is a guess). With images, ``transforms.json`` and
    ``sparse_pc.ply`` describe the same to nerfstudio. ``pinhole.json`` reports how
    exact each image is.

    Args:
        model: of `uwsfm.read_model`.
        folder: to write; must not exist.
        images: the folder that was reconstructed, with one folder per camera.
        progress: called once per image.
        flat_names: ``left_0001.jpg`` instead of ``left/0001.jpg``, and masks as
            ``left_0001.png`` too: trainers of Gaussian splatting want both.
        centered: as of `pinhole_model`.

    Raises:
        InputError: the folder exists, an image is missing or of another size, or a
            camera has seen no point.
    """
    target = checked_target(folder)
    if images is not None:
        _check_images(model, Path(images))
    found = pinhole_model(model, centered=centered)
    names = image_names(model, flat=flat_names)
    for name in names.values():  # before half of them are written
        inside(target, name)
    reconstruction = to_reconstruction(found.model)
    written = {model.image_name(*place): name for place, name in names.items()}
    for image in reconstruction.images.values():
        image.name = written[image.name]
    with replaced_dir(target) as partial:
        sparse = partial / "sparse" / "0"
        sparse.mkdir(parents=True)
        write_model(reconstruction, sparse)
        known = None
        if images is not None:
            known = _warp_all(
                model, found, Path(images), partial, names, flat_names, progress
            )
            write_transforms(partial, found.model, names, flat=flat_names)
        report = pinhole_report(found, known)
        for entry in report["images"]:
            entry["written_as"] = written[entry["name"]]
        write_json(report, partial / REPORT)
    return found


def pinhole_report(
    found: PinholeModel, known: dict[str, float] | None = None
) -> dict[str, Any]:
    """What the export is worth, as numbers.

    Args:
        found: the model.
        known: by image name, the share of the warped image that points surround.
    """
    entries = []
    for error in found.errors:
        values = {k: _finite(v) for k, v in asdict(error).items()}
        if known is not None:
            values["share_between_points"] = known[error.name]
        entries.append(values)
    weights = [error.num_points for error in found.errors]
    errors_px = found.model.errors_px()
    return {
        "mean_reprojection_error_px": {
            "refractive": found.refractive_error_px,
            "pinhole": float(np.mean(errors_px)),
        },
        "num_observations": found.model.scene.num_observations,
        "num_dropped_observations": found.num_dropped_observations,
        "num_dropped_keypoints": found.num_dropped_keypoints,
        "rms_px": _total([e.rms_px for e in found.errors], weights),
        "max_px": _largest([e.max_px for e in found.errors]),
        "constant_rms_px": _total([e.constant_rms_px for e in found.errors], weights),
        "constant_max_px": _largest([e.constant_max_px for e in found.errors]),
        "cameras": [
            {
                "name": camera.name,
                "width_px": pinhole.width,
                "height_px": pinhole.height,
                "focal_px": pinhole.focal_px,
                "center_in_cam_m": pinhole.center_in_cam.tolist(),
                "constant_depth_m": pinhole.depth,
            }
            for camera, pinhole in zip(
                found.model.rig.cameras, found.pinholes, strict=True
            )
        ],
        "images": entries,
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _total(rms: list[float], weights: list[int]) -> float | None:
    squares = [w * r**2 for r, w in zip(rms, weights, strict=True) if w]
    return math.sqrt(sum(squares) / sum(weights)) if squares else None


def _largest(values: list[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return max(finite) if finite else None


def _check_images(model: Model, images: Path) -> None:
    """Refuse at once what would fail after minutes."""
    if not images.is_dir():
        raise InputError(f"{images}: no such folder of images")
    for c, f in image_places(model):
        path = images / model.image_name(c, f)
        if not path.is_file():
            raise InputError(f"{path}: no such image")


def _warp_all(
    model: Model,
    found: PinholeModel,
    images: Path,
    folder: Path,
    names: Mapping[Place, str],
    flat: bool,
    progress: Progress,
) -> dict[str, float]:
    """Write images and masks; the share of each image that points surround."""
    known = {}
    for done, ((c, f), target) in enumerate(names.items(), start=1):
        name = model.image_name(c, f)
        camera = model.scene.cameras[c]
        image = read_image(images / name, camera)
        maps, mask = warp_maps(camera, found.pinholes[c], found.depths[c][f])
        write_image(folder / IMAGES, target, warp_image(image, maps))
        for mask_name in mask_names(target, flat=flat):
            write_image(folder / MASKS, mask_name, np.uint8(255) * mask)
        known[name] = float(np.mean(mask))
        progress("warping images", done, len(names))
    return known
