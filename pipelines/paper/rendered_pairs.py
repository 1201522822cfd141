"""Figure 6, right, on images: the same with features found, matched and mismatched."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from monte_carlo import normal_errors_deg, run_all
from single_pair import DISTANCES_MM, ERRORS, HELD, start
from tables import Row, column, select

import uwsfm
from uwsfm.console import ProgressBars
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import IDENTITY
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.features import extract_features
from uwsfm.sfm.images import find_frames
from uwsfm.sfm.matching import match_features
from uwsfm.sfm.options import FeatureOptions, MatchOptions
from uwsfm.sfm.same_frame import PairMatches, read_same_frame_matches
from uwsfm.simulate.rigs import known_cam_from_rig, nominal_rig, paper_rig
from uwsfm.simulate.sequence import SequenceSpec, render_sequence
from uwsfm.simulate.trajectories import rich_motion

NUM_PAIRS = 8


def spec() -> SequenceSpec:
    """Pairs of the paper's rig over the rendered sea floor, 0.9 to 1.7 m away."""
    return SequenceSpec(
        rig=paper_rig(), rig_from_world=rich_motion(NUM_PAIRS, altitude=1.2, extent=0.4)
    )


def table(
    work: Path, processes: int, distances_mm: Sequence[float] = DISTANCES_MM
) -> list[Row]:
    """Per assumed distance and error function: single pairs, and all of them.

    Args:
        work: Keeps the images and their features for the next time.
        processes: That share the solves.
        distances_mm: Of both ports, assumed.
    """
    truth = spec().rig
    images = work / "rendered_pairs"
    with ProgressBars() as progress:
        if not images.exists():
            render_sequence(spec(), images, progress)
        # The front end sees what a user would write: straight ports at 10 mm.
        matches = _matches(nominal_rig(truth), images / "images", work, progress)
    tasks = [
        Task(pairs=name, scene=scene, error=error, distance_mm=distance)
        for name, scene in _scenes(matches, truth).items()
        for error, distance in product(ERRORS, distances_mm)
    ]
    return _summaries(sum(run_all(solve, tasks, processes, "fig. 6, images"), []))


@dataclass(frozen=True, kw_only=True)
class Task:
    """Matches of one pair, or of all, and how to solve them."""

    pairs: str
    scene: Scene
    """With the true ports."""
    error: str
    distance_mm: float


def solve(task: Task) -> list[Row]:
    """The errors of the normals; wrong matches are left to the robust loss."""
    begin = start(task.scene, task.distance_mm)
    usable = finite_rows(begin.points)[begin.point_idx]
    begin, _ = begin.select(usable)
    result = uwsfm.calibrate(begin, error=task.error, **HELD)
    return [
        {
            "pairs": task.pairs,
            "error_function": task.error,
            "assumed_distance_mm": task.distance_mm,
            "angle_deg": angle,
            "matches": task.scene.num_points,
            "outliers_percent": 100.0 * float(np.mean(~result.inliers)),
            "rms_px": result.summary.rms_px,
        }
        for angle in normal_errors_deg(result.scene, task.scene)
    ]


def _summaries(found: list[Row]) -> list[Row]:
    """Both cameras and all single pairs together; the whole set as one more run."""
    single = [row | {"pairs": "one pair"} for row in found if row["pairs"] != "all"]
    whole = [row | {"pairs": "all pairs"} for row in found if row["pairs"] == "all"]
    keys = ("pairs", "error_function", "assumed_distance_mm")
    rows = []
    for key in dict.fromkeys(tuple(row[k] for k in keys) for row in single + whole):
        mine = select(single + whole, **dict(zip(keys, key, strict=True)))
        angles = column(mine, "angle_deg")
        rows.append(
            {
                **dict(zip(keys, key, strict=True)),
                "mean_deg": float(np.mean(angles)),
                "sd_deg": float(np.std(angles)),
                "max_deg": max(angles),
                "matches": float(np.mean(column(mine, "matches"))),
                "outliers_percent": float(np.mean(column(mine, "outliers_percent"))),
                "rms_px": float(np.mean(column(mine, "rms_px"))),
                "normals": len(mine),
            }
        )
    return rows


def _scenes(matches: PairMatches, rig: Rig) -> dict[str, Scene]:
    scenes = {"all": scene_of(matches, rig)}
    for frame in np.unique(matches.frame_idx).tolist():
        scenes[str(frame + 1)] = scene_of(matches, rig, frame)
    return scenes


def _matches(rig: Rig, images: Path, work: Path, progress) -> PairMatches:
    """Matches between the two cameras of each frame, by the front end."""
    frames = find_frames(images, rig)
    database = work / "rendered_pairs.db"
    extract_features(frames, rig, database, FeatureOptions(), progress=progress)
    match_features(frames, database, MatchOptions(), progress=progress)
    (matches,) = read_same_frame_matches(database, frames, rig)
    return matches


def scene_of(matches: PairMatches, rig: Rig, frame: int | None = None) -> Scene:
    """Matches of one frame, or of all of them, as if seen in one.

    A known rig is all that relates two observations of a point that no other frame
    sees, so the frames of a set need no poses.
    """
    chosen = (
        np.ones(len(matches), bool) if frame is None else matches.frame_idx == frame
    )
    count = int(chosen.sum())
    point = np.repeat(np.arange(count), 2)
    return Scene.from_arrays(
        cameras=rig.refractive_cameras(),
        cam_from_rig=known_cam_from_rig(rig),
        rig_from_world=IDENTITY[None],
        points=np.full((count, 3), np.nan),
        camera_idx=np.tile([matches.camera_a, matches.camera_b], count),
        frame_idx=np.zeros(2 * count, dtype=np.int64),
        point_idx=point,
        xy=np.stack([matches.xy_a[chosen], matches.xy_b[chosen]], axis=1).reshape(
            -1, 2
        ),
    )
