"""A COLMAP model that others made, and a rig, in; the refractive model out."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.result import CalibrationResult
from uwsfm.colmap.model import Model
from uwsfm.errors import InputError, UwsfmError
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.jobs.checks import checked_rig, require_effect, scene_distance
from uwsfm.jobs.finish import ModelJob, compiled, refined_rig
from uwsfm.jobs.judgement import judged_result
from uwsfm.jobs.model_inputs import (
    check_images,
    found_model,
    image_paths,
    is_result,
    same_or_inside,
)
from uwsfm.jobs.output_folder import (
    locked,
    made_of_files,
    output_folder,
    require_elsewhere,
)
from uwsfm.models.ports.port import PlanePort
from uwsfm.options.jobs import RefineOptions
from uwsfm.report.command import command_line
from uwsfm.results.files import HOUSING, SPARSE
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
from uwsfm.scene import Scene
from uwsfm.sfm.from_colmap.model_database import (
    ImageDatabase,
    read_image_database,
    with_database,
)
from uwsfm.sfm.from_colmap.model_start import ModelStart, Tracks, start_from_model
from uwsfm.sfm.frontend.colors import point_colors
from uwsfm.sfm.options import thread_count
from uwsfm.sfm.refine import Refined, rig_options, without_empty_frames
from uwsfm.trust.refusal import refined_or_explained
from uwsfm.trust.verdict import Verdict, used_of

CENTRAL = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
"""Camera models without distortion: light through a flat port never fits them."""
CLEARLY_WORSE = 1.25
"""The refractive model has less freedom than a pinhole per image, and on raw images a
smaller error all the same (0.3 of the pinhole's in a simulated dive; on undistorted
images 1.65): an error so much larger is a contradiction."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefineResult:
    """What `refine_model` found; the same is on disk."""

    model: Model
    calibration: CalibrationResult
    """Of ``model.scene``, with covariances."""
    summary: dict[str, Any]
    """summary.json"""
    start: ModelStart
    """What the COLMAP model says."""
    model_idx: NDArray[np.int64]
    """(N,) index in ``start.model`` of each observation of ``model.scene``; -1 of those
    that only the database has."""
    verdict: Verdict
    """Whether the result is to be trusted."""


def refine_model(
    source: str | Path,
    rig: Rig | str | Path,
    out: str | Path,
    options: RefineOptions | None = None,
    *,
    progress: Progress = silent,
    **settings: object,
) -> RefineResult:
    """Turn a COLMAP model of underwater images into the refractive one.

    The model may be binary or text, of COLMAP 3 or 4, with or without rigs, with lenses
    calibrated in the water or not. Its poses are the start and its tracks the
    observations; lenses, ports and placement are those of the rig. The scale is that of
    the rig's baseline.

    Args:
        source: Folder of the model, or one that holds it: of ``sparse/0``, ``sparse/1``
            the largest is taken.
        rig: A rig, or the path of a rig file; its ports are the initial values.
        out: Receives ``sparse/`` (COLMAP), ``housing.yaml``, ``points.ply``,
            ``calibration.npz``, ``options.yaml`` and ``summary.json``, each replaced as
            a whole; `uwsfm.open_result` reads it.
        options: How; None: the defaults.
        progress: Called with each long step.
        **settings: Options by name, in place of those of ``options``; and fields of
            `CalibrateOptions`.

    Raises:
        InputError: the model, the rig, an option or the output folder is not usable, or
            the rig contradicts the model; the message says what to change.
        UwsfmError: too little of the model agrees with the refractive one.
    """
    options = (options or RefineOptions()).with_settings(settings)
    command = command_line("refine", (source, rig), out, options)
    asked = {"source": source, "rig": rig, "out": out, **options.values()}
    rig_source, rig = rig, checked_rig(rig)
    require_effect({**rig_options(rig), **options.adjustment.as_fields()})
    made_of = made_of_files(rig_source, source)
    require_elsewhere(out, source)
    source, out = Path(source), output_folder(out, options.images, made_of)
    clock = time.perf_counter()
    start, matches, lengths = _inputs(source, rig, out, options)
    timings = {"reading and checking the model": time.perf_counter() - clock}
    with locked(out), job_log(out, command, asked, progress) as log:
        job = _Job(
            rig=rig,
            start=start,
            database=matches,
            lengths=lengths,
            options=options,
            out=out,
            command=command,
            made_of=made_of,
            progress=log.progress,
            timings=timings,
        )
        result = job.run()
        log.result(result.summary)
        return result


