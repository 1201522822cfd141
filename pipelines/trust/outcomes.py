"""What becomes of an input: refused, or a result with a verdict; against the truth."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from assessment import assessed, with_deviations
from dives import Dive, ImageKey
from scipy.spatial.distance import pdist

from uwsfm.calibration.propagation import Propagation
from uwsfm.calibration.result import CalibrationResult
from uwsfm.errors import ExplainedInputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.jobs.finish import refined_rig, start_scene
from uwsfm.models.ports.port import DomePort, FlatPort, NoPort, Port
from uwsfm.results.summary import housing_summary, scale_summary
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.refine import Refined, refine_scene
from uwsfm.sfm.rig_checks.fixed_rig import fix_rig
from uwsfm.sfm.scene_points import retriangulated
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import known_cam_from_rig
from uwsfm.trust.refusal import refined_or_explained

OPTIONS = StartOptions(mapper="refractive")
"""As `uwsfm.reconstruct` has them."""
REFUSED, FITS = "refused", "fits"
LIMIT = 3.0
"""Printed standard deviations; an error beyond them must not come with "fits"."""
WRONG_TRACKS = 0.05
"""Observations of another point, as matches that were not found out."""
NUM_LENGTHS = 5
"""Long distances between points that are compared."""
AT_READING = {
    "length_unit": r"did you mean|are in metres",
    "resolution": r"puts the principal point outside",
    "water_index": r"refractive_index",
}
"""Causes that the checks of a rig file name."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One input, run."""

    verdict: str
    """"refused", or what the verdict is."""
    words: str
    """Of the refusal, or the first reason."""
    causes: tuple[str, ...] = ()
    """Codes of the causes that are named, the likeliest first."""
    errors: dict[str, float] = field(default_factory=dict)
    """Each error against the truth in its standard deviations "in all"."""
    z_scores: dict[str, float] = field(default_factory=dict)
    """Signed errors in standard deviations from the images alone."""
    num_frames: int = 0
    num_observations: int = 0
    rms_px: float | None = None
    seconds: float = 0.0

    @property
    def worst(self) -> float:
        return max(self.errors.values(), default=0.0)

    @property
    def confidently_wrong(self) -> bool:
        return self.verdict == FITS and self.worst > LIMIT

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def outcome_of(
    dive: Dive,
    *,
    diagnosed: bool = True,
    mapped: bool = False,
    wrong: float = WRONG_TRACKS,
) -> Outcome:
    """Run the steps of ``uwsfm reconstruct`` from the matches on, and judge them.

    Args:
        dive: What is given: its rig goes through a rig file, with all checks of it.
        diagnosed: Look for the cause where the verdict is not that it fits.
        mapped: Verify the matches and map them, as `uwsfm.reconstruct` does. False: the
            rig is checked against the matches, then adjusted from the true poses with
            the true tracks, some of them wrong: the same end in a tenth of the time.
        wrong: Share of the observations that are of another point; if not mapped.
    """
    clock = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        try:
            dump_rig(dive.rig, work / "rig.yaml")
            rig = load_rig(work / "rig.yaml")
            dive.write_database(work / "database.db")
            start = (
                mapped_scene(rig, dive, work)
                if mapped
                else simulated_scene(rig, dive, work, wrong)
            )
            names = [dive.names[f] for f in start.frames]
            refined = with_deviations(refined_by(start.scene, rig, names, diagnosed))
        except UwsfmError as error:
            text = str(error).replace(str(work), "OUT")
            return Outcome(
                verdict=REFUSED,
                words=text,
                causes=causes_of(error),
                seconds=time.perf_counter() - clock,
            )
        found = assessed(rig, refined, dive.num_frames, names, diagnosed=diagnosed)
    true_points = points_of_truth(dive, start, refined)
    errors, z_scores = errors_of(rig, refined, dive.true_rig, true_points)
    return Outcome(
        verdict=found.verdict,
        words=found.words,
        causes=found.causes,
        errors=errors,
        z_scores=z_scores,
        num_frames=refined.scene.num_frames,
        num_observations=refined.scene.num_observations,
        rms_px=refined.calibration.summary.rms_px,
        seconds=time.perf_counter() - clock,
    )


def refined_by(
    scene: Scene, rig: Rig, names: Sequence[str], diagnosed: bool
) -> Refined:
    """The last adjustment, as the jobs have it, or without a cause where it fails."""
    if diagnosed:
        return refined_or_explained(scene, rig, names)
    return refine_scene(scene, rig)


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """What the last adjustment begins with."""

    scene: Scene
    frames: list[int]
    """Which frame of the dive each frame of the scene is."""
    keypoint_idx: IndexArray
    """(N,) of each observation, in its image."""


