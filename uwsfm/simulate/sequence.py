"""Rendered stereo sequences: images, the rig a user would start from, the truth."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from uwsfm._base.checksums import write_checksums
from uwsfm._base.files import replaced_dir
from uwsfm._base.paths import inside
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import KINDS, DomePort, Port
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig
from uwsfm.simulate.footprints import footprints
from uwsfm.simulate.raycasting import RayScene
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rendering import SensorOptions, WaterOptions, render_image
from uwsfm.simulate.rigs import (
    known_cam_from_rig,
    nominal_rig,
    sample_rig,
    stereo_rig,
)
from uwsfm.simulate.sea_floor import SeaFloorOptions, build_sea_floor
from uwsfm.simulate.trajectories import rich_motion

COASTAL_WATER = WaterOptions(
    attenuation_per_m=(0.40, 0.13, 0.07),
    backscatter_per_m=(0.30, 0.30, 0.30),
    veil=(0.02, 0.13, 0.22),
)
RIG_HEADER = """Simulated stereo rig, as one would write it down before a dive:
lenses and camera placement calibrated in air{}. The truth is in truth.json."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceSpec:
    """All that decides what a rendered sequence looks like."""

    rig: Rig
    """The true rig."""
    rig_from_world: Array
    """(F, 7)"""
    floor: SeaFloorOptions = field(default_factory=SeaFloorOptions)
    water: WaterOptions = COASTAL_WATER
    sensor: SensorOptions = field(
        default_factory=lambda: SensorOptions(blur_px=0.7, exposure=1.4, noise=1.0)
    )
    jpeg_quality: int = 90
    max_range: float = 2.5
    """The floor ends where rays of this length end, metres."""
    seed: int = 0
    """Of the sensor noise; the floor and its relief have their own."""

    def __post_init__(self) -> None:
        if not 1 <= self.jpeg_quality <= 100:
            raise InputError(
                f"jpeg_quality must be between 1 and 100, got {self.jpeg_quality}"
            )
        if len(self.rig_from_world) == 0:
            raise InputError("a sequence needs at least one frame")


def sample_spec() -> SequenceSpec:
    """The sample of the project: a motion that determines both housings well."""
    spec = SequenceSpec(
        rig=sample_rig(),
        rig_from_world=rich_motion(14, altitude=1.05, extent=0.4),
    )
    return reseeded(spec, 3)


def small_spec() -> SequenceSpec:
    """The sample at half its size, rendered in half a minute: to try things out."""
    sample = sample_spec()
    return replace(
        sample,
        rig=sample_rig(image_scale=0.5),
        floor=replace(sample.floor, texel=0.0012, mesh_step=0.02),
        sensor=replace(sample.sensor, samples_per_side=2),
    )


def dome_spec() -> SequenceSpec:
    """The small dive behind domes, a centimetre off their centres."""
    small = small_spec()
    places = ((0.002, -0.003, 0.008), (-0.003, 0.001, 0.012))
    cameras = tuple(
        replace(
            camera,
            port=DomePort(place, 0.05, 0.007, 1.49, 1.333),
            refine_normal=False,
            refine_distance=False,
            refine_center=True,
        )
        for camera, place in zip(small.rig.cameras, places, strict=True)
    )
    return replace(small, rig=replace(small.rig, cameras=cameras))


def near_spec() -> SequenceSpec:
    """Where pinholes fail: 0.3 m away, ports at 12 cm tilted by 10 degrees, relief."""
    params = [295.0, 295.0, 200.0, 150.0]
    left, right = (
        pycolmap.Camera(model="PINHOLE", width=400, height=300, params=params)
        for _ in range(2)
    )
    rig = stereo_rig(
        (left, right),
        distance=0.12,
        thickness=0.01,
        tilts_deg=((10.0, 40.0), (8.0, -60.0)),
        baseline=0.08,
    )
    spec = SequenceSpec(
        rig=rig,
        rig_from_world=rich_motion(14, altitude=0.42, extent=0.14),
        floor=SeaFloorOptions(
            relief=Relief(stddev=0.02, correlation_length=0.12),
            num_boulders=9,
            boulder_radius=(0.015, 0.05),
            boulder_extent=0.25,
            texel=0.0004,
            mesh_step=0.005,
        ),
        max_range=1.2,
    )
    spec = replace(spec, sensor=replace(spec.sensor, samples_per_side=2))
    return reseeded(spec, 3)


PRESETS: dict[str, Callable[[], SequenceSpec]] = {
    "sample": sample_spec,
    "small": small_spec,
    "dome": dome_spec,
    "near": near_spec,
}


