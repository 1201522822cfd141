"""From images to a perspective start: the front end of a reconstruction."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from uwsfm._base.files import replaced_file
from uwsfm._base.progress import Progress, silent
from uwsfm._base.tasks import Workers
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import remove_database
from uwsfm.sfm.frontend.features import extract_features, store_intrinsics
from uwsfm.sfm.frontend.images import (
    Frames,
    check_masks,
    find_frames,
    mask_path,
    mask_warnings,
    range_warnings,
)
from uwsfm.sfm.frontend.matching import clear_matches, match_features
from uwsfm.sfm.frontend.parallel import (
    FEATURES,
    MATCHES,
    extract_elsewhere,
    match_elsewhere,
    workers_of,
)
from uwsfm.sfm.mapping.refractive_start import RefractiveStart
from uwsfm.sfm.options import FeatureOptions, StartOptions
from uwsfm.sfm.pinhole.mapping_database import write_mapping_database
from uwsfm.sfm.pinhole.perspective import PerspectiveStart, load_start, write_start
from uwsfm.sfm.refractive_steps import map_refractively
from uwsfm.sfm.rig_checks.baseline import rig_from_baseline
from uwsfm.sfm.rig_checks.fixed_rig import FixedRig, fix_rig, mapping_summary
from uwsfm.sfm.rig_checks.pinhole_search import search_models
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.workspace import Workspace

Start = PerspectiveStart | RefractiveStart
"""Where mapping ended, by the mapper that was asked for."""


def perspective_start(
    rig: Rig,
    image_dir: Path,
    work_dir: Path,
    options: StartOptions | None = None,
    progress: Progress = silent,
) -> Start:
    """Register the images of a rig with pinholes that resemble its ports.

    Steps whose inputs have not changed since they were finished in ``work_dir`` are
    skipped, an interrupted one goes on.

    Args:
        rig: Lenses, initial ports, and poses or the length of the baseline.
        image_dir: Holds one folder of images per camera.
        work_dir: The workspace.
        options: How.
        progress: Called with each long step.

    Raises:
        InputError: images that are missing, unreadable or of the wrong size, or a rig
            that contradicts them.
        UwsfmError: too few matches, or nothing could be reconstructed.
    """
    options = options or StartOptions()
    frames = find_frames(Path(image_dir), rig)
    steps, space = Steps(Path(work_dir)), Workspace(work_dir=Path(work_dir))
    with workers_of(options, space.work_dir) as workers:
        key = match_images(rig, frames, steps, space, options, progress, workers)
        return start_from_matches(rig, frames, steps, key, options, progress, workers)


def start_from_matches(
    rig: Rig,
    frames: Frames,
    steps: Steps,
    key: str,
    options: StartOptions,
    progress: Progress = silent,
    workers: Workers | None = None,
) -> Start:
    """`perspective_start`, from a workspace whose database holds raw matches.

    Args:
        rig: As in `perspective_start`.
        frames: The images; only their names are used.
        steps: Of the workspace.
        key: Fingerprint of what the matches depend on.
        options: How.
        progress: Called with each long step.
        workers: Who maps the parts of a long survey; those of the options by default.

    Raises:
        InputError: the rig contradicts the matches.
        UwsfmError: nothing could be reconstructed.
    """
    space = Workspace(work_dir=steps.work_dir)
    geometry = [_rig_content(rig), asdict(options.verification), options.seed]
    if len(rig.cameras) == 1:
        geometry.append(options.scene_distance_m)
    if rig.cam_from_rig is None:
        key = steps.run(
            "rig",
            [key, geometry, asdict(options.mapping)],
            lambda: _derive_rig(rig, frames, space, options, progress),
            outputs=[space.rig],
        )
        poses = np.array(json.loads(space.rig.read_text(encoding="utf-8")))
    else:
        poses = np.asarray(rig.cam_from_rig)

    @cache
    def fixed() -> FixedRig:
        return fix_rig(rig, poses, frames, space.features, options.scene_distance_m)

    def verify() -> None:
        write_mapping_database(
            space.features,
            space.mapping,
            frames,
            rig.refractive_cameras(),
            fixed().pinholes,
            fixed().rotation.cam_from_rig,
            options,
            progress,
        )

    key = steps.run("verification", [key, geometry], verify, outputs=[space.mapping])
    start: Start
    if options.mapper == "refractive":
        start = map_refractively(
            rig, frames, steps, key, fixed, options, progress, workers
        )
    else:
        steps.run(
            "mapping",
            [key, asdict(options.mapping)],
            lambda: _map(rig, frames, fixed(), space, options, progress),
            outputs=[space.perspective],
        )
        start = load_start(space.perspective, space.features, frames)
    start.summary["timings_s"] = steps.seconds()
    start.summary["warnings"] += mask_warnings(frames, options.features.mask_dir)
    start.summary["warnings"] += range_warnings(frames)
    start.summary["steps_of_earlier_runs"] = steps.of_earlier_runs()
    return start


def match_images(
    rig: Rig,
    frames: Frames,
    steps: Steps,
    space: Workspace,
    options: StartOptions,
    progress: Progress,
    workers: Workers | None = None,
) -> str:
    """Features and raw matches, in the workspace's database; their fingerprint.

    Neither depends on lenses, ports or poses, nor on who finds them: threads of this
    process, or workers elsewhere.
    """
    elsewhere = workers if workers is not None and workers.elsewhere else None
    sizes = sorted([c.images, c.camera.width, c.camera.height] for c in rig.cameras)
    inputs = [
        [version("uwsfm"), pycolmap.__version__, "colours"],
        sizes,
        frames.fingerprint(),
        asdict(options.features),
        _mask_content(frames, options.features),
    ]

    def extract() -> None:
        if options.features.mask_dir is not None:
            check_masks(frames, rig, options.features.mask_dir)
        if elsewhere is not None:
            extract_elsewhere(
                frames, rig, space.features, options.features, elsewhere, progress
            )
            return
        extract_features(
            frames,
            rig,
            space.features,
            options.features,
            num_threads=options.threads,
            progress=progress,
        )

    def match() -> None:
        # The paper's matcher is for few images, and stays here.
        if elsewhere is not None and options.matching.matcher == "colmap":
            match_elsewhere(
                frames, space.features, options.matching, elsewhere, progress
            )
            return
        match_features(
            frames,
            space.features,
            options.matching,
            seed=options.seed,
            num_threads=options.threads,
            progress=progress,
        )

    def forget() -> None:
        remove_database(space.features)
        for folder in (space.colors, space.work_dir / FEATURES):
            shutil.rmtree(folder, ignore_errors=True)

    def forget_matches() -> None:
        clear_matches(space.features)
        shutil.rmtree(space.work_dir / MATCHES, ignore_errors=True)

    key = steps.run("features", inputs, extract, outputs=[space.features], clear=forget)
    store_intrinsics(rig, space.features)
    # COLMAP's matches do not depend on the seed: another one must not repeat them.
    seeds = [options.seed] if options.matching.matcher == "paper" else []
    return steps.run(
        "matches",
        [key, asdict(options.matching), seeds],
        match,
        outputs=[space.features],
        clear=forget_matches,
    )


def _mask_content(frames: Frames, options: FeatureOptions) -> list[Any]:
    if options.mask_dir is None:
        return []
    masks = (mask_path(options.mask_dir, name) for name in frames.image_names())
    found = [(mask, mask.stat()) for mask in masks if mask is not None]
    return [[str(mask), stat.st_size, stat.st_mtime_ns] for mask, stat in found]


def _rig_content(rig: Rig) -> list[Any]:
    """All of a rig that its geometry depends on, JSON."""
    rows: list[Any] = [
        [
            item.images,
            item.camera.model_name,
            item.camera.width,
            item.camera.height,
            np.asarray(item.camera.params).tolist(),
            item.port.row.tolist(),
            item.valid_radius_px,
        ]
        for item in rig.cameras
    ]
    poses = rig.cam_from_rig
    return [rows, None if poses is None else poses.tolist(), rig.baseline_m]


def _derive_rig(
    rig: Rig,
    frames: Frames,
    space: Workspace,
    options: StartOptions,
    progress: Progress,
) -> None:
    poses = rig_from_baseline(
        space.features, space.work_dir, frames, rig, options, progress
    )
    with replaced_file(space.rig) as partial:
        partial.write_text(json.dumps(poses.tolist()), encoding="utf-8")


def _map(
    rig: Rig,
    frames: Frames,
    fixed: FixedRig,
    space: Workspace,
    options: StartOptions,
    progress: Progress,
) -> None:
    search = search_models(rig, frames, fixed, space, options, progress)
    models = search.models
    if len(rig.cameras) == 1:
        _scale_to(models[0], options.scene_distance_m)
    best = models[0]
    registered = {best.images[i].name.rpartition("/")[2] for i in best.reg_image_ids()}
    summary = {
        "num_points": best.num_points3D(),
        "num_observations": best.compute_num_observations(),
        "mean_error_px": best.compute_mean_reprojection_error(),
        "num_starts": search.num_starts,
        "noise_floor": None if search.floor is None else search.floor.summary(),
        **mapping_summary(
            rig,
            frames,
            fixed,
            registered,
            [model.num_reg_frames() for model in models[1:]],
        ),
    }
    write_start(
        space.perspective,
        best,
        fixed.rotation.cam_from_rig,
        fixed.pinholes,
        fixed.depths,
        summary,
    )


def _scale_to(model: pycolmap.Reconstruction, scene_distance_m: float) -> None:
    """Put the points of a model at this median depth: its scale is arbitrary."""
    depths = []
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
        points = np.array([model.points3D[i].xyz for i in seen]).reshape(-1, 3)
        pose = image.cam_from_world()
        depths.append(points @ pose.rotation.matrix()[2] + pose.translation[2])
    scale = scene_distance_m / float(np.median(np.concatenate(depths)))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
