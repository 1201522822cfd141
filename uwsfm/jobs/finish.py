"""What the jobs share that leave a model: their input, and how they end."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uwsfm._base.progress import Progress
from uwsfm.calibration.result import CalibrationResult
from uwsfm.colmap.model import Model
from uwsfm.jobs.compile_kernels import compile_kernels
from uwsfm.jobs.judgement import Judgement
from uwsfm.options.file import OPTIONS, write_options
from uwsfm.options.jobs import ModelOptions
from uwsfm.report.files import write_with_report
from uwsfm.results.files import (
    HOUSING,
    POINTS,
    RIG_GIVEN,
    SPARSE,
    export_colmap,
    export_ply,
)
from uwsfm.results.folder import store_calibration
from uwsfm.results.housing import export_given_rig, export_housing
from uwsfm.results.summary import scale_summary
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.pinhole.perspective import StartArrays
from uwsfm.sfm.start import Start


@dataclass(frozen=True, kw_only=True)
class ModelJob:
    """A job that leaves a model: where, and what it was asked for."""

    rig: Rig
    """As given."""
    out: Path
    options: ModelOptions
    command: str | None
    made_of: dict[str, str | None]
    progress: Progress

    def write(self, model: Model, judged: Judgement) -> None:
        """Write all of a result but its report and its summary."""
        calibration, out = judged.calibration, self.out
        export_colmap(model, out / SPARSE)
        export_housing(model.rig, out / HOUSING, calibration, verdict=judged.word)
        export_given_rig(self.rig, out / RIG_GIVEN)
        write_options(self.options, out / OPTIONS)
        export_points(model, out / POINTS, calibration)
        store_calibration(judged.solved, out)

    def finish(
        self,
        model: Model,
        judged: Judgement,
        summary: dict[str, Any],
        timings: dict[str, float],
    ) -> dict[str, Any]:
        """Look for the cause of what does not fit; write the report and the summary.

        Args:
            model: the result.
            judged: its verdict.
            summary: what the job itself has to say.
            timings: of the summary; receives the search for the cause.

        Returns:
            The whole summary.
        """
        asked = {"command": self.command, "made_of": self.made_of}
        summary = judged.added_to({**summary, **asked}, model.rig)
        clock = time.perf_counter()
        causes = judged.causes(self.rig, model.frame_names, self.progress)
        summary["explanations"] = causes
        timings["looking for the cause"] = time.perf_counter() - clock
        write_with_report(
            *(self.out, model, judged.calibration, summary, self.progress),
            wanted=self.options.report,
        )
        return summary


def compiled(num_threads: int, progress: Progress) -> dict[str, float]:
    """What the first run costs, as a part of a summary's times; empty in all others."""
    seconds = compile_kernels(num_threads, progress)
    return {"compiling kernels": seconds} if seconds else {}


def export_points(model: Model, path: Path, calibration: CalibrationResult) -> None:
    """points.ply, with what is known of its lengths."""
    unit = scale_summary(calibration)["unit"]
    export_ply(model, path, calibration.covariance.points, unit=unit)


def start_scene(rig: Rig, start: Start, arrays: StartArrays) -> Scene:
    placement = start.cam_from_rig
    if rig.cam_from_rig is not None and not rig.refine_cam_from_rig:
        placement = rig.cam_from_rig
    return Scene.from_arrays(
        cameras=start.cameras(rig),
        cam_from_rig=placement,
        rig_from_world=arrays.rig_from_world,
        points=arrays.points,
        camera_idx=arrays.camera_idx,
        frame_idx=arrays.frame_idx,
        point_idx=arrays.point_idx,
        xy=arrays.xy,
    )


def refined_rig(rig: Rig, scene: Scene) -> Rig:
    """A rig with the poses, the ports and the lenses of a refined scene."""
    found = rig.with_geometry(scene.cam_from_rig, scene.ports)
    lenses: list[Any] = [camera.camera for camera in scene.cameras]
    pairs = zip(found.cameras, lenses, strict=True)
    return replace(found, cameras=tuple(replace(c, camera=lens) for c, lens in pairs))
