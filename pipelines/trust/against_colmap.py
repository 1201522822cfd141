"""Is ``uwsfm reconstruct`` ever worse than stock COLMAP on the same images?

    python pipelines/trust/against_colmap.py -o OUT --data DATA --cases CASES
        [--coral-full FOLDER] [--only TEXT]

DATA holds ``uril_tank`` and ``coral_tg5``, CASES ``gopro_clip``; FOLDER some of the
coral's photographs at their full size. What is not there is left out. Rendered sets
are made in OUT. COLMAP runs with its defaults: features, exhaustive matching,
incremental mapping, one OPENCV camera per folder; its largest model counts. A run that
was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import yaml

import uwsfm
from uwsfm._files import replaced_file
from uwsfm.errors import UwsfmError
from uwsfm.simulate.commands import simulate_images

PIPELINES = Path(__file__).parents[1]
SAMPLE = PIPELINES.parent / "datasets" / "sample"
sys.path += [str(PIPELINES / "coral_tg5"), str(PIPELINES / "uril_tank")]
MARGIN = 0.1
FREE_LENS = {"refine_focal": True, "refine_distortion": True}
CORAL = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
    "focal_stddev": 0.03,
    "principal_point_stddev_px": 15.0,
    "distortion_stddev": 0.05,
    "normal_stddev_deg": 1.0,
    "scene_distance_m": 0.6,
}
"""As pipelines/coral_tg5 has them."""


@dataclass(frozen=True, kw_only=True)
class ImageSet:
    """Images, and a rig file for them."""

    name: str
    make: Callable[[Path], tuple[Path, Path]]
    """Makes what is missing in a folder; gives the folder of images and the rig."""
    options: dict[str, Any] = field(default_factory=dict)
    """Of `uwsfm.reconstruct`."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """What came of one program."""

    images: int
    observations: int
    rms_px: float
    """Root of the mean squared length of the residuals, over all observations."""
    cpu_s: float
    note: str = ""


def image_sets(options: argparse.Namespace) -> Iterator[ImageSet]:
    """All that is at hand."""
    yield ImageSet(
        name="sample, 0.5 MP", make=lambda _: (SAMPLE / "images", SAMPLE / "rig.yaml")
    )
    for preset in ("dome", "near"):
        yield ImageSet(name=f"{preset} preset, 0.1 MP", make=_rendered(preset))
    if options.data and (options.data / "uril_tank").is_dir():
        tank = options.data / "uril_tank"
        yield ImageSet(name="uril_tank, 0.3 MP", make=_tank(tank))
    if options.data and (options.data / "coral_tg5").is_dir():
        coral = options.data / "coral_tg5"
        yield ImageSet(
            name="coral_tg5, 0.3 MP", make=_coral(coral, (640, 480)), options=CORAL
        )
        yield ImageSet(
            name="coral_tg5, 1 MP", make=_coral(coral, (1200, 900)), options=CORAL
        )
    if options.coral_full:
        yield ImageSet(
            name="coral_tg5, 12 MP",
            make=_coral(options.coral_full, (4000, 3000)),
            options={**CORAL, "principal_point_stddev_px": 50.0},
        )
    if options.cases and (options.cases / "gopro_clip").is_dir():
        clip = options.cases / "gopro_clip"
        flat = {**FREE_LENS, "focal_stddev": 0.05, "distortion_stddev": 0.02}
        lenses = {"none": FREE_LENS, "good": {}, "flat": flat}
        for rig, how in lenses.items():
            yield ImageSet(
                name=f"gopro_clip, {rig}, 0.5 MP",
                make=lambda _, rig=rig: (clip / "images", clip / f"{rig}.yaml"),
                options={"matching": "exhaustive", **how},
            )


def _rendered(preset: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        source = folder / "dive"
        if not source.exists():
            simulate_images(source, preset=preset)
        return source / "images", source / "rig.yaml"

    return make


def _tank(data: Path) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        from tank_rig import write_rig

        folder.mkdir(parents=True, exist_ok=True)
        write_rig(data, folder / "rig.yaml", whole_image=False, free_rig=False)
        images = folder / "images"
        for side in ("left", "right"):  # nothing else, or COLMAP takes it for a camera
            _linked(sorted((data / side).iterdir()), images / side)
        return images, folder / "rig.yaml"

    return make


def _coral(data: Path, size: tuple[int, int]) -> Callable[[Path], tuple[Path, Path]]:
    """The photographs at some size, and a rig file as pipelines/coral_tg5 writes it."""

    def make(folder: Path) -> tuple[Path, Path]:
        import pipeline as coral

        images = folder / "images" / "coral"
        if not images.exists():
            images.mkdir(parents=True)
            for path in sorted(data.iterdir()):
                if path.suffix.lower() == ".jpg":
                    _resized(path, images / f"{path.stem}.jpg", size)
        coral.write_rig(images, folder / "rig.yaml")
        rig = yaml.safe_load((folder / "rig.yaml").read_text())
        lens = rig["cameras"][0]["intrinsics"]
        scale = size[0] / lens["width_px"]
        lens["width_px"], lens["height_px"] = size
        lens["params"][:4] = [scale * value for value in lens["params"][:4]]
        (folder / "rig.yaml").write_text(yaml.safe_dump(rig, sort_keys=False))
        return images.parent, folder / "rig.yaml"

    return make


def _resized(source: Path, target: Path, size: tuple[int, int]) -> None:
    image = cv2.imread(str(source))
    if image.shape[1::-1] == size:
        shutil.copyfile(source, target)
        return
    smaller = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), smaller, [cv2.IMWRITE_JPEG_QUALITY, 95])


def _linked(paths: list[Path], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        if not (folder / path.name).exists():
            (folder / path.name).symlink_to(path.resolve())


def of_colmap(images: Path, work: Path) -> Run:
    """Stock COLMAP, from the images to its largest model."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    database = work / "database.db"
    reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
    clock = time.process_time()
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=reader,
    )
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, images, work)
    seconds = time.process_time() - clock
    if not models:
        return Run(images=0, observations=0, rms_px=np.nan, cpu_s=seconds)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    errors = _errors_px(best)
    return Run(
        images=best.num_reg_images(),
        observations=len(errors),
        rms_px=float(np.sqrt(np.mean(errors**2))),
        cpu_s=seconds,
    )


