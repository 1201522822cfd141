"""The covariance of a calibration, read from a file beside the rig file.

JSON, or .npz without pickle, with the keys ``names`` (K texts) and ``matrix`` (K, K):
see `uwsfm.calibration.given_accuracy.NamedCovariance`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import read_json
from uwsfm._base.npz import read_npz
from uwsfm.calibration.given_accuracy import NamedCovariance
from uwsfm.errors import InputError

MAX_BYTES = 64 * 2**20
"""Far more than any rig has parameters."""


def read_covariance(path: Path) -> NamedCovariance:
    """Read the covariance of lens parameters and rig poses.

    Raises:
        InputError: there is no such file, it holds something else, or the matrix is no
            covariance; one sentence.
    """
    if path.suffix not in (".json", ".npz"):
        raise InputError(f"{path.name} is neither .json nor .npz")
    read = read_npz if path.suffix == ".npz" else read_json
    try:
        content = read(path, MAX_BYTES)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    try:
        return named_covariance(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def named_covariance(content: Any) -> NamedCovariance:
    """The covariance that a block with ``names`` and ``matrix`` describes.

    Raises:
        InputError: a key is missing, or the matrix is no covariance.
    """
    if not isinstance(content, Mapping) or set(content) != {"names", "matrix"}:
        raise InputError("needs the keys names and matrix, and no others")
    names = [str(name) for name in np.ravel(content["names"])]
    try:
        matrix = np.array(content["matrix"], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError("matrix: must be rows of numbers, all of one length") from None
    if not names:
        raise InputError("names: is empty")
    return NamedCovariance(names=tuple(names), matrix=matrix)
