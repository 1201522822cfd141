"""Ports: what is between the air of a housing and the water. The table of their kinds.

A kind is one line here: see `uwsfm.models.ports.kind` for what it says of itself.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.dome_port import DomePort
from uwsfm.models.ports.flat_port import FlatPort
from uwsfm.models.ports.interface_port import InterfacePort
from uwsfm.models.ports.kind import PlanePort, Port
from uwsfm.models.ports.no_port import NoPort
from uwsfm.models.ports.row import DISTANCE, KIND, NUM_PARAMS, PORT_SIZE

__all__ = ["KINDS", "DomePort", "FlatPort", "InterfacePort", "NoPort", "PlanePort"]
__all__ += ["Port", "behind_camera", "kind_of_row", "kind_of_word", "port_from_row"]
__all__ += ["rows_with"]

KINDS: tuple[type[Port], ...] = (
    FlatPort,
    DomePort,
    NoPort,
    InterfacePort,
)
"""All kinds of ports, in the order in which files and messages name them."""


def _words(kinds: tuple[type[Port], ...]) -> str:
    names = [kind.word for kind in kinds]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def kind_of_word(word: str) -> type[Port]:
    """The kind of a ``type`` in a file.

    Raises:
        InputError: there is none.
    """
    for kind in KINDS:
        if kind.word == word:
            return kind
    raise InputError(f"{word!r} is no kind of port; the kinds are {_words(KINDS)}")


def kind_of_row(row: ArrayLike) -> type[Port]:
    """The kind of a row (PORT_SIZE,) of kernels.

    Raises:
        InputError: there is none.
    """
    numbers = np.asarray(row, dtype=np.float64)
    if numbers.shape != (PORT_SIZE,):
        raise InputError(
            f"the row of a port has {PORT_SIZE} numbers, got {numbers.size}"
        )
    for kind in KINDS:
        if kind.code == numbers[KIND]:
            return kind
    codes = ", ".join(f"{kind.code:g} ({kind.word})" for kind in KINDS)
    raise InputError(
        f"{numbers[KIND]:g} is no kind of port in a row; the kinds are {codes}"
    )


def port_from_row(row: ArrayLike) -> Port:
    """The port of a row (PORT_SIZE,) of kernels.

    Raises:
        InputError: it is of no kind, or not physical.
    """
    numbers = np.asarray(row, dtype=np.float64)
    return kind_of_row(numbers).from_params(numbers[:NUM_PARAMS])


def rows_with(rows: Array, name: str) -> NDArray[np.bool_]:
    """Mask (C,) of the rows (C, PORT_SIZE) whose ports have a number, as "distance"."""
    return np.isin(rows[:, KIND], [kind.code for kind in KINDS if kind.has(name)])


def behind_camera(rows: Array) -> NDArray[np.bool_]:
    """Mask (C,) of the planes whose distance is negative: no port has such a one."""
    return rows_with(rows, "distance") & (rows[:, DISTANCE] < 0.0)
