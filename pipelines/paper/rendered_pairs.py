"""Figure 6, right, on images: the same with features found, matched and mismatched."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from monte_carlo import normal_errors_deg, run_all, straight_ports
from single_pair import DISTANCES_MM, ERRORS, HELD
from tables import Row, column, select

import uwsfm
from uwsfm._base.progress import Progress
from uwsfm._base.tasks import Workers
from uwsfm.cli.console import ProgressBars
from uwsfm.geometry.rays import finite_rows
from uwsfm.scene import Scene
from uwsfm.sfm.frontend.features import extract_features
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.frontend.matching import match_features
from uwsfm.sfm.options import FeatureOptions, MatchOptions
from uwsfm.sfm.rig_checks.stereo_scene import same_frame_scene
from uwsfm.simulate.rigs import nominal_rig, paper_rig
from uwsfm.simulate.sequence import SequenceSpec, render_sequence
from uwsfm.simulate.trajectories import rich_motion

NUM_PAIRS = 8


def spec() -> SequenceSpec:
    """Pairs of the paper's rig over the rendered sea floor, 0.9 to 1.7 m away."""
    return SequenceSpec(
        rig=paper_rig(), rig_from_world=rich_motion(NUM_PAIRS, altitude=1.2, extent=0.4)
    )


def table(
    work: Path, workers: Workers, distances_mm: Sequence[float] = DISTANCES_MM
) -> list[Row]:
    """Per assumed distance and error function: single pairs, and all of them.

    Args:
        work: Keeps the images and their features for the next time.
        workers: Who share the solves.
        distances_mm: Of both ports, assumed.
    """
    images = work / "rendered_pairs"
    with ProgressBars() as progress:
        if not images.exists():
            render_sequence(spec(), images, progress)
        scenes = _scenes(images / "images", work / "rendered_pairs.db", progress)
    tasks = [
        Task(pairs=name, scene=scene, error=error, distance_mm=distance)
        for name, scene in scenes.items()
        for error, distance in product(ERRORS, distances_mm)
    ]
    return _summaries(sum(run_all(solve, tasks, workers, "fig. 6, images"), []))


@dataclass(frozen=True, kw_only=True)
class Task:
    """Matches of one pair, or of all, and how to solve them."""

    pairs: str
    scene: Scene
    """With the ports that a user would write."""
    error: str
    distance_mm: float


def solve(task: Task) -> list[Row]:
    """The errors of the normals; what matches remain wrong is left to the loss."""
    begin = straight_ports(task.scene, task.distance_mm)
    placed = finite_rows(begin.points)[begin.point_idx]
    begin, _ = begin.select(placed)
    result = uwsfm.calibrate(begin, error=task.error, **HELD)
    truth = [item.port for item in spec().rig.cameras]
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
        for angle in normal_errors_deg(result.scene, truth)
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


def _scenes(images: Path, database: Path, progress: Progress) -> dict[str, Scene]:
    """What the front end finds in each pair, and in all of them, the paper's way.

    It is told what a user would write: the lenses, the rig, straight ports at 10 mm.
    """
    rig = nominal_rig(spec().rig)
    frames = find_frames(images, rig)
    matching = MatchOptions(matcher="paper")
    extract_features(frames, rig, database, FeatureOptions(), progress=progress)
    match_features(frames, database, matching, progress=progress)
    sets = {name: replace(frames, names=(name,)) for name in frames.names}
    sets["all"] = frames
    return {name: same_frame_scene(rig, part, database) for name, part in sets.items()}
