"""An output folder beside the truth of a simulation."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwsfm.colmap import Model
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.geometry.unit_vector import angle_between


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
class Comparison:
    """A whole reconstruction against the truth."""

    cameras: tuple[CameraComparison, ...]
    num_true_frames: int
    num_frames: int
    center_rms_m: float
    """Of the rig centres after moving the first pose onto the truth: no scaling."""
    center_max_m: float


def compare_with_truth(
    model: Model, housing: list[dict], truth_path: Path
) -> Comparison:
    """Compare a model and its summary's cameras with a truth.json.

    Args:
        model: the reconstruction.
        housing: "cameras" of its summary.json.
        truth_path: truth.json of the simulator.

    Raises:
        InputError: the truth is of other images.
    """
    truth = json.loads(Path(truth_path).read_text(encoding="utf-8"))
    true_poses = truth["rig_from_world"]
    unknown = set(model.frame_names) - set(true_poses)
    if unknown:
        raise InputError(f"{truth_path}: no pose of frame {sorted(unknown)[0]}")
    expected = np.array([true_poses[name] for name in model.frame_names])
    errors = _center_errors(model.scene.rig_from_world, expected)
    cameras = []
    for entry, camera in zip(housing, truth["cameras"], strict=True):
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
        num_true_frames=len(true_poses),
        num_frames=model.scene.num_frames,
        center_rms_m=float(np.sqrt(np.mean(errors**2))),
        center_max_m=float(errors.max()),
    )


def _center_errors(rig_from_world: Array, expected: Array) -> Array:
    """Distances of the rig centres (F,) after aligning the first pose only."""
    # world here -> first rig -> true world
    true_from_world = rigid3.compose(rigid3.inverse(expected[0]), rig_from_world[0])
    centers = rigid3.transform(true_from_world, rigid3.inverse(rig_from_world)[:, 4:])
    return np.linalg.norm(centers - rigid3.inverse(expected)[:, 4:], axis=1)
