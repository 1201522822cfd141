"""What makes images of different exposure and flash alike in colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array

ROUNDS = 10
DARK = 8.0
"""Grey levels below which a ratio is noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenColors:
    """Colours that one image shows of some places."""

    rows: NDArray[np.int64]
    """(n,) places; the same number is the same place in every image."""
    colors: NDArray[np.float32]
    """(n, 3)"""


def balancing_gains(images: Sequence[SeenColors]) -> Array:
    """Factors (I, 3) that make images alike; their geometric mean is one.

    Medians of log ratios to what all images see of the same places: a shadow or a
    highlight in one of them is an outlier.
    """
    count = 1 + max((int(i.rows.max()) for i in images if len(i.rows)), default=0)
    logs = np.zeros((len(images), 3))
    for _ in range(ROUNDS):
        total, number = np.zeros((count, 3)), np.zeros(count)
        for log, image in zip(logs, images, strict=True):
            np.add.at(total, image.rows, _log(image.colors) + log)
            np.add.at(number, image.rows, 1.0)
        shared = number > 1.0
        mean = total / np.maximum(number, 1.0)[:, None]
        for log, image in zip(logs, images, strict=True):
            some = shared[image.rows] & (image.colors.min(axis=1) > DARK)
            if np.any(some):
                ratio = mean[image.rows[some]] - _log(image.colors[some])
                log[:] = np.median(ratio, axis=0)
        logs -= logs.mean(axis=0)
    return np.exp(logs)


def _log(colors: NDArray[np.float32]) -> Array:
    return np.log(np.maximum(colors.astype(np.float64), 1.0))
