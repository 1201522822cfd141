"""Which way is up, and the level frame of maps: x, y along the ground, z up."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array

PLANE = "plane"
# Rows: the axes of the map in the world, right-handed. East-north-up stays as it is;
# of north-east-down, the map's x is east and its y is north.
_AXES: dict[str, tuple[tuple[int, int], ...]] = {
    "x": ((1, 1), (2, 1), (0, 1)),
    "y": ((2, 1), (0, 1), (1, 1)),
    "z": ((0, 1), (1, 1), (2, 1)),
    "-x": ((2, 1), (1, 1), (0, -1)),
    "-y": ((0, 1), (2, 1), (1, -1)),
    "-z": ((1, 1), (0, 1), (2, -1)),
}
UPS = (PLANE, *_AXES)
_NUM_TRIPLES = 400
_NUM_SAMPLED = 4000
_NUM_REFITS = 20
# Tukey's weights vanish beyond this many robust standard deviations.
_TUKEY = 4.685
_MAD_TO_STDDEV = 1.4826


@dataclass(frozen=True, kw_only=True)
class Level:
    """A level frame."""

    map_from_world: Array
    """(7,) pose; the map's z points up."""
    method: str
    """In words."""
    relief: float | None = None
    """Robust scatter of the points about the plane, if that is what is level."""


def level_by_axis(up: str) -> Level:
    """Up is an axis of the world, as "z" or "-z"."""
    rotation = np.zeros((3, 3))
    for row, (axis, sign) in enumerate(_AXES[up]):
        rotation[row, axis] = sign
    pose = np.concatenate([Rotation.from_matrix(rotation).as_quat(), np.zeros(3)])
    return Level(map_from_world=pose, method=f"the world's {up} axis is up")


def level_by_plane(points: Array, above: Array) -> Level:
    """The plane that most points lie near is level.

    The map's origin is where the world's, and its x axis where the world's x axis (y,
    if x is upright) meets the plane from above.

    Args:
        points: (N, 3) in the world; some may be far off the plane.
        above: (3,) a point on the side that is up, or far off in that direction.

    Raises:
        UwsfmError: the points are too few, or in a row.
    """
    normal, offset, scatter = fit_plane(points)
    side = float(normal @ above - offset)
    up = normal if side > 0.0 else -normal
    offset = offset if side > 0.0 else -offset
    along = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    x = along - (along @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    quat = Rotation.from_matrix(rotation).as_quat()
    pose = np.concatenate([quat, [0.0, 0.0, -offset]])
    return Level(
        map_from_world=pose,
        method="the plane through the points is level",
        relief=scatter,
    )


def fit_plane(points: Array) -> tuple[Array, float, float]:
    """The plane ``normal . x = offset`` near most of points (N, 3), and their scatter.

    Least median of squares over random triples, then Tukey's weights: a third of the
    points may lie elsewhere.

    Raises:
        UwsfmError: fewer than three points, or all in a row.
    """
    rng = np.random.default_rng(0)
    chosen = points[np.isfinite(points).all(axis=1)]
    if len(chosen) > _NUM_SAMPLED:
        chosen = chosen[rng.choice(len(chosen), _NUM_SAMPLED, replace=False)]
    if len(chosen) < 3:
        raise UwsfmError(f"a plane needs three points, there are {len(chosen)}")
    corners = chosen[rng.integers(len(chosen), size=(_NUM_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9 * lengths.max(initial=0.0)
    if not np.any(usable):
        raise UwsfmError("a plane needs points that are not all in a row")
    normals = normals[usable] / lengths[usable, None]
    offsets = np.einsum("ti,ti->t", normals, corners[usable, 0])
    misses = np.abs(chosen @ normals.T - offsets)  # (n, t)
    best = int(np.argmin(np.median(misses, axis=0)))
    return _refit(chosen, normals[best], float(offsets[best]))


def _refit(points: Array, normal: Array, offset: float) -> tuple[Array, float, float]:
    scatter = 0.0
    for _ in range(_NUM_REFITS):
        misses = points @ normal - offset
        scatter = _MAD_TO_STDDEV * float(np.median(np.abs(misses)))
        # A perfect plane has no scatter: rounding is.
        reach = _TUKEY * max(scatter, 1e-9 * float(np.abs(points).max()))
        weights = np.maximum(1.0 - (misses / reach) ** 2, 0.0) ** 2
        center = weights @ points / weights.sum()
        spread = points - center
        _, axes = np.linalg.eigh((weights * spread.T) @ spread)
        normal = axes[:, 0] * np.sign(axes[:, 0] @ normal)
        offset = float(normal @ center)
    return normal, offset, scatter


def find_level(
    up: str | None,
    points: Array,
    above: Array | None,
    *,
    has_positions: bool,
) -> Level:
    """The level frame that was asked for, or the plane of the points.

    Args:
        up: one of `UPS`; None: not said.
        points: (N, 3) in the world.
        above: see `level_by_plane`; None: unknown.
        has_positions: whether the world is the frame of navigation.

    Raises:
        InputError: the answer would be a guess.
    """
    if up is not None and up not in UPS:
        raise InputError(f"--up {up}: is one of {', '.join(UPS)}")
    if up is None and has_positions:
        raise InputError(
            "the model lies in the frame of the positions it was given: say which axis "
            "points up there, --up=z for east-north-up, --up=-z for north-east-down "
            "(or --up=plane)"
        )
    if up is not None and up != PLANE:
        return level_by_axis(up)
    if above is None:
        raise InputError(
            "which side of the points is up is not known, for there are neither "
            "cameras nor normals: say so with --up, or keep the file in its result "
            "folder, whose cameras tell"
        )
    return level_by_plane(points, above)


def world_from_map(level: Level) -> Array:
    """The inverse pose (7,)."""
    return rigid3.inverse(level.map_from_world)
