"""A COLMAP model that others made, and a rig, in; the refractive model out."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._progress import Progress, silent
from uwsfm.calibration.problem import CalibrateOptions, CalibrationResult
from uwsfm.colmap import Model
from uwsfm.errors import InputError, UwsfmError
from uwsfm.export.files import (
    HOUSING,
    POINTS,
    SPARSE,
    SUMMARY,
    export_colmap,
    export_ply,
)
from uwsfm.export.housing import export_housing
from uwsfm.export.summary import (
    errors_summary,
    housing_summary,
    refined_summary,
    versions,
    write_json,
)
from uwsfm.housing_pipeline import refined_rig, require_effect
from uwsfm.models.port import FlatPort
from uwsfm.pipeline import checked_rig, housing_warnings, locked, output_folder
from uwsfm.rig import Rig
from uwsfm.sfm.colmap_model import FoundModel, find_model
from uwsfm.sfm.colors import point_colors
from uwsfm.sfm.images import image_fault
from uwsfm.sfm.model_start import ModelStart, start_from_model
from uwsfm.sfm.refine import Refined, refine_scene, rig_options

CENTRAL = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
"""Camera models without distortion: light through a flat port never fits them."""
CLEARLY_WORSE = 1.25
"""The refractive model has less freedom than a pinhole per image, and on raw images a
smaller error all the same (0.3 of the pinhole's in a simulated dive; on undistorted
images 1.65): an error so much larger is a contradiction."""
MAX_DISTANCE_M = 0.5
"""Of a port from its lens; what a rig file takes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefineResult:
    """What `refine_model` found; the same is on disk."""

    model: Model
    calibration: CalibrationResult
    """Of ``model.scene``, with covariances."""
    summary: dict[str, Any]
    """summary.json"""
    start: ModelStart
    """What the COLMAP model says; ``kept`` rows of its scene are in ``model``."""
    kept: NDArray[np.int64]
    """(N,) index in ``start.model`` of each observation of ``model.scene``."""


