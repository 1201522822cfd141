"""The main job: images and a rig in, a metric refractive model out."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.progress import Progress, silent
from uwsfm._base.tasks import Workers
from uwsfm.calibration.result import CalibrationResult
from uwsfm.colmap.model import Model
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.jobs.checks import at_scene_distance, checked_rig, require_effect
from uwsfm.jobs.finish import ModelJob, compiled, refined_rig, start_scene
from uwsfm.jobs.judgement import judged_result
from uwsfm.jobs.output_folder import WORK, locked, made_of_files, output_folder
from uwsfm.options.jobs import ReconstructOptions
from uwsfm.report.command import command_line
from uwsfm.results.folder import recorded_images
from uwsfm.results.log import job_log
from uwsfm.results.refined import refined_summary
from uwsfm.results.summary import (
    errors_summary,
    housing_summary,
    outside_summary,
    versions,
)
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.colors import stored_point_colors
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.pinhole.perspective import StartArrays
from uwsfm.sfm.refine import Refined, rig_options
from uwsfm.sfm.start import Start, perspective_start
from uwsfm.sfm.workspace import Workspace
from uwsfm.trust.refusal import refined_or_explained
from uwsfm.trust.verdict import Verdict, used_of


@dataclass(frozen=True, kw_only=True, eq=False)
class ReconstructResult:
    """What `reconstruct` found; the same is on disk."""

    model: Model
    calibration: CalibrationResult
    """Of ``model.scene``, with covariances."""
    summary: dict[str, Any]
    """summary.json"""
    start: StartArrays
    """Where the mapper ended, before the refractive adjustment."""
    verdict: Verdict
    """Whether the result is to be trusted."""


def reconstruct(
    rig: Rig | str | Path,
    images: str | Path,
    out: str | Path,
    options: ReconstructOptions | None = None,
    *,
    progress: Progress = silent,
    **settings: object,
) -> ReconstructResult:
    """Reconstruct a dive: features, a map, the refractive optimum, files.

    The steps before the refractive adjustment keep their results in the workspace
    ``out/uwsfm-work``: a run that was stopped goes on where it was, and one with other
    settings repeats what they change.

    Args:
        rig: A rig, or the path of a rig file.
        images: Folder that holds one folder of images per camera.
        out: Receives ``sparse/`` (COLMAP), ``housing.yaml``, ``points.ply``,
            ``calibration.npz``, ``options.yaml`` and ``summary.json``, each replaced as
            a whole; `uwsfm.open_result` reads it.
        options: How; None: the defaults.
        progress: Called with each long step.
        **settings: Options by name, as ``max_features=4000``, in place of those of
            ``options``; and fields of `CalibrateOptions`, for the last adjustment.

    Raises:
        InputError: An option, the rig file, images or output folder are not usable.
        UwsfmError: The images could not be reconstructed; the message says why.
    """
    options = (options or ReconstructOptions()).with_settings(settings)
    command = command_line("reconstruct", (rig, images), out, options)
    asked = {"rig": rig, "images": images, "out": out, **options.values()}
    rig_source, rig = rig, checked_rig(rig)
    require_effect({**rig_options(rig), **options.adjustment.as_fields()})
    made_of = made_of_files(rig_source, images)
    out = output_folder(out, images, made_of)
    options, known = at_scene_distance(options, rig), options.constraints
    # Wrong folders and files fail before anything is written.
    options.front_end.features.require_masks()
    frames = find_frames(Path(images), rig)
    lengths = KnownLengths.read(known.lengths, known.positions, known.lever_arm)
    lengths.check_names(rig, frames.names)
    with Workers(options.front_end.scheduler):  # whether it answers, and has a worker
        pass
    with locked(out), job_log(out, command, asked, progress) as log:
        job = _Job(
            rig=rig,
            images=Path(images),
            out=out,
            options=options,
            known=lengths,
            made_of=made_of,
            command=command,
            progress=log.progress,
        )
        result = job.run()
        log.result(result.summary)
        return result


@dataclass(frozen=True, kw_only=True)
class _Job(ModelJob):
    """One reconstruction, its input and how it is to be done."""

    images: Path
    options: ReconstructOptions
    known: KnownLengths

    def run(self) -> ReconstructResult:
        out, front_end = self.out, self.options.front_end
        timings = compiled(front_end.threads, self.progress)
        start = perspective_start(
            self.rig, self.images, out / WORK, front_end, self.progress
        )
        timings.update(start.summary["timings_s"])
        clock = time.perf_counter()
        arrays = start.arrays()
        refined = self._refined(start, arrays)
        timings["refractive adjustment"] = time.perf_counter() - clock
        clock = time.perf_counter()
        used = used_of(refined, start.summary["num_frames"])
        judged = judged_result(self.rig, refined.calibration, used, self.progress)
        timings["judging the fit"] = time.perf_counter() - clock
        clock, calibration = time.perf_counter(), judged.calibration
        model = _model(self.rig, arrays, refined, out / WORK)
        self.write(model, judged)
        timings["colours and export"] = time.perf_counter() - clock
        refined = replace(refined, calibration=calibration)
        summary = _summary(model, start, refined, timings, self.images)
        summary = self.finish(model, judged, summary, timings)
        return ReconstructResult(
            model=model,
            calibration=calibration,
            summary=summary,
            start=arrays,
            verdict=judged.verdict,
        )

    def _refined(self, start: Start, arrays: StartArrays) -> Refined:
        scene = start_scene(self.rig, start, arrays)
        scene, lengths = self.known.placed(self.rig, arrays.frame_names, scene)
        # What is known beforehand is known of the rig file's ports, not of the map's.
        known = replace(scene, cameras=self.rig.refractive_cameras())
        return refined_or_explained(
            scene,
            self.rig,
            arrays.frame_names,
            self.progress,
            known=known,
            lengths=lengths,
            **self.options.adjustment.as_fields(),
        )


def _model(rig: Rig, arrays: StartArrays, refined: Refined, work_dir: Path) -> Model:
    scene, keypoint_idx = refined.scene, arrays.keypoint_idx[refined.kept]
    names = [
        [f"{camera.images}/{name}" for name in arrays.frame_names]
        for camera in rig.cameras
    ]
    colors_dir = Workspace(work_dir=work_dir).colors
    return Model(
        rig=refined_rig(rig, scene),
        scene=scene,
        frame_names=arrays.frame_names,
        keypoints=arrays.keypoints,
        keypoint_idx=keypoint_idx,
        colors=stored_point_colors(scene, keypoint_idx, names, colors_dir),
    )


def _summary(
    model: Model,
    start: Start,
    refined: Refined,
    timings: dict[str, float],
    images: Path,
) -> dict[str, Any]:
    mapped = dict(start.summary)
    cameras = housing_summary(model.rig, refined.calibration)
    warnings = mapped.pop("warnings")
    warnings += _images_without_points(model)
    del mapped["timings_s"]
    found = errors_summary(refined.calibration)
    after = found.pop("reprojection_rms_px")
    return {
        "num_frames": mapped["num_frames"],
        "num_images": mapped.pop("num_frames") * len(model.rig.cameras),
        "unregistered_frames": mapped.pop("unregistered_frames"),
        **found,
        "reprojection_rms_px": {"before": refined.start_rms_px, "after": after},
        "cameras": cameras,
        "refined": refined_summary(model.rig, refined.calibration),
        **outside_summary(refined.calibration, model.frame_names),
        "baseline_m": model.rig.baseline_m,
        "baseline_stddev_m": model.rig.baseline_stddev_m,
        f"{start.kind}_start": mapped,
        "warnings": warnings,
        "images": recorded_images(images),
        "timings_s": timings,
        "steps_of_earlier_runs": mapped.pop("steps_of_earlier_runs"),
        "versions": versions(),
    }


def _images_without_points(model: Model) -> list[str]:
    scene = model.scene
    seen = np.zeros((len(scene.cameras), scene.num_frames), dtype=bool)
    seen[scene.camera_idx, scene.frame_idx] = True
    names = [model.image_name(c, f) for c, f in np.argwhere(~seen).tolist()]
    if not names:
        return []
    which = f"{len(names)} images see no point of the result, for instance {names[0]}"
    if len(names) == 1:
        which = f"image {names[0]} sees no point of the result"
    return [
        f"{which}: is the scene in view, and were the images of a frame taken together?"
    ]
