"""A kind of port, as everything else reads it.

A kind is a class that says which numbers a port has, which of them the images may
refine, how a step moves them and what it is called; its kernels are in a module of
their own, which is loaded with numba only when something is computed. The kinds are
listed once, in `uwsfm.models.ports.port.KINDS`.
"""

import math
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.row import DISTANCE, NUM_PARAMS, NZ, PORT_SIZE

FILE_KEYS = {
    "normal": "normal",
    "distance": "distance_m",
    "center": "center_m",
    "radius": "radius_m",
    "thickness": "thickness_m",
    "n_glass": "glass_index",
}
"""The key of each number of a port, in rig files, truth.json and summaries."""

_Kind = TypeVar("_Kind", bound="Port")


class Port:
    """What kinds of ports have in common; see the module for what a kind is."""

    code: ClassVar[float]
    """In rows, unlike any other kind's. A float, as rows are."""
    word: ClassVar[str]
    """The ``type`` in rig files, truth.json and summaries."""
    noun: ClassVar[str]
    """In sentences."""
    numbers: ClassVar[tuple[str, ...]]
    """Keys of `FILE_KEYS`: the fields that a rig file states, in its order."""
    refinable: ClassVar[tuple[str, ...]] = ()
    """Those that the images may refine."""
    max_distance_m: ClassVar[float] = 0.5
    """From the camera: more is another unit, or no port of this kind."""
    refracts: ClassVar[bool] = True
    magnifies: ClassVar[bool] = False
    """Whether what is in the water looks nearer by its index, as behind a plane."""
    guess: ClassVar[str] = ""
    """What `uwsfm.simulate.rigs.rough_port` makes of it, after "lenses and camera
    placement calibrated in air"."""
    colmap_name: ClassVar[str | None] = None
    """In the text models of Refractive COLMAP; None: nothing is written."""
    kernels: ClassVar[str]
    """The module that has its ``KERNELS``, see `uwsfm.models.ports.dispatch`."""

    @property
    def n_air(self) -> float:
        raise NotImplementedError

    @property
    def n_water(self) -> float:
        raise NotImplementedError

    @property
    def thickness(self) -> float:
        """Of the glass, metres."""
        return 0.0

    @property
    def n_glass(self) -> float:
        """Without glass, that of the water."""
        return self.n_water

    @property
    def place(self) -> tuple[float, ...]:
        """The four numbers of a row that say where the port is."""
        raise NotImplementedError

    @property
    def params(self) -> Array:
        """(8,) in the published order, see `uwsfm.models.ports.row`."""
        indices = self.n_air, self.n_glass, self.n_water
        return np.array([*self.place, self.thickness, *indices])

    @property
    def row(self) -> Array:
        """(PORT_SIZE,) as kernels read it."""
        row = np.empty(PORT_SIZE)
        row[:NUM_PARAMS], row[NUM_PARAMS] = self.params, self.code
        return row

    def stated(self) -> dict[str, Any]:
        """Its numbers by the keys of files, lists and floats."""
        values = {name: getattr(self, name) for name in self.numbers}
        return {
            FILE_KEYS[name]: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
        }

    def changed(self: _Kind, **values: Any) -> _Kind:
        """The same port with other fields: every kind that has any is a dataclass."""
        return replace(self, **values)  # type: ignore[type-var]

    def in_air(self) -> "Port":
        """The same port with indices relative to that of the air: only those have a
        meaning."""
        if not self.refracts:
            return self
        indices = {"n_air": 1.0, "n_water": self.n_water / self.n_air}
        if self.has("n_glass"):
            indices["n_glass"] = self.n_glass / self.n_air
        return self.changed(**indices)

    @classmethod
    def of_numbers(cls, numbers: dict[str, Any], n_water: float) -> "Port":
        """The port of its numbers, by the names of `FILE_KEYS`, in air inside."""
        return cls(**numbers, n_water=n_water)  # type: ignore[call-arg]

    @classmethod
    def from_params(cls, params: ArrayLike) -> "Port":
        """The port of numbers (8,) as in `params`."""
        raise NotImplementedError

    @classmethod
    def has(cls, name: str) -> bool:
        """Whether a port of this kind has a number, as "distance": one that rig files
        state, or "n_water", which the rig has for all that refract."""
        return name in cls.numbers or (name == "n_water" and cls.refracts)

    @classmethod
    def reads(cls, params: Array) -> bool:
        """Whether numbers (8,) under its ``colmap_name`` are those of this kind."""
        return True

    @classmethod
    def plus(cls, place: Array, step: Array) -> Array:
        """Move the first four numbers (4,) of a row.

        Args:
            place: (4,)
            step: (4,) in the units of the Jacobian's columns: normal (2, tangent) and
                distance or centre (3), then the radius; see `projection.JAC_SIZE`.
        """
        return place

    @classmethod
    def minus(cls, place: Array, other: Array) -> Array:
        """How far this place is from another, as a step (4,) of `plus` at this one: the
        step that leads to the other, negative."""
        return np.zeros(4)

    @classmethod
    def departed(cls, row: Array, camera: str) -> str:
        """What is wrong with where an adjustment took a port, a sentence; "": nothing.

        Args:
            row: (PORT_SIZE,)
            camera: whose it is, in words.
        """
        return ""

    def _set_lengths(self, *names: str) -> None:
        """Check the lengths of a frozen port, and make them floats."""
        for name in names:
            what = f"{type(self).__name__} {name}"
            value = finite(what, getattr(self, name))
            if value < 0.0:
                raise InputError(f"{what} must not be negative, got {value}")
            object.__setattr__(self, name, value)

    def _set_indices(self, *names: str) -> None:
        for name in names:
            what = f"{type(self).__name__} {name}"
            value = finite(what, getattr(self, name))
            if not 1.0 <= value < 4.0:
                raise InputError(f"{what} must be a refractive index >= 1, got {value}")
            object.__setattr__(self, name, value)


