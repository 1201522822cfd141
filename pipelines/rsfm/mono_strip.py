"""One camera along a strip: is the noise floor reached, and is the scale known?

    python pipelines/rsfm/mono_strip.py -o OUT

30 images 1 m above the floor, matches with 10 % of wrong ones, ports that are known or
not. From the matches alone (verification, mapping, adjustment), beside adjustments that
start from the truth. Centres are compared after the best similarity, because the images
of one camera hardly tell the scale.
"""

import argparse
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from strips import OVERLAP

import uwsfm
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align
from uwsfm.jobs.finish import start_scene
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.perspective import StartArrays
from uwsfm.sfm.refine import Refined, refine_scene
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate import ObservationOptions, Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.rigs import paper_rig, rough_port
from uwsfm.simulate.trajectories import straight_strip

NUM_FRAMES = 30
ALTITUDE = 1.0
NUM_POINTS = 14_500
NOISE_PX = 0.5
WRONG = 0.1


def rig_of(*, known: bool) -> Rig:
    """One camera of the paper's rig, its port exact and held, or rough and free."""
    camera = paper_rig(distance=0.02, thickness=0.01).cameras[0]
    port = camera.port if known else rough_port(camera.port)
    camera = replace(
        camera, port=port, refine_normal=not known, refine_distance=not known
    )
    return Rig(cameras=(camera,), cam_from_rig=None, baseline_m=None)


def strip(seed: int) -> SimulatedScene:
    spacing = (1.0 - OVERLAP) * 0.66 * ALTITUDE
    return simulate_scene(
        rig_of(known=True),
        straight_strip(NUM_FRAMES, spacing=spacing, altitude=ALTITUDE),
        Relief(stddev=0.08, correlation_length=0.3, seed=seed),
        ObservationOptions(
            num_points=NUM_POINTS, noise_px=NOISE_PX, detection_rate=0.8, seed=seed
        ),
    )


def centers_rms(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """After the best similarity, metres."""
    found, true = rigid3.inverse(poses)[:, 4:], rigid3.inverse(truth)[:, 4:]
    return rms_after_similarity(found, true)


def rms_after_similarity(found: Any, true: Any) -> float:
    moved = align(found, true, np.ones(len(true)), with_scale=True)
    gap = moved.apply(found) - true
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One reconstruction, beside adjustments from the truth. Lengths in metres."""

    num_matches: int
    num_frames: int
    centers_rms: float
    same_rms: float
    """Of the adjustment of the same observations that starts from the truth."""
    scale_stddev: float | None
    """Relative; None: declared unknown."""
    cpu_s: float


HELD = {"refine_normals": False, "refine_distances": False}


def from_matches(simulated: SimulatedScene, *, known: bool, work_dir: Path) -> Outcome:
    """Map and adjust from matches alone."""
    rig = rig_of(known=known)
    frames = frames_of(rig, NUM_FRAMES, work_dir)
    write_features(work_dir / "database.db", simulated.scene, frames, wrong=WRONG)
    with opened(work_dir / "database.db") as database:
        num_matches = database.num_matches()
    options = StartOptions(mapper="refractive", scene_distance_m=ALTITUDE)
    clock = time.process_time()
    start = start_from_matches(rig, frames, Steps(work_dir), "", options)
    arrays = start.arrays()
    refined = refine_scene(start_scene(rig, start, arrays), rig)
    seconds = time.process_time() - clock
    there = [frames.names.index(name) for name in arrays.frame_names]
    truth = simulated.truth.rig_from_world
    same = used_of(simulated, arrays, refined, there)
    return Outcome(
        num_matches=num_matches,
        num_frames=len(there),
        centers_rms=centers_rms(refined.scene.rig_from_world, truth[there]),
        same_rms=centers_rms(uwsfm.calibrate(same, **HELD).scene.rig_from_world, truth),
        scale_stddev=refined.calibration.covariance.scale_stddev,
        cpu_s=seconds,
    )


def used_of(
    simulated: SimulatedScene, arrays: StartArrays, refined: Refined, there: list[int]
) -> uwsfm.Scene:
    """The simulated scene with the observations that a reconstruction ended with."""
    scene = simulated.scene
    rows_of = [np.flatnonzero(scene.frame_idx == frame) for frame in there]
    keep = np.zeros(scene.num_observations, dtype=bool)
    for frame, keypoint in zip(
        arrays.frame_idx[refined.kept], arrays.keypoint_idx[refined.kept], strict=True
    ):
        keep[rows_of[frame][keypoint]] = True
    return scene.select(keep)[0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=5, help="strips")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    dives = [strip(seed) for seed in range(options.runs)]
    # Loads the compiled kernels: their time is not that of the method.
    small, _ = dives[0].scene.select(dives[0].scene.point_idx < 200)
    uwsfm.calibrate(small, **HELD)
    rows = [
        "| port | images | matches | centres, mm RMS | the same observations, from the "
        "truth | all true tracks, from the truth | scale | CPU s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    floor = rms(
        centers_rms(
            uwsfm.calibrate(dive.scene, **HELD).scene.rig_from_world,
            dive.truth.rig_from_world,
        )
        for dive in dives
    )
    for known in (True, False):
        found = []
        for dive in dives:
            with tempfile.TemporaryDirectory() as scratch:
                found.append(from_matches(dive, known=known, work_dir=Path(scratch)))
        rows.append(row_of(found, known, floor))
    text = "\n".join(rows) + "\n"
    (options.out / "mono_strip.md").write_text(text, encoding="utf-8")
    print(text)


def rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def row_of(found: list[Outcome], known: bool, floor: float) -> str:
    unknown = sum(one.scale_stddev is None for one in found)
    said = f"unknown in {unknown} of {len(found)}"
    if not unknown:
        said = f"± {100 * rms(one.scale_stddev or 0.0 for one in found):.0f} %"
    fewest = min(one.num_frames for one in found)
    return (
        f"| {'known' if known else 'free, from a rough start'} | "
        f"{fewest} of {NUM_FRAMES} | {np.mean([o.num_matches for o in found]):.0f} | "
        f"{1e3 * rms(one.centers_rms for one in found):.3f} | "
        f"{1e3 * rms(one.same_rms for one in found):.3f} | {1e3 * floor:.3f} | "
        f"{said} | {np.mean([one.cpu_s for one in found]):.1f} |"
    )


if __name__ == "__main__":
    main()
