"""Parameters of one camera that all frames share: the columns of the *border*.

Rotations, directions and normals move in their tangent planes; everything else adds.
The Jacobians of errors but the reprojection error end before `RADIUS`.
"""

from typing import Final

ROTATION: Final = slice(0, 3)
"""Of cam_from_rig, left tangent, radians."""
DIRECTION: Final = slice(3, 5)
"""Of cam_from_rig's translation, radians."""
LENGTH: Final = 5
"""Of cam_from_rig's translation, metres."""
PLACE: Final = slice(6, 9)
"""Of a port: what the next three say of its kind. All of it but the radius."""
NORMAL: Final = slice(6, 8)
"""Of a plane, radians."""
DISTANCE: Final = 8
"""Of a plane, metres."""
CENTER: Final = slice(6, 9)
"""Of a dome, metres: it has no normal and no distance."""
WATER_INDEX: Final = 9
THICKNESS: Final = 10
"""Of the glass, metres."""
GLASS_INDEX: Final = 11
RADIUS: Final = 12
"""Inner radius of a dome, metres."""
LENS: Final = slice(13, 25)
"""fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, as in `uwsfm.models.lens`."""
FIRST_LENS: Final = 13
BORDER_SIZE: Final = 25
