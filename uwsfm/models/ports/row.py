"""The row of a port as kernels read it: where each of its numbers is.

The first eight numbers are the parameters in the order that Refractive COLMAP
publishes, [Nx, Ny, Nz, int_dist, int_thick, na, ng, nw] of a flat port and
[Cx, Cy, Cz, int_radius, int_thick, na, ng, nw] of a dome; then comes the kind. Numba
takes the names as constants: they cost nothing.
"""

from typing import Final

NUM_PARAMS: Final = 8
PORT_SIZE: Final = 9

NX: Final = 0
NY: Final = 1
NZ: Final = 2
"""The normal of a plane, unit, from the camera to the water."""
DISTANCE: Final = 3
"""Of a plane: from the projection centre to its inner surface, metres."""
CX: Final = 0
CY: Final = 1
CZ: Final = 2
"""The centre of a sphere in the camera frame, metres."""
RADIUS: Final = 3
"""Of a sphere's inner surface, metres."""
THICKNESS: Final = 4
"""Of the glass, metres."""
N_AIR: Final = 5
N_GLASS: Final = 6
N_WATER: Final = 7
KIND: Final = 8
"""The ``code`` of the kind, see `uwsfm.models.ports.kind`."""

AXIS: Final = slice(0, 3)
"""The normal of a plane or the centre of a sphere."""
PLACE: Final = slice(0, 4)
"""That, then the distance or the radius."""
