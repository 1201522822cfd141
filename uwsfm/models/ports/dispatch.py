"""Kernels that look at the kind of a row and call those of its kind.

One chain of comparisons for each, made of the table of kinds: what a kind does is
called from nowhere else. The chains are not kept on disk by themselves, as numba keys
what it keeps by the source of a function and these have one source for all; the
kernels that call them are kept, and have them inside.
"""

from collections.abc import Callable, Iterable
from importlib import import_module

from uwsfm._base.jit import inner_unsaved
from uwsfm.models.ports.kernels import Kernel, PortKernels
from uwsfm.models.ports.port import KINDS, Port
from uwsfm.models.ports.row import KIND

_Make = Callable[[float, Kernel, Kernel], Kernel]


def kernels_of(kind: type[Port]) -> PortKernels:
    """The compiled functions of a kind of port."""
    kernels: PortKernels = import_module(kind.kernels).KERNELS
    return kernels


def scalar_nouns(ports: Iterable[Port]) -> list[str]:
    """What those ports are called whose kind has no kernels over lanes."""
    kinds = dict.fromkeys(type(port) for port in ports)
    return [kind.noun for kind in kinds if not kernels_of(kind).vectorised]


def _chain(make: _Make, name: str) -> Kernel:
    """The function of the kind of a row; the first kind's of all that share it."""
    chosen = first = getattr(kernels_of(KINDS[0]), name)
    for kind in KINDS[1:]:
        function = getattr(kernels_of(kind), name)
        if function is not first:
            chosen = make(kind.code, function, chosen)
    return chosen


def _of_ray(code: float, function: Kernel, other: Kernel) -> Kernel:
    @inner_unsaved
    def chosen(x, y, z, port):
        if port[KIND] == code:
            return function(x, y, z, port)
        return other(x, y, z, port)

    return chosen


def _of_jac(code: float, function: Kernel, other: Kernel) -> Kernel:
    @inner_unsaved
    def chosen(x, y, z, root, port, lens_rows, jac):
        if port[KIND] == code:
            function(x, y, z, root, port, lens_rows, jac)
        else:
            other(x, y, z, root, port, lens_rows, jac)

    return chosen


def _of_lanes(code: float, function: Kernel, other: Kernel) -> Kernel:
    @inner_unsaved
    def chosen(port, buffer):
        if port[KIND] == code:
            function(port, buffer)
        else:
            other(port, buffer)

    return chosen


port_water_ray = _chain(_of_ray, "water_ray")
port_air_ray = _chain(_of_ray, "air_ray")
port_jac = _chain(_of_jac, "jac")
port_air_lanes = _chain(_of_lanes, "air_lanes")
port_jac_lanes = _chain(_of_lanes, "jac_lanes")
port_ray_lanes = _chain(_of_lanes, "ray_lanes")
