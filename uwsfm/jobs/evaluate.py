"""An output folder beside the truth of a simulation."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between
from uwsfm.jobs.reconstruct import ReconstructResult


@dataclass(frozen=True, kw_only=True)
class CameraComparison:
    """One camera's housing: estimate, its standard deviation, truth."""

    name: str
    tilt_error_deg: float
    """Angle between the estimated and the true normal."""
    tilt_stddev_deg: float | None
    normal: tuple[float, float, float]
    true_normal: tuple[float, float, float]
    distance_m: float
    distance_stddev_m: float | None
    true_distance_m: float

    @property
    def distance_error_m(self) -> float:
        return self.distance_m - self.true_distance_m


@dataclass(frozen=True, kw_only=True)
class DomeComparison:
    """One camera behind a dome: its centre's estimate, standard deviation, truth."""

    name: str
    center_m: tuple[float, float, float]
    center_stddev_m: tuple[float | None, ...]
    true_center_m: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A whole reconstruction against the truth."""

    cameras: tuple[CameraComparison, ...]
    """Those behind flat ports."""
    domes: tuple[DomeComparison, ...]
    """Those behind domes."""
    num_true_frames: int
    num_frames: int
    center_rms_m: float
    """Of the rig centres after moving the first pose onto the truth: no scaling."""
    start_center_rms_m: float
    """The same of the map, before the last adjustment."""


def compare_with_truth(result: ReconstructResult, truth_path: Path) -> Comparison:
    """Compare a reconstruction with a truth.json of the simulator.

    Raises:
        InputError: the truth is of other images.
    """
    truth = json.loads(Path(truth_path).read_text(encoding="utf-8"))
    true_poses = truth["rig_from_world"]
    model = result.model
    unknown = set(model.frame_names) - set(true_poses)
    if unknown:
        raise InputError(f"{truth_path}: no pose of frame {sorted(unknown)[0]}")
    expected = np.array([true_poses[name] for name in model.frame_names])
    cameras, domes = [], []
    for entry, camera in zip(result.summary["cameras"], truth["cameras"], strict=True):
        if "center_m" in entry:
            domes.append(
                DomeComparison(
                    name=entry["name"],
                    center_m=tuple(entry["center_m"]),
                    center_stddev_m=tuple(entry["center_stddev_m"]),
                    true_center_m=tuple(camera["center_m"]),
                )
            )
        if "normal" not in entry:
            continue
        cameras.append(
            CameraComparison(
                name=entry["name"],
                tilt_error_deg=float(
                    np.degrees(angle_between(entry["normal"], camera["normal"]))
                ),
                tilt_stddev_deg=entry["normal_stddev_deg"],
                normal=tuple(entry["normal"]),
                true_normal=tuple(camera["normal"]),
                distance_m=entry["distance_m"],
                distance_stddev_m=entry["distance_stddev_m"],
                true_distance_m=camera["distance_m"],
            )
        )
    return Comparison(
        cameras=tuple(cameras),
        domes=tuple(domes),
        num_true_frames=len(true_poses),
        num_frames=model.scene.num_frames,
        center_rms_m=center_rms(model.scene.rig_from_world, expected),
        start_center_rms_m=center_rms(result.start.rig_from_world, expected),
    )


def center_rms(rig_from_world: Array, expected: Array) -> float:
    """RMS distance of the rig centres after aligning the first pose only."""
    # world here -> first rig -> true world
    true_from_world = rigid3.compose(rigid3.inverse(expected[0]), rig_from_world[0])
    centers = rigid3.transform(true_from_world, rigid3.inverse(rig_from_world)[:, 4:])
    errors = centers - rigid3.inverse(expected)[:, 4:]
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
