"""A rig file without one mistake, and which cameras a mistake may concern."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from uwsfm.rig.rig import Rig, RigCamera

CODES = (
    "port_none",
    "port_missing",
    "undistorted",
    "rotation",
    "held_port",
    "rotation_transposed",
    "pose_inverted",
    "quaternion_order",
    "principal_point",
    "focal",
    "resolution",
    "distortion_order",
    "distortion_sign",
    "distortion",
    "fisheye",
    "dome_as_flat",
    "flat_as_dome",
    "folders_swapped",
    "mirrored",
    "frames_shifted",
    "zoom_changed",
    "length_unit",
    "baseline",
    "water_index",
    "translation_sign",
)
"""Names of the mistakes, as in reports."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """A rig without one mistake."""

    code: str
    """Which mistake, one of `CODES`."""
    rig: Rig
    what: str
    """The mistake, a clause that names the cameras."""
    remedy: str
    """What to change in the rig file or the images: an imperative clause."""
    cameras: tuple[int, ...] = ()
    """The cameras that have the mistake; empty: the rig as a whole."""
    exchanged: bool = False
    """The images of the first two cameras change places."""
    flipped: int | None = None
    """Every image is mirrored along this axis: 0 left to right, 1 top to bottom."""


def quoted(rig: Rig, which: tuple[int, ...]) -> str:
    return " and ".join(repr(rig.cameras[c].name) for c in which)


def subsets(rig: Rig, applies: Callable[[RigCamera], bool]) -> list[tuple[int, ...]]:
    """All cameras that a mistake may concern, then each of them alone."""
    every = tuple(c for c, camera in enumerate(rig.cameras) if applies(camera))
    if len(every) < 2:
        return [every] if every else []
    return [every, *((c,) for c in every)]
