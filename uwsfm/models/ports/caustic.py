"""Caustics of a flat port: where the water rays of neighbouring pixels meet.

A camera behind a port has no single viewpoint; the rays touch a surface of two sheets
instead (Sedlazeck & Koch, BMVC 2011, fig. 3), where det d(X_o + a r_w) / d(x, y, a) = 0
along the ray of a pixel. Both roots are closed forms.
"""

import numpy as np

from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import PlanePort


def caustic_points(
    origins: Array, directions: Array, port: PlanePort
) -> tuple[Array, Array]:
    """Both focal points of each water ray, in the camera frame.

    With s_i = tan(theta_i) / tan(theta_air) in glass and water, and n_i the indices
    relative to air, neighbours around the axis meet on it, (d + t s_g) / s_w above the
    outer surface; neighbours in the plane of the ray and the axis meet
    (d + t n_g^2 s_g^3) / (n_w^2 s_w^3) above it.

    Args:
        origins: (N, 3) on the outer surface, as from `RefractiveCamera.ray_from_img`.
        directions: (N, 3) unit, in the water.
        port: the port that refracted them.

    Returns:
        Points on the axis (sagittal) and off it (tangential), (N, 3) each; NaN rows for
        NaN rays.
    """
    normal = np.array(port.normal)
    glass, water = port.n_glass / port.n_air, port.n_water / port.n_air
    cos_water = directions @ normal
    # Snell: the sine in air is n_w times that in water.
    sine2 = water**2 * (1.0 - cos_water**2)
    u = sine2 / (1.0 - sine2)  # tan^2 in air
    s_g = 1.0 / np.sqrt(glass**2 + (glass**2 - 1.0) * u)
    s_w = 1.0 / np.sqrt(water**2 + (water**2 - 1.0) * u)
    on_axis = (port.distance + port.thickness * s_g) / s_w
    tangential = (port.distance + port.thickness * glass**2 * s_g**3) / (
        water**2 * s_w**3
    )
    step = directions / cos_water[:, None]
    return origins - on_axis[:, None] * step, origins - tangential[:, None] * step
