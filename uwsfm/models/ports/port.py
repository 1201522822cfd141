"""Ports: the windows between the air of a housing and the water.

Kernels read a port as a row of PORT_SIZE numbers: its `params` in the order that
Refractive COLMAP publishes, then its kind.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

NUM_PARAMS = 8
PORT_SIZE = 9
KIND = 8
"""Where a row has the kind of its port."""
# Floats, as the rows are: numba compiles them as constants.
FLAT, DOME, NONE = 0.0, 1.0, 2.0


def _finite(what: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise InputError(f"{what} must be finite, got {number}")
    return number


def _vector(what: str, values: ArrayLike) -> Array:
    try:
        vector = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{what} must be 3 finite numbers, got {values!r}")
    return vector


class _Window:
    """What flat ports and domes have in common: glass between air and water."""

    _kind: ClassVar[float]
    thickness: float
    n_glass: float
    n_water: float
    n_air: float

    @property
    def _place(self) -> tuple[float, ...]:
        """The four numbers that say where the window is."""
        raise NotImplementedError

    @property
    def params(self) -> Array:
        """(8,): [Nx, Ny, Nz, int_dist, int_thick, na, ng, nw] of a flat port,
        [Cx, Cy, Cz, int_radius, int_thick, na, ng, nw] of a dome."""
        glass = self.thickness, self.n_air, self.n_glass, self.n_water
        return np.array([*self._place, *glass])

    @property
    def row(self) -> Array:
        """(PORT_SIZE,) as kernels read it."""
        return np.append(self.params, self._kind)

    def _set_lengths(self, *names: str) -> None:
        """Check the lengths of a frozen port, and make them floats."""
        for name in names:
            what = f"{type(self).__name__} {name}"
            value = _finite(what, getattr(self, name))
            if value < 0.0:
                raise InputError(f"{what} must not be negative, got {value}")
            object.__setattr__(self, name, value)

    def _set_indices(self) -> None:
        for name in ("n_air", "n_glass", "n_water"):
            what = f"{type(self).__name__} {name}"
            value = _finite(what, getattr(self, name))
            if not 1.0 <= value < 4.0:
                raise InputError(f"{what} must be a refractive index >= 1, got {value}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class FlatPort(_Window):
    """A plane-parallel window, described in the camera frame (metres).

    Raises:
        InputError: a normal that is not unit or points back at the camera, a negative
            distance or thickness, an index outside [1, 4), or anything not finite.
    """

    _kind = FLAT

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector from the camera to the water; (0, 0, 1) is the optical axis."""
    distance: float = 0.02
    """From the projection centre to the inner (air-side) surface, along the normal."""
    thickness: float = 0.01
    """Of the glass."""
    n_glass: float = 1.5
    n_water: float = 1.333
    n_air: float = 1.0

    def __post_init__(self) -> None:
        normal = _vector("FlatPort normal", self.normal)
        length = float(np.linalg.norm(normal))
        if abs(length - 1.0) > 1e-6:
            raise InputError(
                f"FlatPort normal must be a unit vector, got length {length:.6g}"
            )
        if normal[2] <= 0.0:
            raise InputError(
                "FlatPort normal must point from the camera to the water "
                f"(positive z), got {tuple(normal.tolist())}: is its sign flipped?"
            )
        normal = normal / length  # not in place: the array may be the caller's
        object.__setattr__(self, "normal", tuple(float(v) for v in normal))
        self._set_lengths("distance", "thickness")
        self._set_indices()

    @property
    def _place(self) -> tuple[float, ...]:
        return *self.normal, self.distance

    @classmethod
    def from_params(cls, params: ArrayLike) -> "FlatPort":
        """The port of numbers (8,) as in `params`."""
        nx, ny, nz, dist, thick, n_air, n_glass, n_water = _params("FLATPORT", params)
        return cls((nx, ny, nz), dist, thick, n_glass, n_water, n_air)


@dataclass(frozen=True)
class DomePort(_Window):
    """A spherical window around the camera, described in the camera frame (metres).

    Raises:
        InputError: a camera that is not inside the dome, a negative thickness, an index
            outside [1, 4), water or glass thinner than the air, or anything not finite.
    """

    _kind = DOME

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of both spheres. At the origin, which is the projection centre, nothing
    refracts."""
    radius: float = 0.05
    """Of the inner (air-side) surface."""
    thickness: float = 0.007
    """Of the glass."""
    n_glass: float = 1.5
    n_water: float = 1.333
    n_air: float = 1.0

    def __post_init__(self) -> None:
        center = _vector("DomePort center", self.center)
        object.__setattr__(self, "center", tuple(float(v) for v in center))
        self._set_lengths("radius", "thickness")
        offset = float(np.linalg.norm(center))
        if not offset < self.radius:
            raise InputError(
                f"DomePort center is {offset:g} m away from the camera, which is not "
                f"inside a dome of radius {self.radius:g} m then"
            )
        self._set_indices()
        if self.n_water < self.n_air or self.n_glass < self.n_air:
            raise InputError(
                f"DomePort n_water and n_glass must not be below n_air, got "
                f"{self.n_water}, {self.n_glass} and {self.n_air}: the camera is in air"
            )

    @property
    def _place(self) -> tuple[float, ...]:
        return *self.center, self.radius

    @classmethod
    def from_params(cls, params: ArrayLike) -> "DomePort":
        """The port of numbers (8,) as in `params`."""
        cx, cy, cz, radius, thick, n_air, n_glass, n_water = _params("DOMEPORT", params)
        return cls((cx, cy, cz), radius, thick, n_glass, n_water, n_air)


@dataclass(frozen=True)
class NoPort:
    """No window: the lens was calibrated where it is used, or looks through air."""

    @property
    def n_water(self) -> float:
        """Relative to the medium that the lens was calibrated in."""
        return 1.0

    @property
    def n_air(self) -> float:
        """Of that medium itself."""
        return 1.0

    @property
    def row(self) -> Array:
        """(PORT_SIZE,): a flat port without thickness, distance or refraction."""
        return np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, NONE])


Port = FlatPort | DomePort | NoPort


def _params(name: str, params: ArrayLike) -> list[float]:
    numbers = [float(value) for value in np.asarray(params, dtype=np.float64)]
    if len(numbers) != NUM_PARAMS:
        raise InputError(f"a {name} row has {NUM_PARAMS} numbers, got {len(numbers)}")
    return numbers


def port_from_row(row: ArrayLike) -> Port:
    """The port of a row (PORT_SIZE,) of kernels.

    Raises:
        InputError: it is not physical.
    """
    numbers = np.asarray(row, dtype=np.float64)
    if numbers[KIND] == NONE:
        return NoPort()
    kind = DomePort if numbers[KIND] == DOME else FlatPort
    return kind.from_params(numbers[:NUM_PARAMS])
