"""The flat port: a plane-parallel window between the air of a housing and the water."""

from dataclasses import dataclass

from numpy.typing import ArrayLike

from uwsfm.models.ports.kind import PlanePort, eight


@dataclass(frozen=True)
class FlatPort(PlanePort):
    """A plane-parallel window, described in the camera frame (metres).

    Raises:
        InputError: a normal that is not unit or points back at the camera, a negative
            distance or thickness, an index outside [1, 4), or anything not finite.
    """

    code = 0.0
    word = "flat"
    noun = "flat port"
    numbers = ("normal", "distance", "thickness", "n_glass")
    colmap_name = "FLATPORT"
    kernels = "uwsfm.models.ports.flat_lanes"

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
        self._set_normal()
        self._set_lengths("distance", "thickness")
        self._set_indices("n_air", "n_glass", "n_water")

    @classmethod
    def from_params(cls, params: ArrayLike) -> "FlatPort":
        """The port of numbers (8,) as in `params`."""
        nx, ny, nz, dist, thick, n_air, n_glass, n_water = eight("FLATPORT", params)
        return cls((nx, ny, nz), dist, thick, n_glass, n_water, n_air)