class PlanePort(Port):
    """What ports have in common whose surfaces are planes: all but the glass."""

    magnifies = True
    refinable = ("normal", "distance")
    guess = ", ports assumed straight and at half\ntheir true distance"

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit vector from the camera to the water; (0, 0, 1) is the optical axis."""
        raise NotImplementedError

    @property
    def distance(self) -> float:
        """From the projection centre to the inner surface, along the normal, metres."""
        raise NotImplementedError

    @property
    def place(self) -> tuple[float, ...]:
        return *self.normal, self.distance

    @classmethod
    def plus(cls, place: Array, step: Array) -> Array:
        from uwsfm.geometry import unit_vector  # compiles kernels: not for init

        return np.append(unit_vector.plus(place[:3], step[:2]), place[3] + step[2])

    @classmethod
    def minus(cls, place: Array, other: Array) -> Array:
        from uwsfm.geometry import unit_vector  # compiles kernels: not for init

        turn = -unit_vector.minus(other[:3], place[:3])
        return np.array([*turn, place[3] - other[3], 0.0])

    @classmethod
    def departed(cls, row: Array, camera: str) -> str:
        if row[NZ] > 0.0:
            return ""
        x, y, z = row[:DISTANCE]
        return (
            f"the port normal of {camera} turned away from the water, to "
            f"({x:.3f}, {y:.3f}, {z:.3f}): the start is too far off or cam_from_rig is "
            "wrong"
        )

    def _set_normal(self) -> None:
        """Check the normal of a frozen port, and make it unit to rounding."""
        kind = type(self).__name__
        normal = vector(f"{kind} normal", self.normal)
        length = float(np.linalg.norm(normal))
        if abs(length - 1.0) > 1e-6:
            raise InputError(
                f"{kind} normal must be a unit vector, got length {length:.6g}"
            )
        if normal[2] <= 0.0:
            raise InputError(
                f"{kind} normal must point from the camera to the water "
                f"(positive z), got {tuple(normal.tolist())}: is its sign flipped?"
            )
        normal = normal / length  # not in place: the array may be the caller's
        object.__setattr__(self, "normal", tuple(float(v) for v in normal))


def finite(what: str, value: float) -> float:
    """A number that is one.

    Raises:
        InputError: it is not.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise InputError(f"{what} must be finite, got {number}")
    return number


def vector(what: str, values: ArrayLike) -> Array:
    """Three numbers that are finite.

    Raises:
        InputError: they are not.
    """
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers)):
        raise InputError(f"{what} must be 3 finite numbers, got {values!r}")
    return numbers


def eight(name: str, params: ArrayLike) -> list[float]:
    """The parameters of a port in the published order.

    Raises:
        InputError: there are more, or fewer.
    """
    numbers = [float(value) for value in np.asarray(params, dtype=np.float64)]
    if len(numbers) != NUM_PARAMS:
        raise InputError(f"a {name} row has {NUM_PARAMS} numbers, got {len(numbers)}")
    return numbers
