"""How a dense cloud is made."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from uwsfm._base.tasks import require_threads
from uwsfm.errors import InputError

ASSUMED_NOISE_PX = 0.3
"""Of a disparity, where too few depth maps overlap to tell."""
MAX_PIXELS = {"high": 2.4e6, "medium": 0.6e6, "low": 0.15e6}
"""That images are reduced to for PatchMatch: half of a GoPro's, a quarter of it each
way, and so on. Finer than the water is clear, pixels cost time and bring noise."""
MAX_STEREO_PIXELS = {"high": 12e6, "medium": 2.4e6, "low": 0.6e6}
"""The same of pairs in rectified images, which take a tenth of the time."""
MATCHERS = ("auto", "stereo", "patchmatch")
_UNITS = {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9}


@dataclass(frozen=True, kw_only=True)
class DenseOptions:
    """Raises InputError: a value out of its range."""

    min_views: int = 2
    """Depth maps that have to agree on a point."""
    keep_single: bool = False
    """Keep also what one depth map alone sees, with num_views 1."""
    voxel: float | None = None
    """Side of the voxels that points are merged in, in the unit of the model; None: the
    footprint of a pixel at the median distance."""
    noise_px: float | None = None
    """Standard deviation of a disparity; None: from the differences between depth
    maps."""
    max_neighbours: int = 8
    """Depth maps that each one is compared with."""
    quality: str = "medium"
    """high, medium or low: how far large images are reduced."""
    matcher: str = "auto"
    """stereo: pairs of cameras in rectified images. patchmatch: every image with six
    others of any camera and frame. auto: stereo where cameras can be rectified."""
    max_memory: float = 2e9
    """Bytes that the whole process may use."""
    num_threads: int = -1
    """-1: all cores."""

    def __post_init__(self) -> None:
        if self.min_views < 1:
            raise InputError(f"--min-views must be at least 1, got {self.min_views}")
        if self.max_neighbours < 1:
            raise InputError(
                f"max_neighbours must be at least 1, got {self.max_neighbours}"
            )
        if self.quality not in MAX_PIXELS:
            known = ", ".join(MAX_PIXELS)
            raise InputError(f"--quality must be one of {known}, got {self.quality!r}")
        if self.matcher not in MATCHERS:
            known = ", ".join(MATCHERS)
            raise InputError(f"--matcher must be one of {known}, got {self.matcher!r}")
        for name in ("voxel", "noise_px", "max_memory"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option} must be positive and finite, got {value}")
        require_threads(self.num_threads)


def bytes_of(text: str) -> float:
    """Bytes of a size as 2GB, 500M or 1.5e9.

    Raises:
        InputError: it is no size.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([KMG]?)B?\s*", text, re.I)
    try:
        return float(match[1]) * _UNITS[match[2].upper()]  # type: ignore[index]
    except (TypeError, ValueError):
        raise InputError(f"{text!r} is no size: write 2GB or 500MB") from None
