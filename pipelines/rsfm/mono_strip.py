"""One camera along a strip: is the noise floor reached, and is the scale known?

    python pipelines/rsfm/mono_strip.py -o OUT

30 images 1 m above the floor, matches with 10 % of wrong ones, ports that are known or
not. From the matches alone (verification, mapping, adjustment), beside an adjustment of
the true tracks that starts from the truth. Centres and points are compared after the
best similarity, because the images of one camera tell no scale.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from strips import OVERLAP, similarity

import uwsfm
from uwsfm.export.summary import scale_summary
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.pipeline import start_scene
from uwsfm.rig import Rig
from uwsfm.sfm.background import opened
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.refine import refine_scene
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate import ObservationOptions, Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.rigs import paper_rig, rough_port
from uwsfm.simulate.trajectories import straight_strip

NUM_FRAMES = 30
ALTITUDE = 1.0
NUM_POINTS = 9500
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
    turn, scale = similarity(found, true)
    gap = scale * (found - found.mean(axis=0)) @ turn.T - (true - true.mean(axis=0))
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def from_matches(simulated: SimulatedScene, *, known: bool, work_dir: Path) -> str:
    """A row of the table."""
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
    error = centers_rms(
        refined.scene.rig_from_world, simulated.truth.rig_from_world[there]
    )
    scale = scale_summary(refined.calibration)
    stddev = refined.calibration.covariance.scale_stddev
    said = "arbitrary" if stddev is None else f"known to {100 * stddev:.1f} %"
    return (
        f"| from {num_matches} matches, port {'known' if known else 'free'} | "
        f"{len(there)} of {NUM_FRAMES} | {1e3 * error:.3f} | "
        f"{said} ({scale['unit']}) | {seconds:.1f} |"
    )


def from_truth(simulated: SimulatedScene) -> str:
    clock = time.process_time()
    result = uwsfm.calibrate(
        simulated.scene, loss="l2", refine_normals=False, refine_distances=False
    )
    seconds = time.process_time() - clock
    use = finite_rows(result.scene.points)
    points = rms_after_similarity(result.scene.points[use], simulated.truth.points[use])
    error = centers_rms(result.scene.rig_from_world, simulated.truth.rig_from_world)
    return (
        f"| adjustment of the true tracks from the truth (points {1e3 * points:.3f} mm)"
        f" | {NUM_FRAMES} of {NUM_FRAMES} | {1e3 * error:.3f} | - | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    simulated = strip(options.seed)
    # Loads the compiled kernels: their time is not that of the method.
    small, _ = simulated.scene.select(simulated.scene.point_idx < 200)
    uwsfm.calibrate(small, refine_normals=False, refine_distances=False)
    rows = ["| | images | centres, mm RMS | scale | CPU s |", "|---|---|---|---|---|"]
    rows.append(from_truth(simulated))
    for known in (True, False):
        with tempfile.TemporaryDirectory() as scratch:
            rows.append(from_matches(simulated, known=known, work_dir=Path(scratch)))
    text = "\n".join(rows) + "\n"
    (options.out / "mono_strip.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
