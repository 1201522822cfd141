"""Dives from rendered images: their features are found and matched once."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from dives import Dive, read_dive

from uwsfm.rig.file import load_rig
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.start import match_images
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.workspace import Workspace
from uwsfm.simulate.commands import simulate_images
from uwsfm.simulate.sequence import PRESETS

SAMPLE = Path(__file__).parents[2] / "datasets" / "sample"


def rendered_dive(folder: Path, *, num_frames: int | None, domes: bool) -> Dive:
    """Features and raw matches of a preset, from ``folder`` where they were found.

    Args:
        folder: Receives images and workspaces.
        num_frames: None: the whole sample, at its full size; else so many frames of the
            small preset.
        domes: The preset behind domes, small in either case.
    """
    preset = "dome" if domes else "small" if num_frames else "sample"
    name = preset if num_frames is None else f"{preset}_{num_frames}"
    return _found(folder / name, preset, num_frames)


@cache
def _found(folder: Path, preset: str, num_frames: int | None) -> Dive:
    source = SAMPLE if preset == "sample" else folder / "dive"
    if not source.exists():
        simulate_images(source, preset=preset, num_frames=num_frames)
    rig = load_rig(source / "rig.yaml")
    frames = find_frames(source / "images", rig)
    work = folder / "work"
    space = Workspace(work_dir=work)
    match_images(rig, frames, Steps(work), space, StartOptions(), lambda *_: None)
    spec = PRESETS[preset]()
    poses = np.asarray(spec.rig_from_world)[:num_frames]
    return read_dive(space.features, frames, rig, spec.rig, poses)
