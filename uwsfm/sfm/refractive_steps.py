"""The steps of the refractive mapper: one map, or many and what joins them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from functools import cache

import numpy as np

from uwsfm._base.progress import Progress
from uwsfm._base.tasks import Workers
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.frontend.parallel import workers_of
from uwsfm.sfm.mapping.correspondences import Correspondences, read_correspondences
from uwsfm.sfm.mapping.incremental import map_incrementally
from uwsfm.sfm.mapping.refractive_start import (
    RefractiveStart,
    load_refractive_start,
    write_refractive_start,
)
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.refine import rig_options
from uwsfm.sfm.rig_checks.fixed_rig import FixedRig, mapping_summary, turned_to
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.submaps.merging import merge_submaps
from uwsfm.sfm.submaps.splitting import part_size
from uwsfm.sfm.submaps.survey import map_parts, read_all
from uwsfm.sfm.workspace import Workspace


def map_refractively(
    rig: Rig,
    frames: Frames,
    steps: Steps,
    key: str,
    fixed: Callable[[], FixedRig],
    options: StartOptions,
    progress: Progress,
    workers: Workers | None,
) -> RefractiveStart:
    """Map verified matches; a long survey part by part.

    Args:
        rig: As of `map_incrementally`.
        frames: The images.
        steps: Of the workspace.
        key: Fingerprint of what the verified matches depend on.
        fixed: Gives the rig that fits the initial ports.
        options: How.
        progress: Called with each long step.
        workers: Who maps the parts; None: those of the options.

    Raises:
        UwsfmError: nothing could be reconstructed.
    """
    space = Workspace(work_dir=steps.work_dir)
    inputs = [key, "refractive", asdict(options.mapping), rig_options(rig)]
    part_frames = part_size(len(frames.names), options.mapping.submap_frames)

    @cache
    def matches() -> Correspondences:
        return read_correspondences(space.features, space.mapping, frames, rig)

    def map_all_parts() -> None:
        assert part_frames is not None
        with ExitStack() as stack:
            map_parts(
                matches(),
                rig,
                fixed().rotation.cam_from_rig,
                part_frames,
                options,
                space.submaps,
                workers or stack.enter_context(workers_of(options, space.work_dir)),
                progress,
            )

    def map_all() -> None:
        placement, submaps = fixed().rotation.cam_from_rig, {}
        if part_frames is None:
            maps = map_incrementally(matches(), rig, placement, options, progress)
            best, others = maps[0], [other.num_registered for other in maps[1:]]
        else:
            parts = read_all(space.submaps)
            merged = merge_submaps(matches(), parts, rig, placement, options, progress)
            best, others = merged.map, merged.others
            submaps = {"submaps": merged.summary()}
        ended = turned_to(fixed(), best.cam_from_rig)
        registered = {frames.names[f] for f in np.flatnonzero(best.registered)}
        summary = {
            **best.counts(),
            **submaps,
            **mapping_summary(rig, frames, ended, registered, others),
        }
        write_refractive_start(space.refractive, best, summary)

    if part_frames is not None:
        steps.run(
            "submaps",
            inputs,
            map_all_parts,
            outputs=[space.submaps],
            clear=lambda: shutil.rmtree(space.submaps, ignore_errors=True),
        )
    steps.run("mapping", inputs, map_all, outputs=[space.refractive])
    return load_refractive_start(space.refractive, space.features, frames)
