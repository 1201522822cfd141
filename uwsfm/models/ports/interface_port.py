"""The interface: one plane between air and water, without glass.

A camera in the air above a calm surface that looks down, or a housing whose window is
a film of no optical effect.
"""

from dataclasses import dataclass

from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.kind import PlanePort, eight
from uwsfm.models.ports.row import N_GLASS, N_WATER, THICKNESS


@dataclass(frozen=True)
class InterfacePort(PlanePort):
    """A plane between air and water, described in the camera frame (metres).

    Refractive COLMAP has no such port: it is written as a flat one of no thickness,
    whose glass has the index of the water, and such a one is read as this.

    Raises:
        InputError: a normal that is not unit or points back at the camera, a negative
            distance, an index outside [1, 4), or anything not finite.
    """

    code = 3.0
    word = "interface"
    noun = "interface of air and water"
    numbers = ("normal", "distance")
    colmap_name = "FLATPORT"
    kernels = "uwsfm.models.ports.interface"
    max_distance_m = 100.0

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector from the camera to the water; (0, 0, 1) is the optical axis."""
    distance: float = 0.02
    """From the projection centre to the surface, along the normal."""
    n_water: float = 1.333
    n_air: float = 1.0

    def __post_init__(self) -> None:
        self._set_normal()
        self._set_lengths("distance")
        self._set_indices("n_air", "n_water")

    @classmethod
    def from_params(cls, params: ArrayLike) -> "InterfacePort":
        """The port of numbers (8,) as in `params`: no glass is what they must have."""
        nx, ny, nz, dist, thick, n_air, _, n_water = eight("FLATPORT", params)
        if thick != 0.0:
            raise InputError(f"an interface has no glass, got {thick:g} m of it")
        return cls((nx, ny, nz), dist, n_water, n_air)

    @classmethod
    def reads(cls, params: Array) -> bool:
        """Whether there is no glass."""
        return bool(params[THICKNESS] == 0.0 and params[N_GLASS] == params[N_WATER])
