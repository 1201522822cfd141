"""Ports: the windows between the air of a housing and the water."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

PORT_SIZE = 8


def _finite(name: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"FlatPort {name} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise InputError(f"FlatPort {name} must be finite, got {number}")
    return number


@dataclass(frozen=True)
class FlatPort:
    """A plane-parallel window, described in the camera frame (metres).

    Raises:
        InputError: a normal that is not unit or points back at the camera, a negative
            distance or thickness, an index outside [1, 4), or anything not finite.
    """

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
        try:
            normal = np.asarray(self.normal, dtype=np.float64)
        except (TypeError, ValueError):
            normal = np.empty(0)
        if normal.shape != (3,) or not np.all(np.isfinite(normal)):
            raise InputError(
                f"FlatPort normal must be 3 finite numbers, got {self.normal}"
            )
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
        for name in ("distance", "thickness"):
            value = _finite(name, getattr(self, name))
            if value < 0.0:
                raise InputError(f"FlatPort {name} must not be negative, got {value}")
            object.__setattr__(self, name, value)
        for name in ("n_air", "n_glass", "n_water"):
            value = _finite(name, getattr(self, name))
            if not 1.0 <= value < 4.0:
                raise InputError(
                    f"FlatPort {name} must be a refractive index >= 1, got {value}"
                )
            object.__setattr__(self, name, value)

    @property
    def params(self) -> Array:
        """Row (8,): [Nx, Ny, Nz, int_dist, int_thick, na, ng, nw]."""
        return np.array(
            [
                *self.normal,
                self.distance,
                self.thickness,
                self.n_air,
                self.n_glass,
                self.n_water,
            ]
        )

    @classmethod
    def from_params(cls, params: ArrayLike) -> "FlatPort":
        """The port of a row (8,) as in `params`."""
        row = [float(value) for value in np.asarray(params, dtype=np.float64)]
        if len(row) != PORT_SIZE:
            raise InputError(f"a FLATPORT row has {PORT_SIZE} numbers, got {len(row)}")
        nx, ny, nz, dist, thick, n_air, n_glass, n_water = row
        return cls((nx, ny, nz), dist, thick, n_glass, n_water, n_air)
