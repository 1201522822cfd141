"""What `uwsfm color` does."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import checked_target, replaced_dir
from uwsfm._base.ply import read_vertices, write_ply
from uwsfm._base.progress import Progress, silent
from uwsfm.color.apply import (
    Correction,
    corrected_colors,
    corrected_image,
    make_correction,
    point_colors,
)
from uwsfm.color.encoding import ENCODINGS
from uwsfm.color.exposure import exposure_warnings
from uwsfm.color.samples import Samples, sample_scene
from uwsfm.color.water_fit import fit_water
from uwsfm.errors import InputError, UwsfmError
from uwsfm.export.warp import read_image, write_image
from uwsfm.results.files import POINTS
from uwsfm.results.folder import WATER, Result, find_dense_cloud, open_result
from uwsfm.results.summary import write_json

STATED = "colours without the water, by uwsfm color"


def correct_colors(
    out: str | Path,
    folder: str | Path,
    *,
    images: str | Path | None = None,
    write_images: bool = False,
    encoding: str = "srgb",
    gray: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Estimate what the water does to colours, and take it from points and images.

    Writes water.json, always; and if the water is determined, points.ply, cloud.ply if
    there is a dense cloud, and the images if they are wanted.

    Args:
        out: result folder.
        folder: to write; must not exist.
        images: where the images are now; default: where they were.
        write_images: also write the images, with the range between the points.
        encoding: of the images, one of `uwsfm.color.encoding.ENCODINGS`.
        gray: make the median point grey.
        progress: called once per image.

    Returns:
        What water.json holds.

    Raises:
        InputError: nothing to read, or something to write over.
        UwsfmError: the water is not determined, or too few points were seen twice.
    """
    target = checked_target(folder)
    if encoding not in ENCODINGS:
        raise InputError(f"--encoding {encoding}: is one of {', '.join(ENCODINGS)}")
    reader = _Reader(open_result(out, images), progress)
    result = reader.result
    samples = sample_scene(result.model.scene, reader.read, encoding)
    water = fit_water(samples)
    problem = water.problem()
    report: dict[str, Any] = {
        "source": str(out),
        "model": result.fingerprint,
        "unit": result.unit,
        "encoding": encoding,
        "num_lost_samples": samples.num_lost,
        **water.summary(),
        "problem": problem,
        "warnings": water.warnings() + exposure_warnings(reader.paths()),
    }
    with replaced_dir(target) as partial:
        if problem is None:
            correction = make_correction(water, samples, encoding, gray=gray)
            report["white_balance"] = "gray" if gray else "none"
            wanted = reader if write_images else None
            report |= _write_all(result, correction, samples, partial, wanted)
        write_json(report, partial / WATER)
    if problem is not None:
        raise UwsfmError(
            f"{problem} (encoding {encoding}; the estimates are in {target / WATER})"
        )
    return report


class _Reader:
    """The images of a result."""

    def __init__(self, result: Result, progress: Progress) -> None:
        self.result = result
        self.folder = result.require_images()
        self.progress = progress
        model = result.model
        self.places = [
            (camera, frame)
            for camera in range(len(model.rig.cameras))
            for frame in range(model.scene.num_frames)
            if model.has_image(camera, frame)
        ]
        for path in self.paths():
            if not path.is_file():
                raise InputError(
                    f"image {path} is missing: say with --images where it is"
                )
        self._done: dict[str, int] = {}

    def paths(self) -> list[Path]:
        return [self.folder / self.result.model.image_name(*p) for p in self.places]

    def read(self, camera: int, frame: int, step: str = "colours") -> NDArray[Any]:
        """RGB (height, width, 3), 8 or 16 bit."""
        model = self.result.model
        path = self.folder / model.image_name(camera, frame)
        image = read_image(path, model.scene.cameras[camera])
        if image.ndim != 3 or image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{path}: colours need an image in colour, 8 or 16 bit")
        self._done[step] = self._done.get(step, 0) + 1
        self.progress(step, self._done[step], len(self.places))
        return np.ascontiguousarray(image[..., 2::-1])


def _write_all(
    result: Result,
    correction: Correction,
    samples: Samples,
    folder: Path,
    reader: _Reader | None,
) -> dict[str, Any]:
    """Points, cloud and images without water; entries of the report."""
    _write_points(result, correction, samples, folder)
    entries: dict[str, Any] = {
        "gains": correction.gains.tolist(),
        "num_without_range": _write_cloud(result, correction, folder),
    }
    if reader is not None:
        share = _write_images(reader, correction, samples, folder / "images")
        entries["share_between_points"] = share
    return entries


def _write_points(
    result: Result, correction: Correction, samples: Samples, folder: Path
) -> None:
    table, _ = read_vertices(result.folder / POINTS)
    colors = point_colors(correction, samples, result.model.scene.num_points)
    if len(table) != len(colors):
        raise InputError(
            f"{result.folder / POINTS}: has {len(table)} points, but the model has "
            f"{len(colors)}"
        )
    _write_recolored(table, colors, folder / "points.ply", result.unit)


def _write_cloud(result: Result, correction: Correction, folder: Path) -> int | None:
    """Number of points without a range, which keep their colour; None: no cloud."""
    path = find_dense_cloud(result.folder)
    if path is None:
        return None
    table, _ = read_vertices(path)
    colors = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
    ranges = table["view_range"].astype(np.float64)
    corrected = corrected_colors(correction, colors, ranges)
    _write_recolored(table, corrected, folder / "cloud.ply", result.unit)
    return int(np.count_nonzero(~np.isfinite(ranges)))


def _write_recolored(
    table: np.ndarray, colors: NDArray[np.uint8], path: Path, unit: str
) -> None:
    table = table.copy()
    for k, name in enumerate(("red", "green", "blue")):
        table[name] = colors[:, k]
    write_ply(path, [("vertex", table)], comment=f"unit: {unit}; {STATED}")


def _write_images(
    reader: _Reader, correction: Correction, samples: Samples, folder: Path
) -> float:
    """Share of the pixels whose range lies between those of points."""
    scene, model = reader.result.model.scene, reader.result.model
    shares = []
    for camera, frame in reader.places:
        image = reader.read(camera, frame, "images without water")
        rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
        rows &= np.isfinite(samples.range)
        clear, share = corrected_image(
            correction,
            image,
            scene.xy[rows],
            samples.range[rows],
            correction.water.ranges[1],
        )
        shares.append(share)
        bgr = cv2.cvtColor(clear, cv2.COLOR_RGB2BGR)
        write_image(folder, model.image_name(camera, frame), bgr)
    return float(np.mean(shares))
