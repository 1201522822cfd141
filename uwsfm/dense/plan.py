"""What a run will take, decided before the first image is read.

Memory is shared out once: so many images at a time while depth maps are made, so many
while they are fused, depth maps that are kept, and voxels. What is too little is known
now, and not after minutes.
"""

from __future__ import annotations

from dataclasses import dataclass

from uwsfm.errors import InputError

PLACED_BYTES = 40
"""Per pixel of a depth map in memory, with its points and normals."""
FUSE_BYTES, FUSE_PIXELS = 450, 100_000
"""Per pixel while it is fused, beside the maps it is compared with, about; and pixels
that are fused at once."""
STORE_SHARE, FUSE_SHARE = 0.25, 0.25
"""Of the memory, for depth maps that are kept and for those being fused; the rest is
for voxels."""
MONO_SECONDS, STEREO_SECONDS, FUSE_SECONDS = 19.0, 4.0, 3.0
"""Of one core, per megapixel of a depth map, about: what is told before it begins."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How a run shares out time and memory."""

    num_maps: int
    megapixels: float
    """Of the largest depth map."""
    matchers: int
    """Depth maps that are made at a time."""
    match_bytes: float
    """For each of them."""
    fusers: int
    """Depth maps that are fused at a time."""
    store_bytes: float
    """For depth maps that are kept."""
    voxel_bytes: float
    seconds: float
    """About."""
    peak_bytes: float
    """At most, of the whole process."""

    def __str__(self) -> str:
        minutes = max(1, round(self.seconds / 60.0))
        images = "depth map" if self.num_maps == 1 else "depth maps"
        return (
            f"{self.num_maps} {images}, {self.megapixels:.1f} Mpx each: about "
            f"{minutes} {'minute' if minutes == 1 else 'minutes'}, up to "
            f"{self.peak_bytes / 1e9:.1f} GB, {self.matchers} at a time"
        )


@dataclass(frozen=True, kw_only=True)
class Load:
    """What there is to do."""

    pixels: list[int]
    """Of each depth map."""
    map_bytes: float
    """To make the one that needs most, at least."""
    is_stereo: bool
    neighbours: int
    """Depth maps that each one is compared with."""


def fused_bytes(pixels: int, compared: int) -> float:
    """What it takes to fuse a depth map, a band at a time.

    Args:
        pixels: of it.
        compared: depth maps that it is compared with.
    """
    return band_bytes(pixels) + compared_bytes(pixels, compared)


def band_bytes(pixels: int) -> float:
    """Of the rows that are fused at once."""
    return float(FUSE_BYTES * min(pixels, FUSE_PIXELS))


def compared_bytes(pixels: int, compared: int) -> float:
    """Of a depth map and those that it is compared with."""
    return float(PLACED_BYTES * (1 + compared) * pixels)


def plan(load: Load, max_memory: float, used: float, threads: int) -> Plan:
    """Share out what there is.

    Args:
        load: what there is to do.
        max_memory: bytes of the whole process.
        used: bytes that it has already.
        threads: at most so many at a time.

    Raises:
        InputError: the memory is too little for one at a time.
    """
    room = max_memory - used
    largest = max(load.pixels)
    compared = min(load.neighbours, len(load.pixels) - 1)
    fuse = fused_bytes(largest, compared)
    needed = max(load.map_bytes, fuse / (1.0 - STORE_SHARE))
    if room < needed:
        raise InputError(
            f"--max-memory {max_memory / 1e9:.2f}GB is too little for images of this "
            f"size: they need {(used + needed) / 1e9:.2f}GB"
        )
    matchers = max(1, min(threads, len(load.pixels), int(room / load.map_bytes)))
    fusers = max(1, min(threads, len(load.pixels), int(FUSE_SHARE * room / fuse)))
    store = STORE_SHARE * room
    each = STEREO_SECONDS if load.is_stereo else MONO_SECONDS
    megapixels = sum(load.pixels) / 1e6
    # Those that are compared are among those that are kept, as far as these reach.
    beyond = max(fusers * compared_bytes(largest, compared) - store, 0.0)
    fusing = fusers * band_bytes(largest) + beyond
    return Plan(
        num_maps=len(load.pixels),
        megapixels=largest / 1e6,
        matchers=matchers,
        match_bytes=room / matchers,
        fusers=fusers,
        store_bytes=store,
        voxel_bytes=max(room - store - fusing, 0.1 * room),
        seconds=megapixels * (each / matchers + FUSE_SECONDS / fusers),
        peak_bytes=max_memory,
    )
