"""Is ``uwsfm reconstruct`` ever worse than stock COLMAP on the same images?

    python pipelines/trust/against_colmap.py -o OUT --data DATA --cases CASES
        [--coral-full FOLDER] [--only TEXT]

DATA holds ``uril_tank`` and ``coral_tg5``, CASES ``gopro_clip``; FOLDER twelve of the
coral's photographs, P5030260 to P5030293, at the 4000 x 3000 pixels that their source
has. What is not there is left out. Rendered sets are made in OUT. COLMAP runs with its
defaults: features, exhaustive matching, incremental mapping, one OPENCV camera per
folder; its largest model counts. A run that was stopped goes on.
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
from right_observations import Observations, right_ones

import uwsfm
from uwsfm._base.files import replaced_file
from uwsfm.colmap.model import Model
from uwsfm.errors import UwsfmError
from uwsfm.simulate.commands import simulate_images
from uwsfm.simulate.sequence import PRESETS

PIPELINES = Path(__file__).parents[1]
SAMPLE = PIPELINES.parent / "datasets" / "sample"
sys.path += [str(PIPELINES / "coral_tg5"), str(PIPELINES / "uril_tank")]
MARGIN = 0.1
FREE_LENS = {"refine_focal": True, "refine_distortion": True}
CLIP_OPTIONS: dict[str, dict[str, Any]] = {
    "none": FREE_LENS,
    "good": {},
    "flat": {**FREE_LENS, "focal_stddev": 0.05, "distortion_stddev": 0.02},
}
"""By the rig files of the clip: a lens without calibration, one that was calibrated in
the water, and one that is nearly straight behind a flat port."""
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
    preset: str | None = None
    """What was rendered: its truth is known."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """What came of one program."""

    images: int = 0
    observations: int = 0
    places: int = 0
    """Different positions among them."""
    right: int | None = None
    """Of the places, where the truth is known."""
    rms_px: float = np.nan
    """Root of the mean squared length of the residuals, over all observations."""
    cpu_s: float
    note: str = ""


def image_sets(options: argparse.Namespace) -> Iterator[ImageSet]:
    """All that is at hand."""
    yield ImageSet(
        name="sample, 0.5 MP",
        make=lambda _: (SAMPLE / "images", SAMPLE / "rig.yaml"),
        preset="sample",
    )
    for preset in ("dome", "near"):
        yield ImageSet(
            name=f"{preset} preset, 0.1 MP", make=_rendered(preset), preset=preset
        )
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
        for rig, how in CLIP_OPTIONS.items():
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


def of_colmap(images: Path, work: Path, preset: str | None) -> Run:
    """Stock COLMAP, from the images to its largest model."""
    clock = time.process_time()
    best = stock_model(images, work)
    seconds = time.process_time() - clock
    if best is None:
        return Run(cpu_s=seconds)
    seen, errors = _seen_by_colmap(best)
    return Run(
        images=best.num_reg_images(),
        observations=len(errors),
        **_counted(seen, preset),
        rms_px=float(np.sqrt(np.mean(errors**2))),
        cpu_s=seconds,
    )


def stock_model(
    images: Path, work: Path, max_features: int | None = None
) -> pycolmap.Reconstruction | None:
    """COLMAP's largest model; all of them are in ``work``. None: it has none."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    extraction = pycolmap.FeatureExtractionOptions()
    if max_features is not None:
        extraction.sift.max_num_features = max_features
    pycolmap.extract_features(
        work / "database.db",
        images,
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=pycolmap.ImageReaderOptions(camera_model="OPENCV"),
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(work / "database.db")
    models = pycolmap.incremental_mapping(work / "database.db", images, work)
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def _seen_by_colmap(model: pycolmap.Reconstruction) -> tuple[Observations, np.ndarray]:
    """All observations, and the lengths of their residuals (N,)."""
    names, rows, errors = [], [], []
    for k, image_id in enumerate(model.reg_image_ids()):
        image = model.images[image_id]
        names.append(image.name)
        seen = [p for p in image.points2D if p.has_point3D()]
        if not seen:
            continue
        points = np.array([model.points3D[p.point3D_id].xyz for p in seen])
        xy = np.array([p.xy for p in seen])
        rows += [(k, *p.xy, p.point3D_id) for p in seen]
        pose = image.cam_from_world()
        in_cam = points @ pose.rotation.matrix().T + pose.translation
        lens = model.cameras[image.camera_id]
        errors.append(np.linalg.norm(lens.img_from_cam(in_cam) - xy, axis=1))
    table = np.array(rows)
    observations = Observations(
        names=names,
        image=table[:, 0].astype(np.int64),
        xy=table[:, 1:3],
        point=table[:, 3].astype(np.int64),
    )
    return observations, np.concatenate(errors)


def _seen_by_uwsfm(model: Model) -> Observations:
    scene = model.scene
    image, index = np.unique(
        scene.camera_idx * scene.num_frames + scene.frame_idx, return_inverse=True
    )
    pairs = [divmod(k, scene.num_frames) for k in image.tolist()]
    names = [model.image_name(c, f) for c, f in pairs]
    return Observations(names=names, image=index, xy=scene.xy, point=scene.point_idx)


def _counted(seen: Observations, preset: str | None) -> dict[str, Any]:
    """Fields of `Run`."""
    if preset is None:
        return {"places": seen.num_places()}
    right = right_ones(PRESETS[preset](), seen)
    return {"places": seen.num_places(), "right": seen.num_places(right)}


def of_uwsfm(rig: Path, images: Path, out: Path, item: ImageSet) -> Run:
    """``uwsfm reconstruct``, from the images on."""
    shutil.rmtree(out, ignore_errors=True)
    clock = time.process_time()
    try:
        result = uwsfm.reconstruct(rig, images, out, report=False, **item.options)
    except UwsfmError as error:
        return Run(cpu_s=time.process_time() - clock, note=str(error))
    seconds = time.process_time() - clock
    seen, summary = _seen_by_uwsfm(result.model), result.summary
    return Run(
        images=len(seen.names),
        observations=summary["num_observations"],
        **_counted(seen, item.preset),
        rms_px=summary["reprojection_rms_px"]["after"],
        cpu_s=seconds,
        note=summary["verdict"],
    )


OF_EACH = ("registered", "observations", "places", "right", "RMS px", "CPU s")
COLUMNS = (
    "images",
    *(f"COLMAP: {name}" if k == 0 else name for k, name in enumerate(OF_EACH)),
    *(f"uwsfm: {name}" if k == 0 else name for k, name in enumerate(OF_EACH)),
    "verdict",
    "worse by more than 10 % in",
)
HEAD = """\
# Against stock COLMAP

`python pipelines/trust/against_colmap.py -o OUT --data DATA --cases CASES --coral-full
FOLDER`

The same images; both start from nothing. COLMAP: one OPENCV camera per folder, its
defaults otherwise.

- Registered: images.
- Places: different positions among the observations. COLMAP takes up to two
  orientations of a feature, and counts its position twice then.
- Right: places that show, within 3 px, the same point of the rendered floor as the rest
  of their track. Only rendered images have a truth.
- RMS: root of the mean squared length of the residuals, px, over all observations of
  the program's own model.

The last column compares registered images, RMS, and right places; all places where the
truth is not known.

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
    places = (theirs.places, ours.places)
    if theirs.right is not None and ours.right is not None:
        places = (theirs.right, ours.right)
    found = {
        "images": ours.images < (1.0 - MARGIN) * theirs.images,
        "observations": places[1] < (1.0 - MARGIN) * places[0],
        "RMS": not ours.rms_px <= (1.0 + MARGIN) * theirs.rms_px,
    }
    return ", ".join(name for name, worse in found.items() if worse) or "nothing"


def _cells(run: Run) -> list[str]:
    rms = "-" if not np.isfinite(run.rms_px) else f"{run.rms_px:.3f}"
    right = "-" if run.right is None else str(run.right)
    counts = [str(run.images), str(run.observations), str(run.places), right]
    return [*counts, rms, f"{run.cpu_s:.0f}"]


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
            row["colmap"] = shared or asdict(
                of_colmap(images, folder / "colmap", item.preset)
            )
        row["images"] = str(images)
        if "uwsfm" not in row:
            run = of_uwsfm(rig, images, folder / "uwsfm", item)
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
