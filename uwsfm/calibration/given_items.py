"""What was given of a rig, number by number, in the terms of a rig file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.calibration.given_errors import GivenReach
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import (
    BASELINE,
    CENTER,
    DIRECTION,
    DISTORTION,
    FOCAL,
    LENS_NAMES,
    OF_PORTS,
    PRINCIPAL_POINT,
    ROTATION,
    TILT,
)
from uwsfm.geometry import unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort, Port
from uwsfm.residuals import border


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
    yield from _by_axis(ROTATION, stddevs)
    if DIRECTION.first in stddevs:
        yield from _along_axes(pose[4:], DIRECTION, stddevs)
    if isinstance(port, PlanePort) and TILT.first in stddevs:
        yield from _along_axes(port.normal, TILT, stddevs)
    if CENTER.of(port):
        yield from _by_axis(CENTER, stddevs)
    for parameter in (*OF_PORTS, BASELINE):
        slot = parameter.first
        if slot in stddevs and parameter.of(port):
            amount = _amount(parameter, stddevs[slot])
            yield parameter.name, {slot: stddevs[slot]}, amount
    yield from _lens_numbers(state.lenses[c], stddevs)


def _by_axis(parameter: Parameter, stddevs: dict[int, float]) -> Iterator[_Number]:
    """Steps of three numbers, each along an axis of the camera."""
    for axis, slot in enumerate(range(parameter.first, parameter.first + 3)):
        if slot in stddevs:
            amount = _amount(parameter, stddevs[slot])
            yield parameter.step.format("xyz"[axis]), {slot: stddevs[slot]}, amount


def _amount(parameter: Parameter, stddev: float) -> str:
    return f"+{parameter.unit.shown(stddev, '.3g')}"


def _lens_numbers(lens: Array, stddevs: dict[int, float]) -> Iterator[_Number]:
    first = border.FIRST_LENS
    focal = {slot: stddevs[slot] for slot in (first, first + 1) if slot in stddevs}
    if focal:
        slot = next(iter(focal))
        share = f"+{100.0 * focal[slot] / float(lens[slot - first]):.3g} %"
        yield FOCAL.name, focal, share
        if len(focal) == 2:
            yield "fx", {first: focal[first]}, share
            yield "fy", {first + 1: focal[first + 1]}, share
    for parameter in (PRINCIPAL_POINT, DISTORTION):
        for slot in range(parameter.first, parameter.first + parameter.size):
            if slot in stddevs:
                amount = _amount(parameter, stddevs[slot])
                yield LENS_NAMES[slot - first], {slot: stddevs[slot]}, amount


def _along_axes(
    direction: ArrayLike, parameter: Parameter, stddevs: dict[int, float]
) -> Iterator[_Number]:
    """Steps of a unit vector towards the two camera axes that it is farthest from."""
    unit = np.asarray(direction) / np.linalg.norm(direction)
    basis = unit_vector.tangent_basis(unit)
    first = parameter.first
    stddev = stddevs[first]
    for axis in np.sort(np.argsort(np.abs(unit))[:2]):
        step = basis[axis] / np.linalg.norm(basis[axis]) * stddev
        steps = {first: float(step[0]), first + 1: float(step[1])}
        yield parameter.step.format("xyz"[axis]), steps, _amount(parameter, stddev)
