"""Housing calibration from images or from a COLMAP model: the housing, and no cloud."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from uwsfm._progress import Progress, silent
from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.error_budget import BudgetRow
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.calibration.problem import CalibrateOptions, CalibrationResult
from uwsfm.errors import InputError
from uwsfm.export.files import HOUSING, HOUSING_SUMMARY, SPARSE
from uwsfm.export.housing import export_housing
from uwsfm.export.summary import (
    errors_summary,
    housing_summary,
    refined_summary,
    versions,
    write_json,
)
from uwsfm.job_checks import checked_rig, require_effect, scene_distance
from uwsfm.job_log import job_log
from uwsfm.judgement import Judgement, judged_result
from uwsfm.known_lengths import KnownLengths
from uwsfm.output_folder import (
    WORK,
    locked,
    made_of_files,
    output_folder,
    require_elsewhere,
)
from uwsfm.pipeline import compiled, refined_rig, start_scene
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.colmap_model import find_model
from uwsfm.sfm.images import find_frames
from uwsfm.sfm.model_start import ModelStart, start_from_model
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.refine import rig_options, within_valid_radius
from uwsfm.sfm.same_frame_scene import same_frame_scene, without_wrong_matches
from uwsfm.sfm.start import match_images, perspective_start
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.workspace import Workspace
from uwsfm.trust.diagnosis import explain
from uwsfm.trust.goodness import Used
from uwsfm.trust.refusal import refined_or_explained
from uwsfm.trust.verdict import Verdict, used_of

Start = Literal["virtual", "paper", "pairs"]


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
    *,
    start: Start = "virtual",
    front_end: StartOptions | None = None,
    positions: str | Path | None = None,
    lever_arm: ArrayLike | None = None,
    lengths: str | Path | None = None,
    scene_distance_m: float | None = None,
    progress: Progress = silent,
    **options: Any,
) -> HousingResult:
    """Calibrate the ports of a rig from images, or from a COLMAP model of them.

    Args:
        rig: a rig, or the path of a rig file; its ports are the initial values.
        source: folder of images as for `reconstruct`, a COLMAP model whose images are
            in the rig's folders, or the output folder of `reconstruct`.
        out: receives ``housing.yaml`` and ``calibration.json``.
        start: "virtual": pinholes fitted to the initial ports; "paper": adjusted with
            pinholes of 1.333 f and radial distortion besides (section 3.2.2);
            "pairs": matches between the cameras of one frame only, with rig and
            distances as given (section 3.2.1). One frame alone is "pairs".
        front_end: how features are found and matched, and which mapper finds the
            start; see `uwsfm.StartOptions`.
        positions, lever_arm, lengths, scene_distance_m: as in `reconstruct`.
        progress: called with each long step.
        **options: fields of `CalibrateOptions`.

    Raises:
        InputError: the rig, the source, an option or the output folder is not usable;
            or a port distance is asked of single stereo pairs.
        UwsfmError: the images could not be reconstructed; the message says why.
    """
    asked = {**locals()}
    made_of = made_of_files(rig, source)
    rig = checked_rig(rig)
    if start not in get_args(Start):
        raise InputError(
            f"start must be one of {', '.join(get_args(Start))}, got {start!r}"
        )
    merged = {**rig_options(rig), **options}
    # A wrong option fails before anything is written.
    require_effect(CalibrateOptions.parsed(merged))
    known = KnownLengths.read(lengths, positions, lever_arm)
    require_elsewhere(out, source)
    source, out = Path(source), output_folder(out, made_of=made_of)
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
    found = find_model(source)
    front_end = front_end or StartOptions()
    if scene_distance_m is not None:
        distance_m = scene_distance(rig, scene_distance_m)
        front_end = replace(front_end, scene_distance_m=distance_m)
    job = _Job(
        rig=rig,
        source=source,
        out=out,
        start=start,
        front_end=front_end,
        known=known,
        made_of=made_of,
        progress=progress,
        options=merged,
    )
    _require_front_end_effect(front_end, model=found is not None)
    if found is None:
        frames = find_frames(source, rig, min_num_frames=1)
        known.check_names(rig, frames.names)
        if start == "pairs" or len(frames.names) == 1:
            _require_distances_held(rig, merged, len(frames.names))
            job = replace(job, start="pairs")
            if front_end.mapper != StartOptions().mapper:
                raise InputError(
                    f"mapper {front_end.mapper!r} has no effect: single stereo pairs "
                    "are not mapped"
                )
            if known.given:
                raise InputError(
                    "single stereo pairs tell normals only: lengths and positions have "
                    "no effect"
                )
    elif start == "pairs":
        raise InputError(f"{source} is a model: start 'pairs' works from images")
    model = None
    if found is not None:
        model = start_from_model(found, rig, front_end.scene_distance_m)
        known.check_names(rig, model.tracks.frame_names)
    with locked(out), job_log(out, "uwsfm calibrate", asked, progress) as log:
        result = replace(job, progress=log.progress).run(model)
        log.result(result.summary)
        return result


@dataclass(frozen=True)
class _Job:
    """One calibration, its input and how it is to be done."""

    rig: Rig
    source: Path
    out: Path
    start: Start
    front_end: StartOptions
    known: KnownLengths
    made_of: dict[str, str | None]
    progress: Progress
    options: Mapping[str, Any]

    def run(self, model: ModelStart | None) -> HousingResult:
        compiled(self.front_end.threads, self.progress)
        if self.start == "pairs":
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
            if self.start == "paper":
                scene = self._paper_start(scene)
            scene, lengths = self.known.placed(self.rig, names, scene)
            options = {"lengths": lengths, **self.options}
            # What is given is given of the rig file's ports, not of the map's.
            known = replace(scene, cameras=self.rig.refractive_cameras())
            refined = refined_or_explained(
                scene, self.rig, names, self.progress, known=known, **options
            )
            calibration, used = refined.calibration, used_of(refined, num_frames)
        judged = judged_result(
            self.rig,
            calibration,
            used,
            self.progress,
            in_halves=self._reprojects and self.start != "pairs",
            has_model=False,
        )
        return self._finish(judged, () if model is None else model.warnings)

    @property
    def _reprojects(self) -> bool:
        """Whether it is the joint adjustment of pixels, which takes little time."""
        options = CalibrateOptions.parsed(dict(self.options))
        return options.strategy == "joint" and options.error_name == "reprojection"

    def _from_images(self) -> tuple[Scene, Sequence[str], int]:
        """The start, the names of its frames, and how many frames there were."""
        start = perspective_start(
            self.rig, self.source, self.out / WORK, self.front_end, self.progress
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
        match_images(self.rig, frames, steps, space, self.front_end, self.progress)
        scene = same_frame_scene(self.rig, frames, space.features)
        options = {**self.options, **PAIRS_HOLD}
        first = calibrate(scene, **options)
        found = without_wrong_matches(replace(scene, cameras=first.scene.cameras))
        return calibrate(found, known=scene, **options)

    def _notes(self) -> list[str]:
        """What was taken for granted, one sentence each."""
        if self.start != "pairs":
            return []
        return [
            "single stereo pairs tell the normals only: cam_from_rig and the port "
            "distances were taken as given"
        ]

    def _finish(self, judged: Judgement, notes: Sequence[str]) -> HousingResult:
        calibration = judged.calibration
        scene, _ = calibration.scene.select(calibration.inliers)
        rig = refined_rig(self.rig, scene)
        summary = {
            "strategy": calibration.options.strategy,
            "error": calibration.options.error_name,
            "start": self.start,
            **errors_summary(calibration),
            "cameras": housing_summary(rig, calibration),
            "refined": refined_summary(rig, calibration),
            "warnings": [*self._notes(), *notes],
            "made_of": self.made_of,
            "versions": versions(),
        }
        summary = judged.added_to(summary, rig)
        if self.start != "pairs":  # single pairs hold what most mistakes show in
            causes = explain(
                judged.word,
                judged.verdict.codes,
                self.rig,
                calibration,
                progress=self.progress,
            )
            summary["explanations"] = [one.to_json() for one in causes]
        export_housing(rig, self.out / HOUSING, calibration, verdict=judged.word)
        write_json(summary, self.out / HOUSING_SUMMARY)
        return HousingResult(
            rig=rig,
            calibration=calibration,
            budget=judged.budget,
            summary=summary,
            verdict=judged.verdict,
        )


PAIRS_HOLD = {"refine_distances": False, "refine_cam_from_rig": False}
"""What single stereo pairs cannot tell."""


def _require_front_end_effect(front_end: StartOptions, *, model: bool) -> None:
    """Refuse options of the front end that a COLMAP model leaves without an effect."""
    options, defaults = front_end, StartOptions()
    for name, changed in (
        ("mapper", options.mapper != defaults.mapper),
        ("matcher", options.matching.matcher != defaults.matching.matcher),
    ):
        if model and changed:
            raise InputError(
                f"{name} has no effect: a COLMAP model is the start, and no image is "
                "read; leave this option out, or give the folder of the images"
            )


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
