"""Which images belong together, and which masks they have."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from uwsfm._base.paths import check_image_names
from uwsfm.errors import InputError
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.pixels import read_gray, value_range

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"})
MIN_FRAMES = 2


@dataclass(frozen=True, kw_only=True)
class Frames:
    """The frames of a dive: file names that one camera's folder or more holds."""

    image_dir: Path
    folders: tuple[str, ...]
    """Sub-folder of each camera (C), in the order of the rig."""
    names: tuple[str, ...]
    """File name of each frame (F), in natural order: frame2 before frame10."""
    absent: frozenset[str] = frozenset()
    """Images "folder/name" that are not there, though another camera has theirs."""

    def image_name(self, camera_idx: int, frame_idx: int) -> str:
        """An image as the COLMAP database knows it: "folder/name"."""
        return f"{self.folders[camera_idx]}/{self.names[frame_idx]}"

    def has_image(self, camera_idx: int, frame_idx: int) -> bool:
        """Whether a frame has an image of a camera."""
        if not self.absent:  # no name is made for each of many pairs
            return True
        return self.image_name(camera_idx, frame_idx) not in self.absent

    def places(self) -> Iterator[tuple[int, int]]:
        """Camera and frame index of all images that are there, frame by frame."""
        for f in range(len(self.names)):
            for c in range(len(self.folders)):
                if self.has_image(c, f):
                    yield c, f

    def image_names(self) -> Iterator[str]:
        """All images that are there, frame by frame."""
        for c, f in self.places():
            yield self.image_name(c, f)

    @property
    def num_images(self) -> int:
        """Images that are there."""
        return sum(1 for _ in self.places())

    def warnings(self) -> list[str]:
        """What the user should know, one sentence each."""
        if not self.absent:
            return []
        absent = sorted(self.absent, key=natural_key)
        first = f"{self.image_dir / absent[0]} does not exist{self._suffix_hint()}"
        rest = "its frame is used with the images that it has"
        if len(absent) == 1:
            return [f"image {first}: {rest}"]
        return [
            f"{len(absent)} images are missing, for instance {first}: each of their "
            f"frames is used with the images that it has"
        ]

    def _suffix_hint(self) -> str:
        """A word on images that would belong together but for their suffix, or ''."""
        of_stem: dict[str, set[str]] = {}
        for c, f in self.places():
            name = self.image_name(c, f)
            of_stem.setdefault(PurePosixPath(name).stem, set()).add(name)
        for missing in sorted(self.absent, key=natural_key):
            path = PurePosixPath(missing)
            for other in sorted(of_stem.get(path.stem, ())):
                if PurePosixPath(other).parent == path.parent:
                    return (
                        f", but {other} does (images of one frame must have equal "
                        "names, with equal suffixes)"
                    )
        return ""

    def fingerprint(self) -> list[Any]:
        """Names, sizes and times of the images, whichever camera comes first."""
        stats = {n: (self.image_dir / n).stat() for n in sorted(self.image_names())}
        return [[n, stat.st_size, stat.st_mtime_ns] for n, stat in stats.items()]


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts "frame10" after "frame2"; the name itself breaks ties."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts], name


def find_frames(image_dir: Path, rig: Rig, min_num_frames: int = MIN_FRAMES) -> Frames:
    """Pair the images of the rig's folders by equal file name.

    A frame may lack the images of some cameras; ``min_num_frames`` must have all.

    Raises:
        InputError: a folder that is missing or holds no image, no common name, fewer
            complete frames than ``min_num_frames``, a file name that contains white
            space, or a file that is empty.
    """
    image_dir = Path(image_dir)
    if not image_dir.is_dir():
        what = "is not a folder" if image_dir.exists() else "does not exist"
        raise InputError(f"image directory {image_dir} {what}")
    found = {c.images: _images_of(image_dir, c.images, c.name) for c in rig.cameras}
    common = set.intersection(*found.values())
    if not common:
        first, second = list(found)[:2]
        raise InputError(
            f"no image name is common to the folders of {image_dir}: "
            f"{first} has {min(found[first])}, {second} has {min(found[second])}; "
            f"images of one frame must have equal names{_equal_but(found)}"
        )
    if len(common) < min_num_frames:
        raise InputError(
            f"only one frame ({common.pop()}) has an image of every camera in "
            f"{image_dir}; a reconstruction needs at least {min_num_frames}"
        )
    every = set.union(*found.values())
    frames = Frames(
        image_dir=image_dir,
        folders=tuple(found),
        names=tuple(sorted(every, key=natural_key)),
        absent=frozenset(
            f"{folder}/{name}"
            for folder, names in found.items()
            for name in every - names
        ),
    )
    check_image_names(image_dir, frames.image_names())
    for image_name in frames.image_names():
        # COLMAP's lists of image pairs are separated by spaces.
        if re.search(r"\s", image_name):
            raise InputError(
                f"image {image_dir / image_name}: its name contains white space; "
                "rename it"
            )
        if (image_dir / image_name).stat().st_size == 0:
            raise InputError(f"image {image_dir / image_name} is an empty file")
    return frames


