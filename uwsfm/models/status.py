"""Why a projection or an unprojection has no answer."""

from enum import IntEnum


class Status(IntEnum):
    """Reason codes; everything but VALID comes with NaN, never with a number."""

    VALID = 0
    BEHIND_CAMERA = 1
    """The point, or its ray in air, lies behind the camera."""
    IN_AIR_GAP = 2
    """The point lies between the camera and the port, inside the housing."""
    IN_GLASS = 3
    """The point lies inside the glass."""
    TOTAL_REFLECTION = 4
    """No refracted ray: beyond the critical angle."""
    MISSES_PORT = 5
    """The ray runs parallel to the port or away from it."""
    OUTSIDE_LENS = 6
    """The lens distortion is not invertible there, or the pixel is out of its range."""
    NOT_FINITE = 7
    """The input is NaN or infinite."""
    NO_INTERSECTION = 8
    """Fewer than two rays, or parallel ones: they fix no point."""


# Plain integers for the kernels: numba compiles them as constants.
VALID = int(Status.VALID)
BEHIND_CAMERA = int(Status.BEHIND_CAMERA)
IN_AIR_GAP = int(Status.IN_AIR_GAP)
IN_GLASS = int(Status.IN_GLASS)
TOTAL_REFLECTION = int(Status.TOTAL_REFLECTION)
MISSES_PORT = int(Status.MISSES_PORT)
OUTSIDE_LENS = int(Status.OUTSIDE_LENS)
NOT_FINITE = int(Status.NOT_FINITE)
NO_INTERSECTION = int(Status.NO_INTERSECTION)
