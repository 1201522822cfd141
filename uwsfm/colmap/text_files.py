"""COLMAP's models in text, checked before COLMAP reads them."""

from collections.abc import Iterator
from pathlib import Path

from uwsfm._base.files import require_regular
from uwsfm._base.paths import check_image_names, shown, white_space_fault
from uwsfm.errors import InputError

_IMAGE_ITEMS = 10


def check_text(folder: Path) -> None:
    """Names whole, and as many numbers in each line as its record has."""
    images = folder / "images.txt"
    names = []
    for number, line in _image_lines(images):
        items = line.split()
        if len(items) < _IMAGE_ITEMS:
            raise InputError(
                f"{images}: line {number}: has {len(items)} items, an image has 10: "
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        name = line.split(maxsplit=_IMAGE_ITEMS - 1)[-1].rstrip()
        fault = white_space_fault(name)
        if fault is not None:
            raise InputError(
                f"{images}: line {number}: the image name {shown(name)!r} {fault}"
            )
        names.append(name)
    check_image_names(images, names)


def _image_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbers and text of the lines that name images; every other one is keypoints."""
    require = _text_lines(path)
    for number, line in require:
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        yield number, text
        _, keypoints = next(require, (0, ""))
        if len(keypoints.split()) % 3:
            raise InputError(
                f"{path}: line {number + 1}: the keypoints of an image are triples "
                "X Y POINT3D_ID, but the numbers of this line are not; was the file "
                "cut or edited?"
            )


def _text_lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        require_regular(path)
        with path.open(encoding="utf-8", errors="surrogateescape", newline="\n") as f:
            yield from enumerate(f, start=1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def stray_track(folder: Path) -> str:
    """A sentence on a text model whose points are seen by images that it lacks; "".

    Only asked when COLMAP has refused the model: all lines are read again.
    """
    images, points = folder / "images.txt", folder / "points3D.txt"
    if (folder / "images.bin").exists() or not (images.exists() and points.exists()):
        return ""
    there = {line.split(maxsplit=1)[0] for _, line in _image_lines(images)}
    for number, line in _text_lines(points):
        items = line.split()
        if not items or items[0].startswith("#"):
            continue
        stray = next((item for item in items[8::2] if item not in there), None)
        if stray is not None:
            return (
                f"{points}: line {number}: point {items[0]} is seen by image {stray}, "
                f"which {images.name} lacks: the image was removed without its "
                "observations; remove it with COLMAP (image_deleter), or export the "
                "model again"
            )
    return ""
