"""How the map is made that the last adjustment starts from.

Defaults were measured on real tank images. What a command takes is made by `option`;
the rest is for Python.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from uwsfm._base.options import Checked, group, option
from uwsfm._base.tasks import LOCAL, require_address, require_threads
from uwsfm.errors import InputError

Matching = Literal["auto", "exhaustive", "sequential"]
Matcher = Literal["colmap", "paper"]
Mapper = Literal["pinhole", "refractive"]

BASE_FEATURES, BASE_PIXELS, MAX_GROWTH = 8192, 2_000_000, 1.5
"""Features of an image of so many pixels, and how many times more a larger one has:
matching takes the square of it."""
MAX_SEED = 2**31 - 1  # COLMAP takes 32 bits


def thread_count(num_threads: int) -> int:
    """How many threads that is on this machine; -1 means one for each core."""
    return num_threads if num_threads > 0 else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class FeatureOptions(Checked):
    """How features are found."""

    clahe: bool = option(
        False,
        help="Raise the local contrast before the search for features, for turbid "
        "water.",
    )
    mask_dir: Path | None = option(
        None,
        name="masks",
        help="Folder of masks as COLMAP names them: left/0001.jpg.png for the image "
        "left/0001.jpg. No features are taken where a mask is black. Default: no "
        "masks.",
    )
    peak_threshold: float = 0.005
    """Least contrast. COLMAP's 0.0067 finds less than half as many features in water;
    0.003 finds three times more, but noisier ones at three times the cost."""
    max_num_features: int | None = option(
        None,
        name="max_features",
        minimum=100,
        because="fewer features join no images",
        help="Number of features per image, about; the largest are kept. Twice as many "
        "take twice the time, and make the errors of a housing a third smaller. "
        "Default: by the size of the images, 8192 up to 2 megapixels, as COLMAP, and "
        "12288 from 4.5.",
    )
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

    def require_masks(self) -> None:
        """Refuse a folder of masks that is not there.

        Raises:
            InputError: it is given and does not exist.
        """
        if self.mask_dir is not None and not Path(self.mask_dir).is_dir():
            raise InputError(f"mask directory {self.mask_dir} does not exist")


@dataclass(frozen=True, kw_only=True)
class MatchOptions(Checked):
    """Which images are matched, and how."""

    strategy: Matching = option(
        "auto",
        name="matching",
        help="Which frames are compared. exhaustive: all with all. sequential: "
        "neighbours by file name, and frames that look alike. auto: exhaustive up to "
        "60 frames, sequential beyond.",
    )
    max_exhaustive_frames: int = 60
    """Where "auto" changes to sequential: the cost grows with the square."""
    overlap: int = 10
    """Sequential: neighbours on each side; then those 16, 32, ... frames away."""
    num_similar: int = 5
    """Sequential: other frames that look most like a frame, which close loops."""
    matcher: Matcher = option(
        "colmap",
        help="How features are matched. colmap: COLMAP's matcher, without geometry. "
        "paper: nearest neighbours in kd-trees and a tolerant fundamental matrix; half "
        "the wrong matches or fewer, in 3 to 6 times the time, and the same result in "
        "the end.",
    )
    fundamental_max_error_px: float | None = option(
        None,
        flag="--fundamental-max-error",
        unit="pixels",
        positive=True,
        help="Tolerance of the fundamental matrix of --matcher paper, in pixels of the "
        "raw images. Default: a hundredth of the image's longer side, as what "
        "refraction adds to the matrix grows with the resolution.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.overlap < 1 or self.num_similar < 0:
            raise InputError(
                f"overlap must be positive and num_similar not negative, got "
                f"{self.overlap} and {self.num_similar}"
            )
        if self.fundamental_max_error_px is not None and self.matcher != "paper":
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
class MappingOptions(Checked):
    """How the incremental mapper builds on verified matches."""

    max_error_px: float = 6.0
    """Observations beyond are dropped. Tolerant: what a pinhole explains badly may fit
    the refractive model, which filters again."""
    min_angle_deg: float = 1.5
    """Between the rays of a point."""
    submap_frames: int | None = option(
        None,
        minimum=10,
        help="Most frames of a submap, without those it shares with its neighbours. "
        "The refractive mapper maps longer surveys in submaps and merges them. "
        "Default: 200 if there are more than 400 frames, else all in one piece.",
    )


@dataclass(frozen=True, kw_only=True)
class StartOptions(Checked):
    """All options from the images to the map that the last adjustment starts from."""

    features: FeatureOptions = group(FeatureOptions, "Features and matches")
    matching: MatchOptions = group(MatchOptions, "Features and matches")
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    mapping: MappingOptions = group(MappingOptions)
    scene_distance_m: float = 1.0
    """Of a single camera, about; two or more measure it. It sets the scale that the
    start begins with, and how large refraction is there."""
    mapper: Mapper = option(
        "refractive",
        help="Which mapper finds the poses that the last adjustment starts from. "
        "refractive: traces water rays in every step, so that near scenes and tilted "
        "ports fit from the beginning. pinhole: COLMAP's mapper with pinholes fitted "
        "to the ports; water rays enter in the last adjustment only. calibrate begins "
        "with pinhole, as the 2011 paper does; reconstruct begins with refractive.",
    )
    seed: int = option(
        0,
        minimum=0,
        maximum=MAX_SEED,
        help="Seed of the random number generator. The same seed gives the same "
        "result.",
    )
    num_threads: int = option(
        -1,
        flag="--threads",
        minimum=-1,
        per_dive=False,
        help="Number of threads or processes that work at once. -1: one for each core.",
    )
    scheduler: str = option(
        LOCAL,
        metavar="local|tcp://HOST:PORT",
        per_dive=False,
        help="Where parallel work is done. local: in processes of this machine. An "
        "address: by the workers of the Dask scheduler there, on which all folders "
        "have the same paths as here.",
    )

    def __post_init__(self) -> None:
        require_threads(self.num_threads)
        super().__post_init__()
        if not 0.0 < self.scene_distance_m < math.inf:
            raise InputError(
                "scene_distance_m must be positive and finite, got "
                f"{self.scene_distance_m}"
            )
        require_address(self.scheduler)

    @property
    def threads(self) -> int:
        """How many threads that is on this machine."""
        return thread_count(self.num_threads)
