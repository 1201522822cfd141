"""Many points of one camera at once: a buffer of lanes, and how it is filled.

The buffer is one flat array of NUM_ROWS rows of BLOCK lanes, row k lane i at
``k * STRIDE + i``: a loop over exactly BLOCK lanes, without branches, becomes SIMD.
Lanes that a fixed number of steps does not solve have OK = 0 and are done again by the
scalar kernels of `uwsfm.models.projection`, which also know the reason of a failure.
"""

import math
from typing import Final

from uwsfm._base.jit import inner, lane

BLOCK: Final = 64
"""Lanes: eight AVX-512 registers; the rows of a Jacobian still fit the L1 cache."""
STRIDE: Final = BLOCK + 8
"""Not a power of two, whose rows would share one set of the cache."""

# Rows: the point, the root of the port's equation, its ray in air, the pixel.
X, Y, Z, ROOT, VX, VY, VZ, PX, PY, OK = range(10)
LENS_U: Final = 10
"""d(px) / dv, 3 rows."""
LENS_V: Final = 13
"""d(py) / dv, 3 rows."""
JAC_U: Final = 16
"""d(px) by point (3), port (7, see `projection.JAC_SIZE`), then what `residuals` adds:
point in the rig (3), turn (3) and translation (3) of cam_from_rig, lens (12), and the
residual."""
NUM_COLUMNS: Final = 32
JAC_V: Final = JAC_U + NUM_COLUMNS
"""d(py), likewise."""
NUM_ROWS: Final = JAC_V + NUM_COLUMNS
SIZE: Final = NUM_ROWS * STRIDE


@inner
def load_rows(values, first, count, row, num_columns, buffer):
    """Copy values[first : first + count] into ``num_columns`` rows from ``row``.

    Lanes beyond ``count`` repeat the last one.
    """
    for i in range(BLOCK):
        j = first + min(i, count - 1)
        for k in range(num_columns):
            buffer[(row + k) * STRIDE + i] = values[j, k]


@lane
def store_ray(i, ray, meets, buffer):
    """Put a water ray where the point and the ray in air are: origin, direction.

    OK stays 1 if ``meets`` is positive and the ray is not totally reflected.
    """
    ox, oy, oz, wx, wy, wz = ray
    buffer[X * STRIDE + i] = ox
    buffer[Y * STRIDE + i] = oy
    buffer[Z * STRIDE + i] = oz
    buffer[VX * STRIDE + i] = wx
    buffer[VY * STRIDE + i] = wy
    buffer[VZ * STRIDE + i] = wz
    buffer[OK * STRIDE + i] *= 1.0 if meets > 0.0 else 0.0
    buffer[OK * STRIDE + i] *= 1.0 if abs(wx) < math.inf else 0.0