def _inputs(
    source: Path, rig: Rig, out: Path, options: RefineOptions
) -> tuple[ModelStart, ImageDatabase | None, KnownLengths]:
    """The model, its database and the known lengths, read and checked."""
    known = options.constraints
    distance_m = scene_distance(rig, known.scene_distance_m)
    model = found_model(source)
    if out.exists() and same_or_inside(model.folder, out / SPARSE):
        raise InputError(
            f"{out / SPARSE} holds the model that is to be refined, which the result "
            "would replace: choose another folder"
        )
    start = start_from_model(model, rig, distance_m, options.database)
    if options.images is not None:
        check_images(options.images, rig, start)
    matches = None
    if options.database is not None:
        matches = read_image_database(options.database, start.model, rig)
    lengths = KnownLengths.read(known.lengths, known.positions, known.lever_arm)
    names = start.model.frame_names if matches is None else matches.frame_names
    lengths.check_names(rig, names)
    return start, matches, lengths


@dataclass(frozen=True, kw_only=True)
class _Job(ModelJob):
    """One refinement, its input and how it is to be done."""

    start: ModelStart
    database: ImageDatabase | None
    lengths: KnownLengths
    options: RefineOptions
    timings: dict[str, float]

    def run(self) -> RefineResult:
        self.timings.update(compiled(thread_count(-1), self.progress))
        clock = time.perf_counter()
        tracks = self.start.tracks
        refined = self._refined(tracks, None)
        self._require_raw(refined)
        if self.database is not None:
            known, before = tracks.scene, refined.start_rms_px
            tracks = with_database(
                self.database, refined, tracks.frame_names, self.progress
            )
            refined = self._refined(tracks, known)
            refined = replace(refined, start_rms_px=before)  # of the model, not of this
        self.timings["refractive adjustment"] = time.perf_counter() - clock
        clock = time.perf_counter()
        model_idx = tracks.model_idx[refined.kept]
        model, refined = self._model(refined, tracks)
        judging = time.perf_counter()
        used = used_of(refined, len(tracks.frame_names))
        judged = judged_result(self.rig, refined.calibration, used, self.progress)
        self.timings["judging the fit"] = time.perf_counter() - judging
        clock, calibration = clock + self.timings["judging the fit"], judged.calibration
        self.write(model, judged)
        self.timings["colours and export"] = time.perf_counter() - clock
        refined = replace(refined, calibration=calibration)
        summary = self._summary(model, refined, model_idx, tracks.frame_names)
        summary = self.finish(model, judged, summary, self.timings)
        return RefineResult(
            model=model,
            calibration=calibration,
            summary=summary,
            start=self.start,
            model_idx=model_idx,
            verdict=judged.verdict,
        )

    def _refined(self, tracks: Tracks, known: Scene | None) -> Refined:
        scene, lengths = self.lengths.placed(self.rig, tracks.frame_names, tracks.scene)
        return refined_or_explained(
            scene,
            self.rig,
            tracks.frame_names,
            self.progress,
            known=known,
            lengths=lengths,
            **self.options.adjustment.as_fields(),
        )

    def _require_raw(self, refined: Refined) -> None:
        """Refuse pixels that only a pinhole fits: those of undistorted images."""
        found = self.start.model
        kept = self.start.tracks.model_idx[refined.kept]
        own = float(np.nanmean(found.own_error_px[kept]))
        error = errors_summary(refined.calibration)["reprojection_mean_px"]
        if found.lens_models <= CENTRAL and error > CLEARLY_WORSE * own:
            raise InputError(
                f"{found.folder}: pinholes without distortion fit its keypoints to "
                f"{own:.2f} px, lenses behind ports to {error:.2f} px only: probably "
                "its images were undistorted; give a model of the raw images"
            )
        for camera, port in zip(self.rig.cameras, refined.scene.ports, strict=True):
            if isinstance(port, PlanePort) and port.distance > port.max_distance_m:
                raise UwsfmError(
                    f"{found.folder}: the port of camera {camera.name!r} would be "
                    f"{port.distance:.2f} m away from the lens: are the images of the "
                    "model the raw ones, and is the lens that of the air?"
                )

    def _model(self, refined: Refined, tracks: Tracks) -> tuple[Model, Refined]:
        """The result and its calibration, without frames that nothing is left of."""
        kept, all_frames = refined.kept, refined.scene.frame_idx
        refined, frames = without_empty_frames(refined)
        names = tuple(tracks.frame_names[f] for f in frames)
        seen = set(zip(refined.scene.camera_idx, all_frames, strict=True))
        none = np.empty((0, 2))
        return Model(
            rig=refined_rig(self.rig, refined.scene),
            scene=refined.scene,
            frame_names=names,
            keypoints=tuple(
                tuple(of_camera[f] if (c, f) in seen else none for f in frames)
                for c, of_camera in enumerate(tracks.keypoints)
            ),
            keypoint_idx=tracks.keypoint_idx[kept],
            colors=self._colors(refined.scene, names, tracks.model_idx[kept]),
        ), refined

    def _colors(
        self, scene: Scene, names: Sequence[str], model_idx: NDArray[np.int64]
    ) -> NDArray[np.uint8]:
        """RGB (P, 3) from the images, or else from the model."""
        if self.options.images is not None:
            paths = image_paths(self.options.images, self.rig, names)
            return point_colors(scene, paths, self.progress)
        found = self.start.model
        colors = np.zeros((scene.num_points, 3), dtype=np.uint8)
        there = model_idx >= 0
        points = found.point_idx[model_idx[there]]
        colors[scene.point_idx[there]] = found.colors[points]
        return colors

    def _summary(
        self,
        model: Model,
        refined: Refined,
        model_idx: NDArray[np.int64],
        names: Sequence[str],
    ) -> dict[str, Any]:
        found = errors_summary(refined.calibration)
        after = found.pop("reprojection_rms_px")
        unregistered = [name for name in names if name not in set(model.frame_names)]
        notes = list(self.start.warnings)
        if self.database is not None:
            notes += self.database.warnings
        if unregistered:
            notes.append(
                f"{len(unregistered)} of {len(names)} frames are not in the result: "
                f"{', '.join(unregistered[:10])}"
                f"{' ...' if len(unregistered) > 10 else ''}"
            )
        both = model_idx >= 0
        own = _mean(self.start.model.own_error_px[model_idx[both]])
        source, theirs = self.start.model.folder, dict(self.start.summary)
        if is_result(source):
            own = theirs["median_error_px"] = None
            notes.append(
                f"{source} is a result of uwsfm, refractive already: its lenses lack "
                f"the refraction that its {HOUSING} holds, and its error as a COLMAP "
                "model has no meaning"
            )
        error = model.errors_px()[both]
        return {
            "num_frames": len(names),
            "num_images": len(names) * len(model.rig.cameras),
            "unregistered_frames": unregistered,
            **found,
            "reprojection_rms_px": {"before": refined.start_rms_px, "after": after},
            "cameras": housing_summary(model.rig, refined.calibration),
            **outside_summary(refined.calibration, model.frame_names),
            "refined": refined_summary(model.rig, refined.calibration),
            "baseline_m": model.rig.baseline_m,
            "baseline_stddev_m": model.rig.baseline_stddev_m,
            "colmap_model": {
                **theirs,
                "num_common_observations": int(np.count_nonzero(both)),
                "mean_error_of_common_px": own,
                "refractive_error_of_common_px": _mean(error),
            },
            "warnings": notes,
            "images": recorded_images(self.options.images),
            "timings_s": self.timings,
            "versions": versions(),
        }


def _mean(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
