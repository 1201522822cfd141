"""Starting points off the truth, for solvers to come back from."""

from dataclasses import dataclass, replace

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene
from uwsfm.simulate.rigs import rough_port


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """How far off the start is; the standard deviations are per component.

    The defaults are the paper's start: straight ports at half their distance.
    """

    straight_ports: bool = True
    """Every port normal becomes (0, 0, 1), and domes concentric."""
    distance_scale: float = 0.5
    """Of every port distance."""
    rotation_stddev_deg: float = 0.0
    """Of the rig poses, but the first: it holds the gauge."""
    translation_stddev: float = 0.0
    """Of the rig centres, but the first, metres."""
    cam_rotation_stddev_deg: float = 0.0
    """Of the cameras in the rig, but the reference."""
    baseline_direction_stddev_deg: float = 0.0
    """Of the camera centres in the rig; the length of the baselines is kept."""
    point_stddev: float = 0.0
    """Metres."""
    seed: int = 0


def perturbed(scene: Scene, perturbation: Perturbation | None = None) -> Scene:
    """A scene with the same observations and parameters off by some amounts."""
    how = perturbation or Perturbation()
    rng = np.random.default_rng(how.seed)
    cameras = tuple(
        camera.with_port(
            rough_port(
                camera.port,
                straight=how.straight_ports,
                distance_scale=how.distance_scale,
            )
        )
        for camera in scene.cameras
    )
    rig_from_world = _turned(
        scene.rig_from_world, np.radians(how.rotation_stddev_deg), rng
    )
    rig_from_world[1:, 4:] += how.translation_stddev * rng.normal(
        size=(len(rig_from_world) - 1, 3)
    )
    cam_from_rig = _turned(
        scene.cam_from_rig, np.radians(how.cam_rotation_stddev_deg), rng
    )
    # A rotation about the rig origin first: it moves the centres, not their distances.
    swing = np.radians(how.baseline_direction_stddev_deg)
    for row in cam_from_rig[1:]:
        quat = rigid3.quat_from_rotvec(swing * rng.normal(size=3))
        row[4:] = rigid3.rotate(np.concatenate([quat, np.zeros(3)]), row[4:])
    return replace(
        scene,
        cameras=cameras,
        cam_from_rig=cam_from_rig,
        rig_from_world=rig_from_world,
        points=scene.points + how.point_stddev * rng.normal(size=scene.points.shape),
    )


def _turned(poses: Array, stddev: float, rng: np.random.Generator) -> Array:
    """Poses (N, 7) turned about their own centres, all but the first."""
    delta = np.zeros((len(poses), 6))
    delta[1:, :3] = stddev * rng.normal(size=(len(poses) - 1, 3))
    return rigid3.perturb(poses, delta)
