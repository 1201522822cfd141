"""What is computed from places, with its derivatives by them.

All are free of the choice of the world's frame, so that the frame that an adjustment
holds does not matter.
"""

from dataclasses import dataclass, field

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

ON_A_LINE = 1e-3
"""Breadth of places over their length, below which they span no plane."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """A number computed from places."""

    value: float
    """Metres, square metres or radians."""
    slope: Array
    """(k, 3) its derivative by every place."""
    flatness: Array | None = None
    """(k,) distances of the places from the plane that was fitted, metres: positive
    where an area's corners go round counter-clockwise, and where a height's top is."""
    notes: tuple[str, ...] = field(default=())


def distance(points: Array) -> Quantity:
    """Between two places (2, 3)."""
    return polyline(points)


def polyline(points: Array) -> Quantity:
    """Length of the straight pieces from place to place (k, 3).

    Raises:
        InputError: two neighbours are one place.
    """
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    if not np.all(lengths > 0.0):
        raise InputError(f"places {int(np.argmin(lengths)) + 1} and the next are one")
    along = steps / lengths[:, None]
    slope = np.zeros_like(points)
    slope[1:] += along
    slope[:-1] -= along
    return Quantity(float(lengths.sum()), slope)


def angle(points: Array) -> Quantity:
    """At the first place, between the directions to the other two (3, 3), radians.

    Raises:
        InputError: the corner is one of the ends.
    """
    first, second = points[1:] - points[0]
    lengths = np.linalg.norm([first, second], axis=1)
    if not np.all(lengths > 0.0):
        raise InputError("an end is the corner itself")
    a, b = first / lengths[0], second / lengths[1]
    value = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
    sine = np.sin(value)
    if sine < ON_A_LINE:
        raise InputError("the three places lie on a line: the angle has no direction")
    turn_a = (np.cos(value) * a - b) / (sine * lengths[0])
    turn_b = (np.cos(value) * b - a) / (sine * lengths[1])
    return Quantity(value, np.array([-turn_a - turn_b, turn_a, turn_b]))


def area(points: Array) -> Quantity:
    """Of a polygon (k, 3), projected on its plane.

    The plane is Newell's: the one on which the polygon's shadow is largest.

    Raises:
        InputError: the corners lie on a line or are one place, or sides cross.
    """
    _require_different(points)
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    middle = points.mean(axis=0)
    values, axes = np.linalg.eigh((points - middle).T @ (points - middle))
    if not values[1] > ON_A_LINE**2 * values[2]:
        raise InputError("the corners lie on a line: there is no area")
    _require_no_crossing((points - middle) @ axes[:, 1:])
    doubled = np.cross(points - middle, after - middle).sum(axis=0)
    value = 0.5 * float(np.linalg.norm(doubled))
    normal = doubled / (2.0 * value)
    slope = 0.5 * np.cross(normal, before - after)
    return Quantity(value, slope, flatness=(points - middle) @ normal)


def height(points: Array) -> Quantity:
    """Of the first place above the plane that fits the others best (k, 3); positive.

    Raises:
        InputError: the others lie on a line.
    """
    top, base = points[0], points[1:]
    middle = base.mean(axis=0)
    offset = base - middle
    values, axes = np.linalg.eigh(offset.T @ offset)
    if not values[1] > ON_A_LINE**2 * values[2]:
        raise InputError("the places of the plane lie on a line")
    normal = axes[:, 0]
    if normal @ (top - middle) < 0.0:
        normal = -normal
    above = top - middle
    slope = np.empty_like(points)
    slope[0] = normal
    slope[1:] = -normal / len(base)
    # The smallest eigenvector turns towards each other one.
    for value, axis in zip(values[1:], axes.T[1:], strict=True):
        turn = np.outer(offset @ normal, axis) + np.outer(offset @ axis, normal)
        slope[1:] += (axis @ above) / (values[0] - value) * turn
    flatness = np.append(np.nan, offset @ normal)
    return Quantity(float(normal @ above), slope, flatness=flatness)


def _require_different(points: Array) -> None:
    """Refuse a polygon that comes back to a corner: it encloses nothing, or parts."""
    _, first = np.unique(points, axis=0, return_index=True)
    for again in sorted(set(range(len(points))) - set(first.tolist())):
        before = int(np.argmax(np.all(points == points[again], axis=1)))
        raise InputError(
            f"corners {before + 1} and {again + 1} are one and the same place: give "
            "every corner once, in the order around the area"
        )


def _require_no_crossing(flat: Array) -> None:
    """Refuse a polygon in a plane (k, 2) whose sides cross."""
    count = len(flat)
    for i in range(count):
        for j in range(i + 2, count - (i == 0)):
            if _cross(flat[i], flat[(i + 1) % count], flat[j], flat[(j + 1) % count]):
                raise InputError(
                    f"sides {i + 1} and {j + 1} cross: give the corners in their order "
                    "around the area"
                )


def _cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    def side(p: Array, q: Array, r: Array) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0