def render_sequence(
    spec: SequenceSpec, out_dir: Path, progress: Progress = silent
) -> None:
    """Render a sequence into a folder that does not exist yet, or is empty.

    Writes ``images/<camera>/0001.jpg`` and so on, ``rig.yaml`` (straight ports at half
    the true distance, concentric domes), ``truth.json`` and ``SHA256SUMS``.

    Raises:
        InputError: the folder is not empty, or the floor is too large.
        MissingPackageError: Open3D is missing.
    """
    out_dir = Path(out_dir)
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise InputError(f"{out_dir}: exists and is not an empty folder")
    with replaced_dir(out_dir) as partial:
        _render_images(spec, partial / "images", progress)
        dump_rig(nominal_rig(spec.rig), partial / "rig.yaml", rig_header(spec.rig))
        truth = json.dumps(truth_of(spec), indent=1)
        (partial / "truth.json").write_text(truth + "\n", encoding="utf-8")
        write_checksums(partial, [p for p in partial.rglob("*") if p.is_file()])


def rig_header(rig: Rig) -> str:
    """What is said on top of rig.yaml of the kinds of port that are there."""
    made = {camera.port.guess for camera in rig.cameras}
    guesses = dict.fromkeys(kind.guess for kind in KINDS)
    return RIG_HEADER.format("".join(guess for guess in guesses if guess in made))


def reseeded(spec: SequenceSpec, seed: int) -> SequenceSpec:
    """The same dive over another floor."""
    relief = replace(spec.floor.relief, seed=seed)
    return replace(spec, floor=replace(spec.floor, relief=relief, seed=seed), seed=seed)


def frame_names(num_frames: int) -> list[str]:
    """File names of the frames, the same in each camera's folder."""
    return [f"{index + 1:04d}.jpg" for index in range(num_frames)]


def _port_truth(port: Port) -> dict[str, Any]:
    water = {"water_index": port.n_water} if port.refracts else {}
    return {"port": port.word, **port.stated(), **water}


def truth_of(spec: SequenceSpec) -> dict[str, Any]:
    """What truth.json holds.

    Poses are rows [qx, qy, qz, qw, tx, ty, tz] as ``pycolmap.Rigid3d.params``; the
    world is the sea floor's: z points down, metres.
    """
    poses = np.asarray(spec.rig_from_world)
    placed = zip(spec.rig.cameras, known_cam_from_rig(spec.rig), strict=True)
    return {
        "version": 1,
        "seed": spec.seed,
        "water_refractive_index": spec.rig.cameras[0].port.n_water,
        "cameras": [
            {
                "name": item.name,
                **_port_truth(item.port),
                "cam_from_rig": pose.tolist(),
            }
            for item, pose in placed
        ],
        "rig_from_world": dict(
            zip(frame_names(len(poses)), poses.tolist(), strict=True)
        ),
        "sea_floor": asdict(spec.floor),
        "water": asdict(spec.water),
        "sensor": asdict(spec.sensor),
        "jpeg_quality": spec.jpeg_quality,
    }


def floor_in_view(spec: SequenceSpec) -> RayScene:
    """The sea floor as far as the images of a sequence see it."""
    boxes = footprints(
        spec.rig,
        np.asarray(spec.rig_from_world, dtype=np.float64),
        half_depth=4.0 * spec.floor.relief.stddev,
        max_range=spec.max_range,
    )
    return build_sea_floor(
        spec.floor,
        boxes[..., 0, :].min(axis=(0, 1)),
        boxes[..., 1, :].max(axis=(0, 1)),
    )


def _render_images(spec: SequenceSpec, folder: Path, progress: Progress) -> None:
    poses = np.asarray(spec.rig_from_world, dtype=np.float64)
    progress("sea floor", 0, None)
    scene = floor_in_view(spec)
    progress("sea floor", 1, 1)
    names = frame_names(len(poses))
    done, total = 0, len(poses) * len(spec.rig.cameras)
    cameras = spec.rig.refractive_cameras()
    for c, cam_from_rig in enumerate(known_cam_from_rig(spec.rig)):
        for f, (name, pose) in enumerate(zip(names, poses, strict=True)):
            progress("rendering", done, total)
            image = render_image(
                cameras[c],
                rigid3.compose(cam_from_rig, pose),
                scene,
                water=spec.water,
                sensor=spec.sensor,
                rng=np.random.default_rng([spec.seed, c, f]),
            )
            path = inside(folder, f"{spec.rig.cameras[c].images}/{name}")
            _write_jpeg(path, image, spec.jpeg_quality)
            done += 1
    progress("rendering", done, total)


def _write_jpeg(path: Path, image: np.ndarray, quality: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    settings = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_OPTIMIZE,
        1,
        cv2.IMWRITE_JPEG_PROGRESSIVE,
        1,
    ]
    if not cv2.imwrite(str(path), image[..., ::-1], settings):  # RGB -> BGR
        raise UwsfmError(f"{path}: could not be written")
