"""Housing calibration from images or from a COLMAP model: the housing, and no cloud."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.options import options_of
from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.error_budget import BudgetRow
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import CalibrationResult
from uwsfm.errors import InputError
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.jobs.checks import at_scene_distance, checked_rig, require_effect
from uwsfm.jobs.finish import compiled, refined_rig, start_scene
from uwsfm.jobs.judgement import Judgement, judged_result
from uwsfm.jobs.output_folder import (
    WORK,
    locked,
    made_of_files,
    output_folder,
    require_elsewhere,
)
from uwsfm.options.file import OPTIONS, write_options
from uwsfm.options.jobs import CalibrateHousingOptions
from uwsfm.report.command import command_line
from uwsfm.results.files import HOUSING, HOUSING_SUMMARY, SPARSE
from uwsfm.results.housing import export_housing
from uwsfm.results.log import job_log
from uwsfm.results.refined import refined_summary
from uwsfm.results.summary import (
    errors_summary,
    housing_summary,
    versions,
    write_json,
)
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.from_colmap.colmap_model import find_model
from uwsfm.sfm.from_colmap.model_start import ModelStart, start_from_model
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.refine import rig_options, within_valid_radius
from uwsfm.sfm.rig_checks.stereo_scene import same_frame_scene, without_wrong_matches
from uwsfm.sfm.start import match_images, perspective_start
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.workspace import Workspace
from uwsfm.trust.goodness import Used
from uwsfm.trust.refusal import refined_or_explained
from uwsfm.trust.verdict import Verdict, used_of


@dataclass(frozen=True, kw_only=True, eq=False)
class HousingResult:
    """A calibrated housing; the same is on disk."""

    rig: Rig
    calibration: CalibrationResult
    budget: tuple[BudgetRow, ...]
    """What errors of the given numbers would do to it."""
    summary: dict[str, Any]
    """calibration.json"""
    verdict: Verdict
    """Whether the result is to be trusted."""


def calibrate_housing(
    rig: Rig | str | Path,
    source: str | Path,
    out: str | Path,
    options: CalibrateHousingOptions | None = None,
    *,
    progress: Progress = silent,
    **settings: object,
) -> HousingResult:
    """Calibrate the ports of a rig from images, or from a COLMAP model of them.

    Args:
        rig: a rig, or the path of a rig file; its ports are the initial values.
        source: folder of images as for `reconstruct`, a COLMAP model whose images are
            in the rig's folders, or the output folder of `reconstruct`.
        out: receives ``housing.yaml``, ``calibration.json`` and ``options.yaml``.
        options: how; None: the defaults. One stereo pair starts from "pairs".
        progress: called with each long step.
        **settings: options by name, in place of those of ``options``; ``front_end``
            for a whole `StartOptions`; and fields of `CalibrateOptions`.

    Raises:
        InputError: the rig, the source, an option or the output folder is not usable;
            or a port distance is asked of single stereo pairs.
        UwsfmError: the images could not be reconstructed; the message says why.
    """
    options = (options or CalibrateHousingOptions()).with_settings(settings)
    command = command_line("calibrate", (rig, source), out, options)
    asked = {"rig": rig, "source": source, "out": out, **options.values()}
    made_of = made_of_files(rig, source)
    rig, known = checked_rig(rig), options.constraints
    job = _Job(
        rig=rig,
        source=Path(source),
        out=Path(out),
        options=at_scene_distance(options, rig),
        lengths=KnownLengths.read(known.lengths, known.positions, known.lever_arm),
        made_of=made_of,
        progress=progress,
    )
    # A wrong option fails before anything is written.
    require_effect(job.adjusted)
    require_elsewhere(out, source)
    _require_place(job.source, output_folder(out, made_of=made_of))
    model = find_model(job.source)
    if model is None:
        start = None
        job = job.from_images()
    else:
        job.require_model_options()
        start = start_from_model(model, rig, job.options.front_end.scene_distance_m)
        job.lengths.check_names(rig, start.tracks.frame_names)
    with locked(job.out), job_log(job.out, command, asked, progress) as log:
        result = replace(job, progress=log.progress).run(start)
        log.result(result.summary)
        return result


def _require_place(source: Path, out: Path) -> None:
    """Refuse a source that is neither images nor a model, and results of other jobs."""
    if source.suffix == ".npz" and source.is_file():
        raise InputError(
            f"{source} holds arrays, and neither images nor a model: observations are "
            "calibrated in Python, uwsfm.calibrate(scene), with the scene of "
            f"uwsfm.simulate.read_observations({source.name!r})"
        )
    if (out / SPARSE).exists():
        raise InputError(
            f"{out} holds a reconstruction, whose housing this would replace: choose "
            "another folder"
        )


@dataclass(frozen=True)
class _Job:
    """One calibration, its input and how it is to be done."""

    rig: Rig
    source: Path
    out: Path
    options: CalibrateHousingOptions
    lengths: KnownLengths
    made_of: dict[str, str | None]
    progress: Progress

    @property
    def adjusted(self) -> dict[str, Any]:
        """Fields of `CalibrateOptions`: of the rig file, and those that were asked."""
        return {
            **rig_options(self.rig),
            "strategy": self.options.strategy,
            "error": self.options.error,
            **self.options.adjustment.as_fields(),
        }

    def from_images(self) -> "_Job":
        """The job as the images allow it: one frame can only be a single pair.

        Raises:
            InputError: images are missing, or an option has no effect on them.
        """
        self.options.front_end.features.require_masks()
        frames = find_frames(self.source, self.rig, min_num_frames=1)
        self.lengths.check_names(self.rig, frames.names)
        if self.options.start != "pairs" and len(frames.names) > 1:
            return self
        _require_distances_held(self.rig, self.adjusted, len(frames.names))
        self._require_unused(_MAPPING, "single stereo pairs are not mapped")
        if self.lengths.given:
            raise InputError(
                "lengths and positions have no effect: single stereo pairs determine "
                "normals only"
            )
        return replace(self, options=replace(self.options, start="pairs"))

    def require_model_options(self) -> None:
        """Refuse what is asked of images, for a COLMAP model is the source."""
        if self.options.start == "pairs":
            raise InputError(f"{self.source} is a model: start 'pairs' needs images")
        self._require_unused(
            (*_MATCHING, *_MAPPING),
            "a COLMAP model is the start, and no image is read; leave this option out, "
            "or give the folder of the images",
        )

    def _require_unused(self, names: Container[str], why: str) -> None:
        """Refuse options, by name, that are not at their defaults."""
        for item, value in self.options.items():
            if item.name in names and value != item.default:
                raise InputError(f"{item.label} has no effect: {why}")

    def run(self, model: ModelStart | None) -> HousingResult:
        compiled(self.options.front_end.threads, self.progress)
        if self.options.start == "pairs":
            calibration = self._from_pairs()
            count = calibration.scene.num_frames
            seen = len(np.unique(calibration.scene.frame_idx[calibration.inliers]))
            used = Used(num_frames=count, num_registered=seen)
        else:
            if model is None:
                scene, names, num_frames = self._from_images()
            else:
                scene, names = model.tracks.scene, model.tracks.frame_names
                num_frames = len(names)
            if self.options.start == "paper":
                scene = self._paper_start(scene)
            scene, lengths = self.lengths.placed(self.rig, names, scene)
            # What is given is given of the rig file's ports, not of the map's.
            known = replace(scene, cameras=self.rig.refractive_cameras())
            refined = refined_or_explained(
                scene,
                self.rig,
                names,
                self.progress,
                known=known,
                lengths=lengths,
                **self.adjusted,
            )
            calibration, used = refined.calibration, used_of(refined, num_frames)
        judged = judged_result(
            self.rig,
            calibration,
            used,
            self.progress,
            in_halves=self._reprojects and self.options.start != "pairs",
            has_model=False,
        )
        return self._finish(judged, () if model is None else model.warnings)

    @property
    def _reprojects(self) -> bool:
        """Whether it is the joint adjustment of pixels, which takes little time."""
        options = CalibrateOptions.parsed(self.adjusted)
        return options.strategy == "joint" and options.error_name == "reprojection"

    def _from_images(self) -> tuple[Scene, Sequence[str], int]:
        """The start, the names of its frames, and how many frames there were."""
        front_end = self.options.front_end
        start = perspective_start(
            self.rig, self.source, self.out / WORK, front_end, self.progress
        )
        arrays = start.arrays()
        scene = start_scene(self.rig, start, arrays)
        return scene, arrays.frame_names, start.summary["num_frames"]

    def _paper_start(self, scene: Scene) -> Scene:
        """Poses from pinholes, by what the calibrations in air reached: section 3.2.2.

        The tracks stay whole, for the caller tests them again.
        """
        part, used = scene.select(within_valid_radius(scene, self.rig))
        adjusted, _ = perspective_adjustment(part, loss="cauchy")
        points = np.full_like(scene.points, np.nan)
        points[used] = adjusted.points
        return replace(
            scene,
            cam_from_rig=adjusted.cam_from_rig,
            rig_from_world=adjusted.rig_from_world,
            points=points,
        )

    def _from_pairs(self) -> CalibrationResult:
        """Normals from single stereo pairs: section 3.2.1."""
        frames = find_frames(self.source, self.rig, min_num_frames=1)
        space = Workspace(work_dir=self.out / WORK)
        steps = Steps(space.work_dir)
        front_end = self.options.front_end
        match_images(self.rig, frames, steps, space, front_end, self.progress)
        scene = same_frame_scene(self.rig, frames, space.features)
        options = {**self.adjusted, **PAIRS_HOLD}
        first = calibrate(scene, **options)
        found = without_wrong_matches(replace(scene, cameras=first.scene.cameras))
        return calibrate(found, known=scene, **options)

    def _notes(self) -> list[str]:
        """What was taken for granted, one sentence each."""
        if self.options.start != "pairs":
            return []
        return [
            "single stereo pairs determine the normals only: cam_from_rig and the port "
            "distances were taken as given"
        ]

    def _finish(self, judged: Judgement, notes: Sequence[str]) -> HousingResult:
        calibration = judged.calibration
        scene, _ = calibration.scene.select(calibration.inliers)
        rig = refined_rig(self.rig, scene)
        summary = {
            "strategy": calibration.options.strategy,
            "error": calibration.options.error_name,
            "start": self.options.start,
            **errors_summary(calibration),
            "cameras": housing_summary(rig, calibration),
            "refined": refined_summary(rig, calibration),
            "warnings": [*self._notes(), *notes],
            "made_of": self.made_of,
            "versions": versions(),
        }
        summary = judged.added_to(summary, rig)
        if self.options.start != "pairs":  # which hold what most mistakes show in
            causes = judged.causes(self.rig, progress=self.progress)
            summary["explanations"] = causes
        export_housing(rig, self.out / HOUSING, calibration, verdict=judged.word)
        write_options(self.options, self.out / OPTIONS)
        write_json(summary, self.out / HOUSING_SUMMARY)
        return HousingResult(
            rig=rig,
            calibration=calibration,
            budget=judged.budget,
            summary=summary,
            verdict=judged.verdict,
        )


PAIRS_HOLD = {"refine_distances": False, "refine_cam_from_rig": False}
"""What single stereo pairs do not determine."""
_MATCHING = tuple(
    item.name
    for item in options_of(CalibrateHousingOptions)
    if item.path[:2] in (("front_end", "features"), ("front_end", "matching"))
)
_MAPPING = ("submap_frames", "mapper", "scheduler")
"""Options of the front end, by name; seed and threads are of other steps, too."""


def _require_distances_held(
    rig: Rig, options: Mapping[str, Any], num_frames: int
) -> None:
    wanted = np.broadcast_to(options["refine_distances"], len(rig.cameras))
    if np.any(wanted):
        index = int(np.argmax(wanted))
        what = "one stereo pair" if num_frames == 1 else "single stereo pairs"
        raise InputError(
            f"cameras[{index}].port.refine: the distance of a port cannot be estimated "
            f"from {what}, because for every distance there are points that fit; "
            "give the distances and write refine: [normal] for every camera, or "
            f"{'use more frames' if num_frames == 1 else 'take another start'}"
        )