def refine_model(
    source: str | Path,
    rig: Rig | str | Path,
    out: str | Path,
    *,
    images: str | Path | None = None,
    progress: Progress = silent,
    **options: Any,
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
        out: Receives ``sparse/`` (COLMAP), ``housing.yaml``, ``points.ply`` and
            ``summary.json``, each replaced as a whole.
        images: Folder that holds one folder of images per camera, to colour the points;
            without it they keep the colours of the model.
        progress: Called with each long step.
        **options: Fields of `CalibrateOptions`.

    Raises:
        InputError: the model, the rig, an option or the output folder is not usable, or
            the rig contradicts the model; the message says what to change.
        UwsfmError: too little of the model agrees with the refractive one.
    """
    rig = checked_rig(rig)
    settings = CalibrateOptions.parsed({**rig_options(rig), **options})
    require_effect(settings)
    source, out = Path(source), output_folder(out)
    found = _found(source)
    if out.exists() and _same_or_inside(found.folder, out / SPARSE):
        raise InputError(
            f"{out / SPARSE} holds the model that is to be refined, which the result "
            "would replace: choose another folder"
        )
    clock = time.perf_counter()
    start = start_from_model(found, rig)
    paths = None if images is None else _image_paths(Path(images), rig, start)
    timings = {"reading and checking the model": time.perf_counter() - clock}
    with locked(out):
        job = _Job(rig, start, paths, out, progress, timings)
        return job.run(options)


def _found(source: Path) -> FoundModel:
    if not source.is_dir():
        what = "is not a folder" if source.exists() else "does not exist"
        raise InputError(f"COLMAP model {source} {what}")
    found = find_model(source)
    if found is None:
        raise InputError(
            f"{source} holds no COLMAP model: neither cameras.bin nor cameras.txt is "
            "in it, in its folder sparse or in a numbered folder of these"
        )
    return found


def _same_or_inside(folder: Path, parent: Path) -> bool:
    return folder.resolve().is_relative_to(parent.resolve())


def _image_paths(images: Path, rig: Rig, start: ModelStart) -> list[list[Path]]:
    """[camera][frame]; those in the model are there, the first of each camera fits."""
    names, registered = start.model.frame_names, start.model.registered
    paths = [[images / camera.images / n for n in names] for camera in rig.cameras]
    for c, item in enumerate(rig.cameras):
        there = [paths[c][f] for f in np.flatnonzero(registered[c])]
        for path in there:
            if not path.is_file():
                raise InputError(f"image {path} of the model does not exist")
        fault = image_fault(there[0], (item.camera.width, item.camera.height))
        if fault is not None:
            raise InputError(fault)
    return paths


@dataclass(frozen=True)
class _Job:
    """One refinement, its input and how it is to be done."""

    rig: Rig
    start: ModelStart
    paths: list[list[Path]] | None
    out: Path
    progress: Progress
    timings: dict[str, float]

    def run(self, options: dict[str, Any]) -> RefineResult:
        clock = time.perf_counter()
        refined = refine_scene(self.start.scene, self.rig, self.progress, **options)
        kept = self.start.kept[refined.kept]
        self._require_raw(refined, kept)
        self.timings["refractive adjustment"] = time.perf_counter() - clock
        clock = time.perf_counter()
        refined, frames = _without_empty_frames(refined)
        model = self._model(refined, frames, kept)
        export_colmap(model, self.out / SPARSE)
        export_housing(model.rig, self.out / HOUSING, refined.calibration)
        export_ply(model, self.out / POINTS, refined.calibration.covariance.points)
        self.timings["colours and export"] = time.perf_counter() - clock
        summary = self._summary(model, refined, kept)
        write_json(summary, self.out / SUMMARY)
        return RefineResult(
            model=model,
            calibration=refined.calibration,
            summary=summary,
            start=self.start,
            kept=kept,
        )

    def _require_raw(self, refined: Refined, kept: NDArray[np.int64]) -> None:
        """Refuse pixels that only a pinhole fits: those of undistorted images."""
        found = self.start.model
        own = float(np.nanmean(found.own_error_px[kept]))
        error = errors_summary(refined.calibration)["reprojection_mean_px"]
        if found.lens_models <= CENTRAL and error > CLEARLY_WORSE * own:
            raise InputError(
                f"{found.folder}: pinholes without distortion fit its keypoints to "
                f"{own:.2f} px, lenses behind ports to {error:.2f} px only: probably "
                "its images were undistorted; give a model of the raw images"
            )
        for camera, port in zip(self.rig.cameras, refined.scene.ports, strict=True):
            if isinstance(port, FlatPort) and port.distance > MAX_DISTANCE_M:
                raise UwsfmError(
                    f"{found.folder}: the port of camera {camera.name!r} would be "
                    f"{port.distance:.2f} m away from the lens: are the images of the "
                    "model the raw ones, and is the lens that of the air?"
                )

    def _model(
        self, refined: Refined, frames: NDArray[np.int64], kept: NDArray[np.int64]
    ) -> Model:
        found, scene = self.start.model, refined.scene
        if self.paths is None:
            colors = np.zeros((scene.num_points, 3), dtype=np.uint8)
            colors[scene.point_idx] = found.colors[found.point_idx[kept]]
        else:
            paths = [[of_camera[f] for f in frames] for of_camera in self.paths]
            colors = point_colors(scene, paths, self.progress)
        return Model(
            rig=refined_rig(self.rig, scene),
            scene=scene,
            frame_names=tuple(found.frame_names[f] for f in frames),
            keypoints=tuple(
                tuple(of_camera[f] for f in frames) for of_camera in found.keypoints
            ),
            keypoint_idx=found.keypoint_idx[kept],
            colors=colors,
        )

    def _summary(
        self, model: Model, refined: Refined, kept: NDArray[np.int64]
    ) -> dict[str, Any]:
        found = errors_summary(refined.calibration)
        after = found.pop("reprojection_rms_px")
        names = self.start.model.frame_names
        unregistered = [name for name in names if name not in set(model.frame_names)]
        notes = list(self.start.warnings)
        if unregistered:
            notes.append(
                f"{len(unregistered)} of {len(names)} frames of the model are not in "
                f"the result: {', '.join(unregistered[:10])}"
            )
        own = self.start.model.own_error_px[kept]
        return {
            "num_frames": len(names),
            "unregistered_frames": unregistered,
            **found,
            "reprojection_rms_px": {"before": refined.start_rms_px, "after": after},
            "cameras": housing_summary(model.rig, refined.calibration),
            "refined": refined_summary(model.rig, refined.calibration),
            "baseline_m": model.rig.baseline_m,
            "baseline_stddev_m": model.rig.baseline_stddev_m,
            "colmap_model": {
                **self.start.summary,
                "mean_error_of_kept_px": float(np.nanmean(own)),
            },
            "warnings": notes + housing_warnings(model.rig, refined.calibration),
            "timings_s": self.timings,
            "versions": versions(),
        }


def _without_empty_frames(refined: Refined) -> tuple[Refined, NDArray[np.int64]]:
    """Without the frames that no observation is left of, and which frames are left."""
    scene, calibration = refined.scene, refined.calibration
    frames, frame_idx = np.unique(scene.frame_idx, return_inverse=True)
    smaller = replace(
        scene,
        rig_from_world=scene.rig_from_world[frames],
        frame_idx=frame_idx.astype(np.int64),
    )
    covariance = replace(
        calibration.covariance, frames=calibration.covariance.frames[frames]
    )
    calibration = replace(calibration, scene=smaller, covariance=covariance)
    return replace(refined, scene=smaller, calibration=calibration), frames
