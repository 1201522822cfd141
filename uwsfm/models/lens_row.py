"""The row of a lens as kernels read it: where each of its numbers is.

    [fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, kind, limit]

Lenses that are no FULL_OPENCV keep their own parameters in the same places, in the
order of COLMAP: see `OMEGA`, `ALPHA`, `BETA`, `SX` and `SY`. Numba takes the names as
constants: they cost nothing.
"""

from typing import Final

LENS_SIZE: Final = 14
NUM_PARAMS: Final = 12

FX: Final = 0
FY: Final = 1
CX: Final = 2
CY: Final = 3
K1: Final = 4
K2: Final = 5
P1: Final = 6
P2: Final = 7
K3: Final = 8
K4: Final = 9
K5: Final = 10
K6: Final = 11
KIND: Final = 12
"""One of `uwsfm.models.lens.KINDS`."""
LIMIT: Final = 13
"""Up to where the radial distortion grows, see `uwsfm.models.lens`."""

OMEGA: Final = 4
"""Of FOV."""
ALPHA: Final = 4
BETA: Final = 5
"""Of EUCM."""
SX: Final = 10
SY: Final = 11
"""Of THIN_PRISM_FISHEYE, whose k3 and k4 are at `K3` and `K4`."""

FOCAL: Final = slice(0, 2)
"""fx and fy."""
CENTER: Final = slice(2, 4)
"""cx and cy: the principal point."""
DISTORTION: Final = slice(4, 12)