def _equal_but(found: dict[str, set[str]]) -> str:
    """By what the names of all folders differ, if it is their suffix or case; or ''."""

    def stem(name: str) -> str:
        return PurePosixPath(name).stem

    for what, key in (("suffixes", stem), ("upper and lower case", str.lower)):
        keys = [set(map(key, names)) for names in found.values()]
        if set.intersection(*keys):
            return f": these differ by their {what} only"
    return ""


def _images_of(image_dir: Path, folder: str, camera: str) -> set[str]:
    path = image_dir / folder
    if not path.is_dir():
        raise InputError(
            f"folder {path} of camera {camera!r} does not exist; a camera that took no "
            "images is left out of the rig file"
        )
    names = {
        item.name
        for item in path.iterdir()
        if item.suffix.lower() in SUFFIXES
        and not item.name.startswith(".")
        and item.is_file()
    }
    if not names:
        raise InputError(f"folder {path} of camera {camera!r} holds no image")
    return names


def mask_path(mask_dir: Path, image_name: str) -> Path | None:
    """The mask of an image, ``left/0001.jpg.png``, or None: it is used whole.

    As by COLMAP, that of a PNG may also have the name of the image itself.
    """
    mask_dir = Path(mask_dir)
    names = [f"{image_name}.png"]
    if image_name.lower().endswith(".png"):
        names.append(image_name)
    return next((mask_dir / n for n in names if (mask_dir / n).is_file()), None)


def mask_warnings(frames: Frames, mask_dir: Path | None) -> list[str]:
    """A sentence on images without a mask, if there are masks."""
    if mask_dir is None:
        return []
    names = [name for name in frames.image_names() if not mask_path(mask_dir, name)]
    if not names:
        return []
    return [
        f"{len(names)} of {frames.num_images} images have no mask in {mask_dir} and "
        f"were used whole, for instance {names[0]}"
    ]


def range_warnings(frames: Frames) -> list[str]:
    """A sentence on cameras whose images do not use the range of their pixels, by the
    first image of each."""
    found = {}
    for folder in frames.folders:
        names = (n for n in frames.image_names() if n.rpartition("/")[0] == folder)
        words = value_range(frames.image_dir / next(names))
        if words:
            found[folder] = words
    return [
        f"the images of {folder}/ hold {words}: features and colours are taken from "
        "their values scaled to the range that each image uses"
        for folder, words in found.items()
    ]


def check_masks(frames: Frames, rig: Rig, mask_dir: Path) -> None:
    """Masks must have the size of their images; an image without one is used whole.

    Raises:
        InputError: no image has a mask, or one cannot be decoded or has another size.
    """
    sizes = {c.images: (c.camera.width, c.camera.height) for c in rig.cameras}
    if not any(mask_path(mask_dir, name) for name in frames.image_names()):
        example = Path(mask_dir) / f"{next(frames.image_names())}.png"
        raise InputError(
            f"mask directory {mask_dir} holds no mask of any image; the one of the "
            f"first image would be {example}"
        )
    for name in frames.image_names():
        path = mask_path(mask_dir, name)
        if path is None:
            continue
        mask = read_gray(path)
        if mask is None:
            raise InputError(f"mask {path} cannot be read: it is not an image")
        width, height = sizes[name.rpartition("/")[0]]
        if mask.shape != (height, width):
            raise InputError(
                f"mask {path} has {mask.shape[1]} x {mask.shape[0]} pixels, but its "
                f"image has {width} x {height}"
            )