def mapped_scene(rig: Rig, dive: Dive, work: Path) -> Begun:
    """Verified, and mapped by water rays."""
    frames = dive.frames(work)
    start = start_from_matches(rig, frames, Steps(work), "", OPTIONS)
    arrays = start.arrays()
    return Begun(
        scene=start_scene(rig, start, arrays),
        frames=[dive.names.index(name) for name in arrays.frame_names],
        keypoint_idx=arrays.keypoint_idx,
    )


def simulated_scene(rig: Rig, dive: Dive, work: Path, wrong: float) -> Begun:
    """The rig checked against the matches; then true poses, and tracks."""
    given = known_cam_from_rig(rig)
    fixed = fix_rig(rig, given, dive.frames(work), work / "database.db", 1.0)
    placement = fixed.rotation.cam_from_rig if rig.refine_cam_from_rig else given
    keypoints = [
        (c, f, k, point)
        for (c, f), points in dive.points.items()
        for k, point in enumerate(points.tolist())
    ]
    table = np.array(keypoints, dtype=np.int64)
    rng = np.random.default_rng(0)
    moved = np.flatnonzero(rng.random(len(table)) < wrong)
    table[moved, 3] = np.roll(table[moved, 3], 1)
    # One point once in an image: of two, the second is left out.
    _, first = np.unique(table[:, [0, 1, 3]], axis=0, return_index=True)
    table = table[np.sort(first)]
    _, point_idx = np.unique(table[:, 3], return_inverse=True)
    poses = np.stack(
        [taken_pose(dive, dive.taken[0, f]) for f in range(dive.num_frames)]
    )
    poses = rigid3.compose(poses, rigid3.inverse(poses[:1]))
    if rig.baseline_m is not None and dive.true_rig.baseline_m is not None:
        poses[:, 4:] *= rig.baseline_m / dive.true_rig.baseline_m
    scene = Scene.from_arrays(
        cameras=rig.refractive_cameras(),
        cam_from_rig=placement,
        rig_from_world=poses,
        points=np.zeros((point_idx.max() + 1, 3)),
        camera_idx=table[:, 0],
        frame_idx=table[:, 1],
        point_idx=point_idx,
        xy=np.array([dive.keypoints[c, f][k] for c, f, k, _ in table.tolist()]),
    )
    return Begun(
        scene=scene, frames=list(range(dive.num_frames)), keypoint_idx=table[:, 2]
    )


def taken_pose(dive: Dive, image: ImageKey) -> Array:
    """Where the camera that took an image really was (7,)."""
    camera, frame = image
    return rigid3.compose(
        known_cam_from_rig(dive.true_rig)[camera], dive.true_poses[frame]
    )


def causes_of(error: UwsfmError) -> tuple[str, ...]:
    """Codes of the causes that a refusal names, the likeliest first."""
    if isinstance(error, ExplainedInputError):
        return error.codes
    patterns = AT_READING.items()
    return tuple(code for code, pattern in patterns if re.search(pattern, str(error)))


def errors_of(
    rig: Rig, refined: Refined, true_rig: Rig, true_points: Array
) -> tuple[dict[str, float], dict[str, float]]:
    """Errors against the truth: sizes in deviations "in all", and signed z-scores in
    those from the images.

    Args:
        rig: That was given.
        refined: The result.
        true_rig: The truth.
        true_points: (P, 3), see `points_of_truth`.
    """
    calibration, scene = refined.calibration, refined.scene
    errors: dict[str, float] = {}
    z_scores: dict[str, float] = {}
    entries = housing_summary(refined_rig(rig, scene), calibration)
    summary = scale_summary(calibration)
    metric = summary["relative_stddev"] is not None
    for entry, port, item in zip(entries, scene.ports, true_rig.cameras, strict=True):
        for miss in _port_misses(entry, port, item.port):
            if miss.is_length and not metric:  # a length in an arbitrary unit
                continue
            miss.enter(errors, z_scores)
    if metric and calibration.covariance.determined:
        rows = well_seen(scene, true_points)
        Miss(
            name="scale",
            error=relative_size(scene.points[rows], true_points[rows]) - 1.0,
            stddev=summary["relative_stddev"],
            in_all=summary["relative_stddev_in_all"],
        ).enter(errors, z_scores)
        errors["length"] = worst_length(calibration, true_points, rows)
    return errors, z_scores


@dataclass(frozen=True, kw_only=True)
class Miss:
    """One estimate against the truth."""

    name: str
    error: float
    stddev: float | None
    """From the images."""
    in_all: float | None
    is_length: bool = False
    signed: bool = True

    def enter(self, errors: dict[str, float], z_scores: dict[str, float]) -> None:
        if self.stddev is not None and self.signed:
            z_scores[self.name] = _over(self.error, self.stddev)
        if self.in_all is not None:
            errors[self.name] = abs(_over(self.error, self.in_all))


