"""How the perspective start is made. Defaults were measured on real tank images."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from uwsfm.errors import InputError
from uwsfm.tasks import require_address, require_threads

Matching = Literal["auto", "exhaustive", "sequential"]
Matcher = Literal["colmap", "paper"]
Mapper = Literal["pinhole", "refractive"]

MIN_SUBMAP = 10
"""Frames: of fewer no housing can be told."""
BASE_FEATURES, BASE_PIXELS, MAX_GROWTH = 8192, 2_000_000, 1.5
"""Features of an image of so many pixels, and how many times more a larger one has:
matching takes the square of it."""
MIN_FEATURES = 100
MAX_SEED = 2**31 - 1  # COLMAP takes 32 bits


def thread_count(num_threads: int) -> int:
    """How many threads that is on this machine; -1 means one for each core."""
    return num_threads if num_threads > 0 else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class FeatureOptions:
    """How features are found."""

    clahe: bool = False
    """Equalise contrast locally first: for turbid water."""
    mask_dir: Path | None = None
    """Masks in COLMAP's naming: ``<mask_dir>/left/0001.jpg.png`` for the image
    ``left/0001.jpg``; no features where a mask is black."""
    peak_threshold: float = 0.005
    """Least contrast. COLMAP's 0.0067 finds less than half as many features in water;
    0.003 finds three times more, but noisier ones at three times the cost."""
    max_num_features: int | None = None
    """Per image, about; the largest are kept. Twice as many cost twice the time, and
    make the errors of a housing a third smaller. None: 8192 up to 2 megapixels, as
    COLMAP, and up to 12288 for larger images, with the square root of their size."""
    max_upsampled_px: int = 2_000_000
    """Images of at most so many pixels are searched at twice their size: that finds
    more features, and places them better; larger images have enough without."""
    max_image_size: int = 3200
    """Longer images are reduced for the search; pixels refer to the full image."""

    def num_features(self, width: int, height: int) -> int:
        """How many features an image of so many pixels may have."""
        if self.max_num_features is not None:
            return self.max_num_features
        growth = math.sqrt(width * height / BASE_PIXELS)
        return round(BASE_FEATURES * min(max(growth, 1.0), MAX_GROWTH))

    def __post_init__(self) -> None:
        if self.max_num_features is not None and self.max_num_features < MIN_FEATURES:
            raise InputError(
                f"max_features must be at least {MIN_FEATURES}, got "
                f"{self.max_num_features}: fewer features join no images"
            )
        if self.mask_dir is not None and not Path(self.mask_dir).is_dir():
            raise InputError(f"mask directory {self.mask_dir} does not exist")


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Which images are matched, and how."""

    strategy: Matching = "auto"
    """Exhaustive compares all frames; sequential neighbours, by file name, and frames
    that look alike."""
    max_exhaustive_frames: int = 60
    """Where "auto" changes to sequential: the cost grows with the square."""
    overlap: int = 10
    """Sequential: neighbours on each side; then those 16, 32, ... frames away."""
    num_similar: int = 5
    """Sequential: other frames that look most like a frame, which close loops."""
    matcher: Matcher = "colmap"
    """"colmap": its own, without geometry. "paper": nearest neighbours in kd-trees, and
    a tolerant fundamental matrix: half the wrong matches or fewer, at 3 to 6 times the
    cost, and the same reconstruction in the end."""
    fundamental_max_error_px: float | None = None
    """Of the paper's matcher, in raw pixels. None: a hundredth of the image's longer
    side, because what refraction adds to a fundamental matrix grows with resolution."""

    def __post_init__(self) -> None:
        if self.strategy not in get_args(Matching):
            raise InputError(
                f"matching must be one of {', '.join(get_args(Matching))}, "
                f"got {self.strategy!r}"
            )
        if self.matcher not in get_args(Matcher):
            raise InputError(
                f"matcher must be one of {', '.join(get_args(Matcher))}, "
                f"got {self.matcher!r}"
            )
        if self.overlap < 1 or self.num_similar < 0:
            raise InputError(
                f"overlap must be positive and num_similar not negative, got "
                f"{self.overlap} and {self.num_similar}"
            )
        error_px = self.fundamental_max_error_px
        if error_px is not None and not 0.0 < error_px < math.inf:
            raise InputError(
                f"fundamental_max_error_px must be positive and finite, got {error_px}"
            )
        if error_px is not None and self.matcher != "paper":
            raise InputError(
                "fundamental_max_error_px has no effect: it is a tolerance of the "
                f"paper's matcher, and the matcher is {self.matcher!r}; give "
                "matcher 'paper' (--matcher paper)"
            )


@dataclass(frozen=True, kw_only=True)
class VerificationOptions:
    """Which matches are taken for geometry."""

    max_error_px: float = 4.0
    """In the virtual pinholes, where refraction is undone at the scene's distance."""
    min_num_inliers: int = 15
    max_num_trials: int = 1000
    """Of RANSAC. COLMAP's 10000 finds the same models even at 75 % wrong matches, in
    eleven times the time."""


@dataclass(frozen=True, kw_only=True)
class MappingOptions:
    """How the incremental mapper builds on verified matches."""

    max_error_px: float = 6.0
    """Observations beyond are dropped. Tolerant: what a pinhole explains badly may fit
    the refractive model, which filters again."""
    min_angle_deg: float = 1.5
    """Between the rays of a point."""
    submap_frames: int | None = None
    """Of the refractive mapper: the most frames of a part that is mapped by itself,
    without those it shares with its neighbours. None: 200 if there are more than 400
    frames, else all of them in one piece."""

    def __post_init__(self) -> None:
        if self.submap_frames is not None and self.submap_frames < MIN_SUBMAP:
            raise InputError(
                f"submap_frames must be at least {MIN_SUBMAP}, got {self.submap_frames}"
            )


@dataclass(frozen=True, kw_only=True)
class StartOptions:
    """All options of the perspective start."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    scene_distance_m: float = 1.0
    """Of a single camera, about; two or more measure it. It sets the scale that the
    start begins with, and how large refraction is there."""
    mapper: Mapper = "pinhole"
    """"pinhole": COLMAP's, with pinholes fitted to the ports; "refractive": water rays
    in every step."""
    seed: int = 0
    num_threads: int = -1
    """-1: all cores. COLMAP's mapper takes one, so that it is repeatable."""
    scheduler: str = "local"
    """Who does what can be done in parallel: processes of this machine, or the address
    of a Dask scheduler; see `uwsfm.tasks`."""

    def __post_init__(self) -> None:
        if self.mapper not in get_args(Mapper):
            raise InputError(
                f"mapper must be one of {', '.join(get_args(Mapper))}, "
                f"got {self.mapper!r}"
            )
        if not 0.0 < self.scene_distance_m < math.inf:
            raise InputError(
                "scene_distance_m must be positive and finite, got "
                f"{self.scene_distance_m}"
            )
        require_threads(self.num_threads)
        if not 0 <= self.seed <= MAX_SEED:
            raise InputError(f"seed must be between 0 and {MAX_SEED}, got {self.seed}")
        require_address(self.scheduler)

    @property
    def threads(self) -> int:
        """How many threads that is on this machine."""
        return thread_count(self.num_threads)
