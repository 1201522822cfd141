"""What ``uwsfm simulate images`` and ``uwsfm simulate observations`` do."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from uwsfm._base.files import checked_target
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.simulate.observation_file import write_observations
from uwsfm.simulate.observations import (
    ObservationOptions,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rendering import WaterOptions
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.sequence import PRESETS, SequenceSpec, render_sequence, reseeded
from uwsfm.simulate.trajectories import lawn_mower, rich_motion, straight_strip

TRAJECTORIES = ("rich", "strip", "lawn-mower")


def simulate_images(
    out_dir: Path,
    *,
    preset: str = "sample",
    num_frames: int | None = None,
    seed: int | None = None,
    clear_water: bool = False,
    jpeg_quality: int | None = None,
    progress: Progress = silent,
) -> SequenceSpec:
    """Render stereo pairs of a sea floor, with rig.yaml and truth.json.

    Args:
        out_dir: A new or empty folder.
        preset: A name in `PRESETS`.
        num_frames: Keep the first frames only.
        seed: Another floor and other noise, same rig and motion; the preset's own by
            default.
        clear_water: No attenuation, no veiling light.
        jpeg_quality: 1 to 100; the preset's own by default.
        progress: Called once per image.

    Returns:
        What was rendered.

    Raises:
        InputError: an unknown preset, a number out of range, a folder in use.
        MissingPackageError: Open3D is missing.
    """
    if preset not in PRESETS:
        raise InputError(f"no preset {preset!r}; there are: {', '.join(PRESETS)}")
    spec = PRESETS[preset]()
    if seed is not None:
        spec = reseeded(spec, seed)
    if num_frames is not None:
        if not 1 <= num_frames <= len(spec.rig_from_world):
            raise InputError(
                f"preset {preset!r} has 1 to {len(spec.rig_from_world)} frames, "
                f"got {num_frames}"
            )
        spec = replace(spec, rig_from_world=spec.rig_from_world[:num_frames])
    if clear_water:
        spec = replace(spec, water=WaterOptions())
    if jpeg_quality is not None:
        spec = replace(spec, jpeg_quality=jpeg_quality)
    render_sequence(spec, Path(out_dir), progress)
    return spec


def simulate_observations(
    path: Path,
    *,
    trajectory: str = "rich",
    num_frames: int = 15,
    altitude: float = 2.0,
    relief: float = 0.2,
    num_points: int = 800,
    noise_px: float = 0.5,
    outlier_ratio: float = 0.0,
    detection_rate: float = 1.0,
    distance: float = 0.02,
    thickness: float = 0.005,
    focal_px: float = 1000.0,
    seed: int = 0,
) -> SimulatedScene:
    """Simulate what the stereo rig of Sedlazeck & Koch (2011) would observe.

    Args:
        path: The .npz file to write; must not exist. See
            `uwsfm.simulate.observation_file.ARRAYS`.
        trajectory: One of `TRAJECTORIES`.
        num_frames: Stereo pairs, at least two.
        altitude: Mean height above the floor, metres.
        relief: Standard deviation of the floor's depth, metres; 0 is flat.
        num_points: Points seen at least twice.
        noise_px: Standard deviation per image coordinate.
        outlier_ratio: Fraction of observations moved anywhere in their image.
        detection_rate: Chance that a visible point is observed.
        distance: Of both ports, metres.
        thickness: Of both glasses, metres.
        focal_px: Of both cameras, 1200x900 pixels.
        seed: Of the floor, the points and the noise.

    Raises:
        InputError: an unknown trajectory, a value out of range, or something to write
            over.
        UwsfmError: the rig does not see enough of the floor.
    """
    if not str(path).endswith(".npz"):
        raise InputError(f"{path}: the name of an observation file must end in .npz")
    target = checked_target(path)
    simulated = simulate_scene(
        paper_rig(thickness=thickness, focal_px=focal_px, distance=distance),
        _trajectory(trajectory, num_frames, altitude),
        Relief(stddev=relief, seed=seed),
        ObservationOptions(
            num_points=num_points,
            noise_px=noise_px,
            outlier_ratio=outlier_ratio,
            detection_rate=detection_rate,
            seed=seed,
        ),
    )
    write_observations(simulated, target)
    return simulated


def _trajectory(name: str, num_frames: int, altitude: float) -> Array:
    """Poses (num_frames, 7), neighbours overlapping by about 80 % at any altitude."""
    if num_frames < 2 or not 0.0 < altitude < np.inf:
        raise InputError(
            "a trajectory needs at least two frames and a positive altitude, "
            f"got {num_frames} and {altitude}"
        )
    if name == "rich":
        return rich_motion(num_frames, altitude=altitude, extent=0.35 * altitude)
    if name == "strip":
        return straight_strip(num_frames, spacing=0.1 * altitude, altitude=altitude)
    if name == "lawn-mower":
        num_lines = max(1, round(np.sqrt(num_frames / 2.0)))
        poses = lawn_mower(
            num_lines,
            -(-num_frames // num_lines),
            spacing=0.15 * altitude,
            line_spacing=0.3 * altitude,
            altitude=altitude,
        )
        return poses[:num_frames]
    raise InputError(f"no trajectory {name!r}; there are: {', '.join(TRAJECTORIES)}")
