"""What was given of a rig, number by number, in the terms of a rig file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.calibration.given_errors import GivenReach
from uwsfm.geometry import unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort, Port
from uwsfm.residuals import border

_LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_TILT, _DIRECTION = "port tilt towards {}", "direction of the baseline towards {}"
_PLAIN = {
    border.LENGTH: ("baseline", 1e3, " mm"),
    border.DISTANCE: ("port distance", 1e3, " mm"),
    border.WATER_INDEX: ("water index", 1.0, ""),
    border.THICKNESS: ("glass thickness", 1e3, " mm"),
    border.GLASS_INDEX: ("glass index", 1.0, ""),
    border.RADIUS: ("dome radius", 1e3, " mm"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenItem:
    """One number of one camera that was given, as a person knows it."""

    what: str
    camera: str
    changes: Array
    """(G,) of the given numbers, by one standard deviation."""
    amount: str
    assumed: bool
    prior: bool


def given_items(reach: GivenReach, ports: Sequence[Port]) -> Iterator[GivenItem]:
    """What was given, camera after camera, in the terms of a rig file.

    Args:
        reach: says what was given, and how well it is known.
        ports: of the cameras.
    """
    names = reach.accuracy.names or tuple(f"camera {c}" for c in range(len(ports)))
    for c, port in enumerate(ports):
        rows = np.flatnonzero(reach.given[:, 0] == c)
        slots = {int(reach.given[row, 1]): int(row) for row in rows}
        stddevs = {slot: float(reach.stddevs[row]) for slot, row in slots.items()}
        for what, steps, amount in _numbers(reach, c, port, stddevs):
            changes = np.zeros(len(reach.given))
            for slot, step in steps.items():
                changes[slots[slot]] = step
            first = next(iter(steps))
            yield GivenItem(
                what=what,
                camera=names[c],
                changes=changes,
                amount=amount,
                assumed=bool(reach.accuracy.assumed[c, first]),
                prior=slots[first] >= reach.num_held,
            )


_Number = tuple[str, dict[int, float], str]
"""What it is called, the steps of its slots, and the amount."""


def _numbers(
    reach: GivenReach, c: int, port: Port, stddevs: dict[int, float]
) -> Iterator[_Number]:
    state = reach.optimum.state
    pose = state.cam_from_rig[c]
    for axis, slot in zip("xyz", range(3), strict=True):
        if slot in stddevs:
            amount = _degrees(stddevs[slot])
            yield f"cam_from_rig turned about {axis}", {slot: stddevs[slot]}, amount
    if border.DIRECTION.start in stddevs:
        yield from _along_axes(pose[4:], border.DIRECTION, _DIRECTION, stddevs)
    if isinstance(port, PlanePort) and border.NORMAL.start in stddevs:
        yield from _along_axes(port.normal, border.NORMAL, _TILT, stddevs)
    if port.has("center"):
        for axis, slot in zip("xyz", range(6, 9), strict=True):
            if slot in stddevs:
                amount = f"+{1e3 * stddevs[slot]:.3g} mm"
                yield f"dome centre {axis}", {slot: stddevs[slot]}, amount
    for slot, (what, factor, unit) in _PLAIN.items():
        dome_centre = slot == border.DISTANCE and port.has("center")
        if slot in stddevs and not dome_centre:
            amount = f"+{factor * stddevs[slot]:.3g}{unit}"
            yield what, {slot: stddevs[slot]}, amount
    yield from _lens_numbers(state.lenses[c], stddevs)


def _lens_numbers(lens: Array, stddevs: dict[int, float]) -> Iterator[_Number]:
    first = border.FIRST_LENS
    focal = {slot: stddevs[slot] for slot in (first, first + 1) if slot in stddevs}
    if focal:
        slot = next(iter(focal))
        share = f"+{100.0 * focal[slot] / float(lens[slot - first]):.3g} %"
        yield "focal length", focal, share
        if len(focal) == 2:
            yield "fx", {first: focal[first]}, share
            yield "fy", {first + 1: focal[first + 1]}, share
    for k, name in enumerate(_LENS[2:], first + 2):
        if k in stddevs:
            unit = " px" if name in ("cx", "cy") else ""
            yield name, {k: stddevs[k]}, f"+{stddevs[k]:.3g}{unit}"


def _along_axes(
    direction: ArrayLike, slots: slice, name: str, stddevs: dict[int, float]
) -> Iterator[_Number]:
    """Steps of a unit vector towards the two camera axes that it is farthest from."""
    unit = np.asarray(direction) / np.linalg.norm(direction)
    basis = unit_vector.tangent_basis(unit)
    stddev = stddevs[slots.start]
    for axis in np.sort(np.argsort(np.abs(unit))[:2]):
        step = basis[axis] / np.linalg.norm(basis[axis]) * stddev
        steps = {slots.start: float(step[0]), slots.start + 1: float(step[1])}
        yield name.format("xyz"[axis]), steps, _degrees(stddev)


def _degrees(radians: float) -> str:
    return f"+{np.degrees(radians):.3g} deg"
