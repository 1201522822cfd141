"""Output folders of simulated dives, with their truth."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from sfm_scenes import model_of

from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.jobs.refine_model import RefineResult, refine_model
from uwsfm.results.files import export_colmap
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.terms import centers


@dataclass(frozen=True)
class DiveResult:
    """What `refine_model` wrote and returned, and what is true."""

    out: Path
    result: RefineResult
    truth: Scene


GOOD = CameraAccuracy(
    focal=1e-4, principal_point_px=0.1, distortion=(5e-4, 1e-3, 1e-4, 1e-4)
)


def with_good_lenses(rig: Rig) -> Rig:
    """A rig that nobody calls exact: its lenses are known well, the rest is assumed."""
    cameras = tuple(replace(camera, accuracy=GOOD) for camera in rig.cameras)
    return replace(rig, cameras=cameras, accuracy=RigAccuracy())


def refined_dive(folder: Path, num_frames: int = 6, num_points: int = 300):
    """A stereo dive with an uncertain baseline, a scale bar and a known distance."""
    rig = with_good_lenses(sample_rig())
    simulated = simulate_scene(
        rig,
        rich_motion(num_frames),
        Relief(stddev=0.15, correlation_length=0.4),
        ObservationOptions(num_points=num_points, noise_px=0.3, detection_rate=0.8),
    )
    truth = simulated.truth
    export_colmap(model_of(rig, simulated.scene), folder / "model")
    dump_rig(rig, folder / "rig.yaml")
    rng = np.random.default_rng(0)
    ends = np.argsort(-np.bincount(truth.point_idx), kind="stable")[:2]
    origins = centers(truth.rig_from_world)
    known = {
        "version": 1,
        "scale_bars": [
            {
                "length_m": float(np.linalg.norm(np.subtract(*truth.points[ends]))),
                "stddev_m": 0.001,
                "ends": [clicks(truth, point, rng) for point in ends],
            }
        ],
        "frame_distances": [
            {
                "frames": ["0001.jpg", f"{num_frames - 1:04}.jpg"],
                "length_m": float(np.linalg.norm(origins[1] - origins[-1])),
                "stddev_m": 0.005,
            }
        ],
    }
    (folder / "lengths.yaml").write_text(yaml.safe_dump(known))
    result = refine_model(
        folder / "model",
        folder / "rig.yaml",
        folder / "out",
        lengths=folder / "lengths.yaml",
    )
    return DiveResult(folder / "out", result, truth)


def clicks(truth: Scene, point: int, rng, stddev_px: float = 1.0) -> list[dict]:
    """One point clicked in all images that saw it."""
    found = []
    for i in np.nonzero(truth.point_idx == point)[0]:
        side = ("left", "right")[truth.camera_idx[i]]
        xy = (truth.projections()[0][i] + stddev_px * rng.normal(size=2)).tolist()
        found.append({"image": f"{side}/{truth.frame_idx[i]:04}.jpg", "xy": xy})
    return found
