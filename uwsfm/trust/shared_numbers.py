"""What two calibrations of one rig found, number by number, and how far apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.given_errors import GivenReach, given_reach
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import (
    BASELINE,
    CENTER,
    DIRECTION,
    DISTANCE,
    LENS_NAMES,
    OF_PORTS,
    ROTATION,
    TILT,
    lens_parameter,
)
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.uncertainty import border_covariance
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import param_slots
from uwsfm.models.ports.port import DomePort, PlanePort, Port
from uwsfm.residuals import border
from uwsfm.scene import IndexArray
from uwsfm.solver.layout import HELD


@dataclass(frozen=True, kw_only=True)
class SharedNumber:
    """One number of the rig, its ports or lenses, by two calibrations."""

    group: str
    """Numbers that are judged together: a `Parameter.group`."""
    name: str
    camera: int
    unit: str
    """Empty for what has none."""
    values: tuple[float, float]
    stddev: float
    """Of the difference, as both calibrations predict it from their images."""
    stddev_in_all: float
    """With the errors of what was given to both alike: what the images of each make of
    them differs."""

    @property
    def difference(self) -> float:
        return self.values[1] - self.values[0]

    @property
    def z(self) -> float:
        """The difference in its standard deviations."""
        return self.difference / self.stddev

    @property
    def z_in_all(self) -> float:
        return self.difference / self.stddev_in_all


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedNumbers:
    numbers: tuple[SharedNumber, ...]
    covariance: Array
    """(K, K) of the differences, in the units of the numbers."""

    def of(self, group: str) -> IndexArray:
        """Which numbers are in a group."""
        mine = [number.group == group for number in self.numbers]
        return np.flatnonzero(mine)

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(number.group for number in self.numbers))


@dataclass(frozen=True)
class _Reading:
    """Numbers of one slot or a few: both values, and their derivative by the slots."""

    group: str
    names: Sequence[str]
    unit: str
    values: Array
    """(2, k)"""
    slots: slice
    slope: Array
    """(k, number of slots)"""


def shared_numbers(
    first: CalibrationResult, second: CalibrationResult, names: Sequence[str]
) -> SharedNumbers:
    """Compare what both calibrations refined; bounds and what is held are left out.

    Args:
        first, second: of the same rig, with the same options.
        names: of the cameras.
    """
    both = (first, second)
    sides = [_Side.of(result) for result in both]
    found: list[SharedNumber] = []
    rows: list[tuple[Array, Array]] = []
    reaches: list[tuple[Array, Array]] = []
    seen: set[int] = set()
    for camera, name in enumerate(names):
        for reading in _readings(both, camera):
            cols = [side.columns[camera, reading.slots] for side in sides]
            if HELD in cols[0] or HELD in cols[1] or int(cols[0][0]) in seen:
                continue
            seen.add(int(cols[0][0]))  # several ports may share one water
            rows.append(_both(side.row(camera, reading) for side in sides))
            reaches.append(_both(side.reached(camera, reading) for side in sides))
            found += [
                SharedNumber(
                    group=reading.group,
                    name=f"{number} of {name}",
                    camera=camera,
                    unit=reading.unit,
                    values=(float(a), float(b)),
                    stddev=np.nan,
                    stddev_in_all=np.nan,
                )
                for number, a, b in zip(reading.names, *reading.values, strict=True)
            ]
    if not found:
        return SharedNumbers(numbers=(), covariance=np.zeros((0, 0)))
    total = np.zeros((len(found), len(found)))
    for k, side in enumerate(sides):
        slope = np.concatenate([pair[k] for pair in rows])
        total += slope @ side.covariance @ slope.T
    reached = [np.concatenate([pair[k] for pair in reaches]) for k in (0, 1)]
    own = np.diag(total)
    in_all = np.maximum(own + _given_part(sides, reached), 1e-6 * own)
    return SharedNumbers(
        numbers=tuple(
            replace(number, stddev=float(stddev), stddev_in_all=float(wider))
            for number, stddev, wider in zip(
                found, np.sqrt(np.diag(total)), np.sqrt(in_all), strict=True
            )
        ),
        covariance=total,
    )


@dataclass(frozen=True, eq=False)
class _Side:
    """What one calibration predicts."""

    columns: IndexArray
    covariance: Array
    """(B, B)"""
    reach: GivenReach

    @classmethod
    def of(cls, result: CalibrationResult) -> _Side:
        reach = given_reach(result)
        covariance = border_covariance(reach.optimum)
        return cls(result.covariance.border_cols, covariance, reach)

    def row(self, camera: int, reading: _Reading) -> Array:
        """(k, B) derivative by the refined parameters."""
        row = np.zeros((len(reading.names), len(self.covariance)))
        row[:, self.columns[camera, reading.slots]] = reading.slope
        return row

    def reached(self, camera: int, reading: _Reading) -> Array:
        """(k, G) derivative by the given numbers."""
        reached: Array = reading.slope @ self.reach.border_steps[camera, reading.slots]
        return reached


def _both(pair: Iterator[Array]) -> tuple[Array, Array]:
    first, second = pair
    return first, second


def _given_part(sides: Sequence[_Side], reached: Sequence[Array]) -> Array:
    """(K,) variance that errors of given numbers, the same in both, add to differences.

    A prior is in what each side predicts already, as if each had one of its own: that
    part is taken out.
    """
    keys = [[tuple(pair) for pair in side.reach.given.tolist()] for side in sides]
    common = [key for key in keys[0] if key in keys[1]]
    index = [[own.index(key) for key in common] for own in keys]
    apart = reached[1][:, index[1]] - reached[0][:, index[0]]
    covariance = sides[0].reach.covariance[np.ix_(index[0], index[0])]
    added = np.einsum("kg,gh,kh->k", apart, covariance, apart)
    for side, steps in zip(sides, reached, strict=True):
        held = side.reach.num_held
        own = side.reach.covariance[held:, held:]
        added -= np.einsum("kg,gh,kh->k", steps[:, held:], own, steps[:, held:])
    return np.asarray(added)


def _readings(
    both: tuple[CalibrationResult, CalibrationResult], camera: int
) -> Iterator[_Reading]:
    ports = [result.scene.ports[camera] for result in both]
    flat = [port for port in ports if isinstance(port, PlanePort)]
    domes = [port for port in ports if isinstance(port, DomePort)]
    if len(flat) == 2:
        normals = np.array([port.normal for port in flat])
        basis = unit_vector.tangent_basis(normals[0])
        level = np.sqrt(1.0 - normals[0, :2] ** 2)
        yield _several(
            TILT,
            "xy",
            np.degrees(np.arcsin(normals[:, :2])),
            np.degrees(basis[:2] / level[:, None]),
        )
        yield _of_port(DISTANCE, ports)
    if len(domes) == 2:
        centers = 1e3 * np.array([port.center for port in domes])
        yield _several(CENTER, "xyz", centers, 1e3 * np.eye(3))
    yield from _placement(both, camera)
    for parameter in OF_PORTS:
        has = all(parameter.of(port) for port in ports)
        if has and parameter is not DISTANCE:
            yield _of_port(parameter, ports)
    yield from _lens(both, camera)


def _placement(
    both: tuple[CalibrationResult, CalibrationResult], camera: int
) -> Iterator[_Reading]:
    if camera == 0:
        return
    poses = np.array([result.scene.cam_from_rig[camera] for result in both])
    turn = rigid3.compose(poses[1], rigid3.inverse(poses[0]))
    turned = np.degrees(rigid3.rotvec_from_quat(turn[:4]))
    against_first = np.array([np.zeros(3), turned])
    yield _several(ROTATION, "xyz", against_first, np.degrees(np.eye(3)))
    lengths = np.linalg.norm(poses[:, 4:], axis=1)
    directions = poses[:, 4:] / lengths[:, None]
    basis = unit_vector.tangent_basis(directions[0])
    turns = np.degrees((directions - directions[0]) @ basis)
    yield _several(DIRECTION, "12", turns, np.degrees(np.eye(2)))
    yield _single(BASELINE, lengths)


def _lens(
    both: tuple[CalibrationResult, CalibrationResult], camera: int
) -> Iterator[_Reading]:
    first, second = (result.scene.cameras[camera].camera for result in both)
    for index, slot in enumerate(param_slots(first.model_name)):
        values = np.array([first.params[index], second.params[index]], dtype=float)
        place = border.FIRST_LENS + slot
        yield _single(lens_parameter(place), values, LENS_NAMES[slot], place)


def _several(parameter: Parameter, axes: str, values: Array, slope: Array) -> _Reading:
    """Numbers of one parameter, in its unit."""
    names = tuple(parameter.part.format(axis) for axis in axes)
    slots = slice(parameter.first, parameter.first + parameter.size)
    unit = parameter.unit.name
    return _Reading(parameter.group, names, unit, values, slots, slope)


def _of_port(parameter: Parameter, ports: Sequence[Port]) -> _Reading:
    values = np.array([port.row[parameter.column] for port in ports])
    return _single(parameter, values)


def _single(
    parameter: Parameter, values: Array, name: str = "", slot: int | None = None
) -> _Reading:
    """One number, or one of a lens.

    Args:
        parameter: that it is of.
        values: (2,) in memory.
        name: of one of several.
        slot: of the same.
    """
    first, unit = parameter.first if slot is None else slot, parameter.unit
    return _Reading(
        parameter.group,
        (name or parameter.name,),
        unit.name,
        unit.per * values[:, None],
        slice(first, first + 1),
        np.array([[unit.per]]),
    )
