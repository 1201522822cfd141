"""Turn the cameras of a rig so that the rays of the same point meet.

A port tilted by t degrees turns all rays by about t / 4, several pixels. Until the
ports are calibrated, that turn can only be given to the cameras; without it a fixed rig
does not fit its own images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import Port
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.sfm.poses.epipolar import ray_pairs, relative_pose
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches

MIN_RIG_MATCHES = 30
"""Over all frames; a pair of cameras with fewer tells nothing about the rig."""
MAX_MATCHES = 20_000
PRIOR_DEG = 2.0
NOISE = 1e-3
"""Radians, less than a pixel: where the robust loss sets in."""
NOTABLE_TURN_DEG = 1.5
"""A relative port tilt of 6 degrees: worth a word."""
MAX_TILT_TURN_DEG = 3.0
"""One of 12 degrees: no port that was put in place by hand is tilted by more."""


@dataclass(frozen=True, kw_only=True)
class RigRotation:
    """A rig whose cameras were turned about their own centres."""

    cam_from_rig: Array
    """(C, 7); camera centres as before."""
    turn_deg: Array
    """(C,) by how much each camera was turned; the reference is not."""
    misfit_before: float
    """Median angle by which rays miss their epipolar plane, radians."""
    misfit_after: float

    def warnings(self, rig: Rig, causes: Mapping[int, str]) -> list[str]:
        """What the user should know, one sentence each.

        Args:
            rig: Its cameras.
            causes: As of `rig_check.turn_causes`.
        """
        return [
            f"camera {camera.name!r} was turned by {turn:.1f} degrees to fit the "
            f"images: {_cause(camera.port, turn, causes.get(c, ''))}"
            for c, (camera, turn) in enumerate(
                zip(rig.cameras, self.turn_deg, strict=True)
            )
            if turn > NOTABLE_TURN_DEG
        ]


def _cause(port: Port, turn_deg: float, mistake: str) -> str:
    """The mistake that explains a turn, if any, then what else turns the rays."""
    words = [f"probably {mistake}; else"] if mistake else []
    if port.has("center"):
        words.append("its dome is off its centre, or")
    elif not port.refracts:
        words.append(
            "its lens was calibrated in air and its port is missing in the rig file, or"
        )
    elif port.has("normal") and turn_deg <= MAX_TILT_TURN_DEG:
        words.append("its port is tilted by about four times that, or")
    return " ".join([*words, "its cam_from_rig is wrong"])


def correct_rotations(
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
) -> RigRotation:
    """Estimate small turns of the cameras from matches of the same frame.

    Turns along the epipolar lines change depths, not misfits, and show only through
    the perspective; a weak prior holds them where the images do not tell.

    Args:
        cameras: With initial ports. One alone stays where it is.
        cam_from_rig: Poses (C, 7) to start from.
        pairs: Matches of the same frame, at least `MIN_RIG_MATCHES` in one of them.
    """
    num_cameras = len(cameras)
    if num_cameras == 1:
        return RigRotation(
            cam_from_rig=np.asarray(cam_from_rig),
            turn_deg=np.zeros(1),
            misfit_before=0.0,
            misfit_after=0.0,
        )
    from scipy.optimize import least_squares  # heavy, and no resumed run needs it

    used = [pair.thinned(MAX_MATCHES) for pair in pairs if len(pair) >= MIN_RIG_MATCHES]

    def turned(delta: Array) -> Array:
        tangent = np.zeros((num_cameras, 6))
        tangent[1:, :3] = delta.reshape(-1, 3)
        return rigid3.perturb(cam_from_rig, tangent)

    def angles(poses: Array) -> Array:
        rows = [
            ray_pairs(
                cameras[pair.camera_a],
                cameras[pair.camera_b],
                relative_pose(poses, pair.camera_a, pair.camera_b),
                pair.xy_a,
                pair.xy_b,
            ).epipolar_angles()
            for pair in used
        ]
        return np.nan_to_num(np.concatenate(rows), nan=0.0)

    def residuals(delta: Array) -> Array:
        prior = delta / np.radians(PRIOR_DEG)
        return np.concatenate([angles(turned(delta)) / NOISE, prior])

    start = np.zeros(3 * (num_cameras - 1))
    solution = least_squares(residuals, start, loss="soft_l1", x_scale=np.radians(1.0))
    poses = turned(solution.x)
    turn_deg = np.zeros(num_cameras)
    turn_deg[1:] = np.degrees(np.linalg.norm(solution.x.reshape(-1, 3), axis=1))
    return RigRotation(
        cam_from_rig=poses,
        turn_deg=turn_deg,
        misfit_before=float(np.median(np.abs(angles(np.asarray(cam_from_rig))))),
        misfit_after=float(np.median(np.abs(angles(poses)))),
    )


def scene_depths(
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: Array,
    pairs: Sequence[PairMatches],
) -> Array:
    """How far away the scene is: 10th, 50th and 90th percentile of depth (C, 3).

    Depth is the third coordinate in the camera's own frame, metres. A camera that
    shares no view takes the percentiles of all points of the others.

    Raises:
        InputError: no match has a point in front of its cameras.
    """
    seen: list[list[Array]] = [[] for _ in cameras]
    for pair in pairs:
        if len(pair) < MIN_RIG_MATCHES:
            continue
        a, b = pair.camera_a, pair.camera_b
        b_from_a = relative_pose(cam_from_rig, a, b)
        rays = ray_pairs(cameras[a], cameras[b], b_from_a, pair.xy_a, pair.xy_b)
        points, in_front = rays.triangulate()
        seen[a].append(points[in_front, 2])
        seen[b].append(rigid3.transform(b_from_a, points[in_front])[:, 2])
    everything = np.concatenate([depths for rows in seen for depths in rows])
    if not len(everything):
        raise InputError(
            "the matches of the cameras' images give no point in front of the rig: do "
            "the folders of the cameras hold the same pictures, or is cam_from_rig "
            "that of another rig or inverted?"
        )
    return np.stack(
        [
            np.percentile(np.concatenate(rows) if rows else everything, [10, 50, 90])
            for rows in seen
        ]
    )