def _port_misses(entry: dict[str, Any], port: Port, true: Port) -> Iterator[Miss]:
    name = entry["name"]
    if type(port) is not type(true):
        if not isinstance(port, NoPort):  # no number of it means anything
            yield Miss(name=f"{name} port", error=1.0, stddev=0.0, in_all=0.0)
        return
    if isinstance(port, FlatPort) and isinstance(true, FlatPort):
        yield Miss(
            name=f"{name} distance",
            error=port.distance - true.distance,
            stddev=entry["distance_stddev_m"],
            in_all=entry["distance_stddev_in_all_m"],
            is_length=True,
        )
        stddev, in_all = (
            entry[key] for key in ("normal_stddev_deg", "normal_stddev_in_all_deg")
        )
        yield Miss(
            name=f"{name} tilt",
            error=float(np.degrees(angle_between(port.normal, true.normal))),
            stddev=stddev,
            in_all=in_all,
            signed=False,
        )
        if stddev is not None:
            for i, axis in enumerate("xy"):  # each has half of the mean square angle
                yield Miss(
                    name=f"{name} tilt {axis}",
                    error=float(np.degrees(port.normal[i] - true.normal[i])),
                    stddev=stddev / np.sqrt(2.0),
                    in_all=None,
                )
    if isinstance(port, DomePort) and isinstance(true, DomePort):
        for i, axis in enumerate("xyz"):
            yield Miss(
                name=f"{name} centre {axis}",
                error=port.center[i] - true.center[i],
                stddev=entry["center_stddev_m"][i],
                in_all=entry["center_stddev_in_all_m"][i],
                is_length=True,
            )


def _over(miss: float, stddev: float) -> float:
    return float(miss / stddev) if stddev > 0.0 else float(np.sign(miss) * np.inf)


def points_of_truth(dive: Dive, start: Begun, refined: Refined) -> Array:
    """Where the points of a result really are (P, 3).

    Intersected with the true rig, at the true poses, from the observations that the
    result has, where they were in the images as they were taken.
    """
    scene, keypoint_idx = refined.scene, start.keypoint_idx[refined.kept]
    camera_idx = np.empty_like(scene.camera_idx)
    frame_idx, xy = np.empty_like(scene.frame_idx), np.empty_like(scene.xy)
    for c in range(len(scene.cameras)):
        for f, original in enumerate(start.frames):
            rows = (scene.camera_idx == c) & (scene.frame_idx == f)
            camera_idx[rows], frame_idx[rows] = dive.taken[c, original]
            xy[rows] = dive.seen[c, original][keypoint_idx[rows]]
    true = Scene.from_arrays(
        cameras=dive.true_rig.refractive_cameras(),
        cam_from_rig=known_cam_from_rig(dive.true_rig),
        rig_from_world=dive.true_poses,
        points=scene.points,
        camera_idx=camera_idx,
        frame_idx=frame_idx,
        point_idx=scene.point_idx,
        xy=xy,
    )
    return retriangulated(true, np.ones(len(xy), dtype=bool)).points


def well_seen(scene: Scene, true_points: Array) -> IndexArray:
    """The points with the most observations: wrong matches are rare among them."""
    counts = np.bincount(scene.point_idx, minlength=scene.num_points)
    good = finite_rows(scene.points) & finite_rows(true_points)
    enough = np.percentile(counts[good], 60.0)
    return np.flatnonzero(good & (counts >= enough))


def relative_size(points: Array, true_points: Array) -> float:
    """The factor that fits all distances between points (n, 3) best."""
    rows = np.linspace(0, len(points) - 1, min(len(points), 300)).astype(np.int64)
    estimate, true = pdist(points[rows]), pdist(true_points[rows])
    # By medians: a wrong match is no matter of scale.
    long = true >= np.median(true)
    return float(np.median(estimate[long] / true[long]))


def worst_length(
    calibration: CalibrationResult, true_points: Array, rows: IndexArray
) -> float:
    """Greatest error of some long distances between points, in deviations "in all".

    Those are what ``uwsfm measure`` prints: the larger of two from the images, and the
    errors of what was given.
    """
    points, propagation = calibration.scene.points, Propagation(calibration)
    rng = np.random.default_rng(0)
    pairs = rng.choice(rows, size=(200, 2))
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    worst = 0.0
    for a, b in pairs[np.argsort(-apart)[:NUM_LENGTHS]]:
        step = points[a] - points[b]
        length = float(np.linalg.norm(step))
        places = propagation.of_points(np.array([a, b]))
        slopes = np.stack([step, -step])[None] / length
        own = max(
            float(cov(places, slopes)[0, 0])
            for cov in (propagation.covariance, propagation.clustered_covariance)
        )
        given = float(propagation.given_covariance(places, slopes)[0, 0])
        stddev = np.sqrt(own + max(given, 0.0))
        miss = length - float(np.linalg.norm(true_points[a] - true_points[b]))
        worst = max(worst, _over(abs(miss), stddev))
    return worst
