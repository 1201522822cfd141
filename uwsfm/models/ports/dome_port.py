"""The dome: a spherical window around the camera."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.kind import Port, eight, vector
from uwsfm.models.ports.row import AXIS, RADIUS


@dataclass(frozen=True)
class DomePort(Port):
    """A spherical window around the camera, described in the camera frame (metres).

    Raises:
        InputError: a camera that is not inside the dome, a negative thickness, an index
            outside [1, 4), water or glass thinner than the air, or anything not finite.
    """

    code = 1.0
    word = "dome"
    noun = "dome"
    numbers = ("center", "radius", "thickness", "n_glass")
    refinable = ("center",)
    guess = ", domes assumed centred\non their cameras"
    colmap_name = "DOMEPORT"
    kernels = "uwsfm.models.ports.dome_lanes"

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
        center = vector("DomePort center", self.center)
        object.__setattr__(self, "center", tuple(float(v) for v in center))
        self._set_lengths("radius", "thickness")
        offset = float(np.linalg.norm(center))
        if not offset < self.radius:
            raise InputError(
                f"DomePort center is {offset:g} m away from the camera, which is not "
                f"inside a dome of radius {self.radius:g} m then"
            )
        self._set_indices("n_air", "n_glass", "n_water")
        if self.n_water < self.n_air or self.n_glass < self.n_air:
            raise InputError(
                f"DomePort n_water and n_glass must not be below n_air, got "
                f"{self.n_water}, {self.n_glass} and {self.n_air}: the camera is in air"
            )

    @property
    def place(self) -> tuple[float, ...]:
        return *self.center, self.radius

    @classmethod
    def from_params(cls, params: ArrayLike) -> "DomePort":
        """The port of numbers (8,) as in `params`."""
        cx, cy, cz, radius, thick, n_air, n_glass, n_water = eight("DOMEPORT", params)
        return cls((cx, cy, cz), radius, thick, n_glass, n_water, n_air)

    @classmethod
    def plus(cls, place: Array, step: Array) -> Array:
        return place + step

    @classmethod
    def minus(cls, place: Array, other: Array) -> Array:
        return place - other

    @classmethod
    def departed(cls, row: Array, camera: str) -> str:
        offset = float(np.linalg.norm(row[AXIS]))
        if offset < row[RADIUS]:
            return ""
        return (
            f"the dome of {camera} moved away, to a centre {offset:.3f} m from the "
            f"camera at a radius of {row[RADIUS]:.3f} m: the start is too far off, or "
            "the images do not determine the centre"
        )
