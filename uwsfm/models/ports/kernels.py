"""What the kernels of a kind of port are, and those of a kind without lanes."""

from collections.abc import Callable
from typing import Any, NamedTuple

from uwsfm._base.jit import inner
from uwsfm.models.lanes import BLOCK, OK, STRIDE

Kernel = Callable[..., Any]


@inner
def no_lanes(port, buffer):
    """No lane is OK: the scalar kernels do them all."""
    for i in range(BLOCK):
        buffer[OK * STRIDE + i] = 0.0


class PortKernels(NamedTuple):
    """The compiled functions of a kind; every row that they get is of it."""

    water_ray: Kernel
    """(dx, dy, dz, port) -> (status, origin (3), direction in water (3))."""
    air_ray: Kernel
    """(x, y, z, port) -> (status, root of its equation, ray in air (3))."""
    jac: Kernel
    """(x, y, z, root, port, lens_rows, jac): writes (2, JAC_SIZE)."""
    air_lanes: Kernel = no_lanes
    """(port, buffer): `air_ray` over lanes; so the next."""
    jac_lanes: Kernel = no_lanes
    ray_lanes: Kernel = no_lanes
    """`water_ray` over lanes."""

    @property
    def vectorised(self) -> bool:
        """Whether lanes are more than a detour to the scalar kernels."""
        return self.air_lanes is not no_lanes
