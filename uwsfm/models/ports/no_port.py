"""No port: nothing refracts."""

from dataclasses import dataclass

from numpy.typing import ArrayLike

from uwsfm.models.ports.kind import Port


@dataclass(frozen=True)
class NoPort(Port):
    """No window: the lens was calibrated where it is used, or looks through air."""

    code = 2.0
    word = "none"
    noun = "no port"
    numbers = ()
    refracts = False
    kernels = "uwsfm.models.ports.flat_lanes"

    @property
    def n_water(self) -> float:
        """Relative to the medium that the lens was calibrated in."""
        return 1.0

    @property
    def n_air(self) -> float:
        """Of that medium itself."""
        return 1.0

    @property
    def place(self) -> tuple[float, ...]:
        """Of a flat port without distance: its kernels refract nothing then."""
        return 0.0, 0.0, 1.0, 0.0

    @classmethod
    def of_numbers(cls, numbers: object, n_water: float) -> "NoPort":
        return cls()

    @classmethod
    def from_params(cls, params: ArrayLike) -> "NoPort":
        return cls()
