"""A covariance as a calibration yields it, by the names of its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwsfm.calibration.parameters import DIRECTION, LENS, ROTATION
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals import border

if TYPE_CHECKING:
    from uwsfm.calibration.given_accuracy import GivenCamera


@dataclass(frozen=True, kw_only=True, eq=False)
class NamedCovariance:
    """A covariance as a calibration yields it, with the name of every row.

    Names are CAMERA.PARAMETER: those of the lens model (fx, k1, ...), rotation_x, _y,
    _z (radians, about the axes of that camera) and translation_x, _y, _z (metres).
    """

    names: tuple[str, ...]
    matrix: Array

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        count = len(self.names)
        if len(set(self.names)) < count:
            twice = next(n for n in self.names if self.names.count(n) > 1)
            raise InputError(f"names: {twice!r} is there twice")
        if matrix.shape != (count, count):
            raise InputError(
                f"matrix: must be {count} x {count}, one row for each name, got shape "
                f"{matrix.shape}"
            )
        if not np.all(np.isfinite(matrix)):
            raise InputError("matrix: holds numbers that are not finite")
        spread = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        if not np.all(spread > 0.0):
            name = self.names[int(np.argmin(spread))]
            raise InputError(f"matrix: the variance of {name} is not positive")
        scaled = matrix / np.outer(spread, spread)
        if np.abs(scaled - scaled.T).max() > 1e-6:
            raise InputError("matrix: is not symmetric")
        # Rounded to six digits, a good covariance may come out as -1e-6.
        least = float(np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[0])
        if least < 1e-9:
            raise InputError(
                "matrix: is not positive definite (smallest eigenvalue of the "
                f"correlations {least:.2g})"
            )
        object.__setattr__(self, "matrix", 0.5 * (matrix + matrix.T))


def without_names(named: NamedCovariance, prefix: str) -> NamedCovariance | None:
    """The covariance of the other parameters; None if there are none.

    Args:
        named: a covariance.
        prefix: with which the names begin that are left out.
    """
    rows = [k for k, name in enumerate(named.names) if not name.startswith(prefix)]
    if not rows:
        return None
    return NamedCovariance(
        names=tuple(named.names[k] for k in rows),
        matrix=named.matrix[np.ix_(rows, rows)],
    )


def require_stated_once(
    cameras: Sequence["GivenCamera"], baseline_m: float | None, named: NamedCovariance
) -> None:
    """Refuse an accuracy that is stated singly and in a covariance.

    Args:
        cameras: in the rig's order, with the accuracies that a person stated.
        baseline_m: stated accuracy of the baseline.
        named: the covariance.

    Raises:
        InputError: one of the two has to go.
    """
    onto = steps_of_names(cameras, named.names)
    touched = np.any(onto != 0.0, axis=1).reshape(len(cameras), border.BORDER_SIZE)
    for c, camera in enumerate(cameras):
        for key, slots in _STATED.items():
            if getattr(camera.accuracy, key) is not None and touched[c, slots].any():
                raise InputError(
                    f"camera {camera.name!r}: accuracy.{key} and accuracy.covariance "
                    "state the accuracy of the same numbers: leave one of them out"
                )
    if baseline_m is not None and touched[:, border.LENGTH].any():
        raise InputError(
            "accuracy: the covariance holds the translation, and so the baseline: "
            "leave baseline_m out"
        )


_STATED = {
    each.accuracy.key: each.slots
    for each in (*LENS, ROTATION, DIRECTION)
    if each.accuracy is not None
}
"""Accuracies that a covariance may hold as well, and their slots."""


def steps_of_names(cameras: Sequence["GivenCamera"], names: tuple[str, ...]) -> Array:
    """Derivative (C BORDER_SIZE, K) of the border's steps by named parameters.

    Args:
        cameras: in the rig's order.
        names: K of them, as of `NamedCovariance`.

    Raises:
        InputError: a name is not of this rig, or a translation is not complete.
    """
    by_name = {camera.name: c for c, camera in enumerate(cameras)}
    onto = np.zeros((len(cameras) * border.BORDER_SIZE, len(names)))
    shifts: dict[int, dict[int, int]] = {}
    for k, name in enumerate(names):
        camera_name, _, parameter = name.rpartition(".")
        c = by_name.get(camera_name)
        if c is None:
            raise InputError(
                f"accuracy.covariance: {name!r} is of no camera of this rig; write "
                f"{cameras[0].name}.fx, with the name of a camera"
            )
        first = c * border.BORDER_SIZE
        camera, axis = cameras[c], "xyz".find(parameter[-1:])
        if parameter in camera.param_names:
            slot = camera.slots[camera.param_names.index(parameter)]
            onto[first + border.FIRST_LENS + slot, k] = 1.0
            if slot == 0 and 1 not in camera.slots:
                onto[first + border.FIRST_LENS + 1, k] = 1.0
        elif c > 0 and axis >= 0 and parameter[:-1] == "rotation_":
            onto[first + axis, k] = 1.0
        elif c > 0 and axis >= 0 and parameter[:-1] == "translation_":
            shifts.setdefault(c, {})[axis] = k
        else:
            poses = "" if c == 0 else ", rotation_x to _z, translation_x to _z"
            raise InputError(
                f"accuracy.covariance: {name!r} is no parameter; those of "
                f"{camera.name} are {', '.join(camera.param_names)}{poses}"
            )
    for c, columns in shifts.items():
        if len(columns) < 3 or not np.any(cameras[c].translation):
            raise InputError(
                f"accuracy.covariance: the translation of {cameras[c].name} needs x, "
                "y and z, and cam_from_rig"
            )
        arm = _arm(cameras[c].translation)
        rows = c * border.BORDER_SIZE + np.array([3, 4, border.LENGTH])
        onto[np.ix_(rows, np.array([columns[i] for i in range(3)]))] = np.linalg.inv(
            arm.T
        )
    return onto


def _arm(translation: Array) -> Array:
    """(3, 3) rows: derivative of a translation by direction (2) and length."""
    from uwsfm.solver.state import translation_arm  # compiles kernels

    return translation_arm(np.asarray(translation)).reshape(3, 3)