def _errors_px(model: pycolmap.Reconstruction) -> np.ndarray:
    """Length of the residual of every observation (N,)."""
    errors = []
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        seen = [p for p in image.points2D if p.has_point3D()]
        if not seen:
            continue
        points = np.array([model.points3D[p.point3D_id].xyz for p in seen])
        xy = np.array([p.xy for p in seen])
        pose = image.cam_from_world()
        in_cam = points @ pose.rotation.matrix().T + pose.translation
        lens = model.cameras[image.camera_id]
        errors.append(np.linalg.norm(lens.img_from_cam(in_cam) - xy, axis=1))
    return np.concatenate(errors)


def of_uwsfm(rig: Path, images: Path, out: Path, options: dict[str, Any]) -> Run:
    """``uwsfm reconstruct``, from the images on."""
    shutil.rmtree(out, ignore_errors=True)
    clock = time.process_time()
    try:
        result = uwsfm.reconstruct(rig, images, out, report=False, **options)
    except UwsfmError as error:
        seconds = time.process_time() - clock
        text = str(error)
        return Run(images=0, observations=0, rms_px=np.nan, cpu_s=seconds, note=text)
    seconds = time.process_time() - clock
    scene, summary = result.model.scene, result.summary
    seen = np.unique(scene.camera_idx * scene.num_frames + scene.frame_idx)
    return Run(
        images=len(seen),
        observations=summary["num_observations"],
        rms_px=summary["reprojection_rms_px"]["after"],
        cpu_s=seconds,
        note=summary["verdict"],
    )


COLUMNS = (
    "images",
    "COLMAP: registered",
    "observations",
    "RMS px",
    "CPU s",
    "uwsfm: registered",
    "observations",
    "RMS px",
    "CPU s",
    "verdict",
    "worse by more than 10 % in",
)
HEAD = """\
# Against stock COLMAP

`python pipelines/trust/against_colmap.py -o OUT --data DATA --cases CASES --coral-full
FOLDER`

The same images; both start from nothing. Registered: images. RMS: root of the mean
squared length of the residuals, px, over all observations of the program's own model.
COLMAP: one OPENCV camera per folder, its defaults otherwise.

"""


def page(rows: list[dict[str, Any]]) -> str:
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for row in rows:
        theirs, ours = Run(**row["colmap"]), Run(**row["uwsfm"])
        cells = [row["name"], *_cells(theirs), *_cells(ours), ours.note]
        lines.append("| " + " | ".join([*cells, worse_in(theirs, ours)]) + " |")
    return HEAD + "\n".join(lines) + "\n"


def worse_in(theirs: Run, ours: Run) -> str:
    """What is worse than COLMAP's by more than `MARGIN`."""
    found = {
        "images": ours.images < (1.0 - MARGIN) * theirs.images,
        "observations": ours.observations < (1.0 - MARGIN) * theirs.observations,
        "RMS": not ours.rms_px <= (1.0 + MARGIN) * theirs.rms_px,
    }
    return ", ".join(name for name, worse in found.items() if worse) or "nothing"


def _cells(run: Run) -> list[str]:
    rms = "-" if not np.isfinite(run.rms_px) else f"{run.rms_px:.3f}"
    return [str(run.images), str(run.observations), rms, f"{run.cpu_s:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--coral-full", type=Path)
    parser.add_argument("--only", default="", metavar="TEXT")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    options.out.mkdir(parents=True, exist_ok=True)
    stored = options.out / "against_colmap.json"
    rows = json.loads(stored.read_text()) if stored.exists() else {}
    for item in image_sets(options):
        if options.only not in item.name:
            continue
        folder = options.out / item.name.replace(", ", "_").replace(" ", "_")
        images, rig = item.make(folder)
        row = rows.setdefault(item.name, {"name": item.name})
        # Clips of one folder share COLMAP's run.
        shared = next(
            (r["colmap"] for r in rows.values() if r.get("images") == str(images)), None
        )
        if "colmap" not in row:
            row["colmap"] = shared or asdict(of_colmap(images, folder / "colmap"))
        row["images"] = str(images)
        if "uwsfm" not in row:
            run = of_uwsfm(rig, images, folder / "uwsfm", item.options)
            row["uwsfm"] = asdict(run)
        with replaced_file(stored) as partial:
            partial.write_text(json.dumps(rows, indent=1))
        print(json.dumps(row), flush=True)
    text = page([row for row in rows.values() if "uwsfm" in row])
    with replaced_file(options.out / "against_colmap.md") as partial:
        partial.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
