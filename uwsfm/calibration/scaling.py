"""A scene brought near the lengths from outside: their unit and axes checked."""

from dataclasses import replace

import numpy as np

from uwsfm.calibration.lengths import Distances, Lengths
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import (
    Similarity,
    align_heights,
    align_robustly,
    fits_mirrored,
)
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene
from uwsfm.solver.terms import centers

# Positions that are so many times as far apart as the frames have other units.
WRONG_UNITS = 2.0


def start_scale(scene: Scene, lengths: Lengths) -> float:
    """Factor that brings a scene of arbitrary scale near the lengths; 1 without any."""
    if lengths.between_points is not None:
        return _ratio(scene.points, lengths.between_points)
    origins = centers(scene.rig_from_world)
    if lengths.between_frames is not None:
        return _ratio(origins, lengths.between_frames)
    if lengths.positions is not None:
        seen = with_seen_positions(lengths, scene)
        return alignment(scene, seen, with_scale=True).scale
    return 1.0


def with_seen_positions(lengths: Lengths, scene: Scene) -> Lengths:
    """Lengths with the positions of frames that have observations.

    Raises:
        InputError: these are too few.
    """
    known = lengths.positions
    if known is None:
        return lengths
    seen = np.isin(known.frame_idx, scene.frame_idx)
    if len(np.unique(known.frame_idx[seen])) < 3:
        raise InputError(
            f"{np.count_nonzero(seen)} of the positions belong to frames of the model: "
            "at least 3 different frames are needed"
        )
    known = replace(
        known,
        frame_idx=known.frame_idx[seen],
        positions=known.positions[seen],
        covariances=known.covariances[seen],
    )
    return replace(lengths, positions=known)


def _ratio(places: Array, distances: Distances) -> float:
    first, second = (places[distances.ends[:, side]] for side in (0, 1))
    found = np.linalg.norm(first - second, axis=1)
    with np.errstate(divide="ignore"):
        ratio = float(np.median(distances.lengths_m / found))
    if not (np.isfinite(ratio) and ratio > 0.0):
        raise InputError(
            "the ends of a known length cannot be placed: they are one place, or not "
            "seen from two sides"
        )
    return ratio


def alignment(scene: Scene, lengths: Lengths, *, with_scale: bool) -> Similarity:
    """Where the rig's antenna is in the frame of the positions.

    With a scale, the lever arm is taken as it is: it is short against the track.
    """
    known = lengths.positions
    assert known is not None
    if not known.measured.all():
        antenna, places, _ = _matched(scene.rig_from_world, lengths)
        up = _upwards(scene.rig_from_world)
        return align_heights(antenna, places[:, 2], up, with_scale=with_scale)
    return align_robustly(
        *_matched(scene.rig_from_world, lengths), with_scale=with_scale
    )


def _upwards(rig_from_world: Array) -> Array:
    """(3,) roughly upwards: cameras look down or ahead rather than up, and their images
    are rather upright than not."""
    world_from_rig = rigid3.inverse(rig_from_world)
    axes = rigid3.rotate(world_from_rig, np.array([0.0, -1.0, -1.0]))
    mean: Array = axes.mean(axis=0)
    return mean


def _matched(rig_from_world: Array, lengths: Lengths) -> tuple[Array, Array, Array]:
    """The antenna in the world (M, 3), its positions (M, 3), and their covariances."""
    known = lengths.positions
    assert known is not None
    poses = rigid3.inverse(rig_from_world[known.frame_idx])
    antenna = rigid3.transform(poses, known.lever_arm)
    return antenna, known.positions, known.covariances


def require_right_handed(
    rig_from_world: Array, lengths: Lengths, *, with_scale: bool
) -> None:
    """See to it that the axes of the positions are not mirrored, as far as they tell.

    Args:
        rig_from_world: poses (F, 7) that the images were adjusted to: before, the map's
            own errors look like those of positions.
        lengths: with positions.
        with_scale: the images do not tell the scale.

    Raises:
        InputError: the positions fit as a mirror image, and not as they are.
    """
    known = lengths.positions
    assert known is not None
    if not known.measured.all():
        return  # the mirror image of heights is a turn upside down
    if fits_mirrored(*_matched(rig_from_world, lengths), with_scale=with_scale):
        raise InputError(
            f"{known.source}: the axes of the positions are mirrored: with two of x, "
            "y, z swapped, or the sign of one changed, they fit the images, and as "
            "they are they do not; give a right-handed frame, such as east, north, up "
            "or north, east, down"
        )


def require_metres(scene: Scene, lengths: Lengths) -> None:
    """See to it that a rig's baseline and the positions have one unit.

    Raises:
        InputError: the positions are far more, or less, apart than the frames.
    """
    known = lengths.positions
    assert known is not None
    if not known.measured.all():
        return  # depths along a slope fit every scale, with another tilt
    scale = alignment(scene, lengths, with_scale=True).scale
    spread = float(np.linalg.norm(np.std(known.positions, axis=0)))
    noise = float(np.sqrt(np.median(np.trace(known.covariances, 0, 1, 2))))
    wrong = not 1.0 / WRONG_UNITS < scale < WRONG_UNITS
    if wrong and spread > 10.0 * noise:
        raise InputError(
            f"{known.source}: the positions are {scale:.4g} times as far apart as the "
            "frames of the model: they, or the baseline of the rig, are not in metres"
        )


def scaled(scene: Scene, scale: float) -> Scene:
    """A scene of one camera, larger by a factor; its housing stays."""
    poses = scene.rig_from_world.copy()
    poses[:, 4:] *= scale
    return replace(scene, rig_from_world=poses, points=scale * scene.points)


def moved(scene: Scene, nav_from_world: Array) -> Scene:
    """A scene in another world."""
    back = rigid3.inverse(nav_from_world)
    return replace(
        scene,
        rig_from_world=rigid3.compose(scene.rig_from_world, back),
        points=rigid3.transform(nav_from_world, scene.points),
    )
