"""Textures for rendered sea floors, with smaller copies for distant views."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]

MAX_SIDE = 32000  # cv2.remap addresses its source by 16-bit integers
REMAP_WIDTH = 4096


@dataclass(frozen=True, eq=False)
class Texture:
    """An image laid over a plane.

    Colours are RGB reflectances in square-root encoding, close to what an image stores.
    """

    levels: tuple[Image, ...]
    """(H, W, 3) each; the texels of level k are 2^k times larger."""
    origin: tuple[float, float]
    """Position of the outer corner of the first texel, metres."""
    texel: float
    """Side of a texel of the first level, metres."""

    @classmethod
    def from_image(
        cls, image: Image, origin: tuple[float, float], texel: float
    ) -> "Texture":
        """Add the smaller copies: averages of 2x2 texels, again and again.

        Raises:
            InputError: the image is too large.
        """
        if max(image.shape) > MAX_SIDE:
            raise InputError(
                f"a texture of {image.shape[1]}x{image.shape[0]} texels is too large, "
                f"at most {MAX_SIDE} on a side can be used: take larger texels"
            )
        levels = [np.ascontiguousarray(image)]
        while min(levels[-1].shape[:2]) >= 64:
            height, width = (side // 2 for side in levels[-1].shape[:2])
            # Cut to even sizes: exact 2x2 blocks, so that no level is shifted.
            even = levels[-1][: 2 * height, : 2 * width]
            half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, dtype=np.uint8))
        return cls(tuple(levels), origin, texel)

    def lookup(self, xy: Array, spacing: Plane) -> Plane:
        """Bilinear colours (N, 3), 0-255.

        Args:
            xy: Positions (N, 2) on the plane, metres; beyond its edge the texture is
                mirrored.
            spacing: Distance (N,) to the neighbouring samples, metres. It chooses the
                level whose texels are nearest in size, so that no detail is skipped.
        """
        level = np.rint(np.log2(np.maximum(spacing, self.texel) / self.texel))
        level = np.minimum(level, len(self.levels) - 1).astype(np.int64)
        colors = np.empty((len(xy), 3), dtype=np.float32)
        for index in np.unique(level):
            rows = np.flatnonzero(level == index)
            position = (xy[rows] - self.origin) / (self.texel * 2.0**index) - 0.5
            colors[rows] = _bilinear(self.levels[index], position.astype(np.float32))
        return colors


def _bilinear(image: Image, position: Plane) -> Plane:
    """Colours (N, 3) at positions (N, 2) in units of texels, centres at integers."""
    # cv2.remap wants its (N,) positions as an image: fold them, and pad the last row.
    height = -(-len(position) // REMAP_WIDTH)
    folded = np.zeros((height * REMAP_WIDTH, 2), dtype=np.float32)
    folded[: len(position)] = position
    colors = cv2.remap(
        image,
        folded[:, 0].reshape(height, REMAP_WIDTH),
        folded[:, 1].reshape(height, REMAP_WIDTH),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return colors.reshape(-1, 3)[: len(position)].astype(np.float32)
