"""Error on the outer interface (Sedlazeck & Koch, BMVC 2011, eq. 6-10), with Jacobian.

Every observation has a pinhole of its own: the centre on the caustic of its water ray,
the axis along the port's normal, the outer surface of the port as image plane. With the
names of `water_ray`, h = z - d - t the depth of the point behind the glass and f the
focal length (eq. 9), the residual of eq. 10 is

    e = mu g,   mu = f / (f + h),   g = X - z n - (k + s_w h) w

g is how far the point lies beside the ray, and mu shrinks that to the image plane. No
rotation R_v is needed: e is the paper's vector, left in the camera frame, metres.
f = (d + t c_g) / c_w with c_i from `_focus`, by which sheet of the caustic is meant.

e shrinks with f, so it is no measure for d: any error vanishes where f does.
"""

import math

from uwsfm._base.jit import inner
from uwsfm.geometry.unit_vector import tangents
from uwsfm.geometry.vec3 import add, dot
from uwsfm.models.ports.row import (
    DISTANCE,
    N_AIR,
    N_GLASS,
    N_WATER,
    NX,
    NY,
    NZ,
    THICKNESS,
)
from uwsfm.models.status import BEHIND_CAMERA, NOT_FINITE, VALID
from uwsfm.residuals.reprojection import point_in_rig
from uwsfm.residuals.water_ray import slope_by_index, slope_by_u, water_ray


@inner
def _focus(index, s, a, tangential):
    """How fast a ray leaves the axis in a layer, by how fast it does so in air.

    Neighbours around the axis: c = tan(theta) / tan(theta_air) = s. Neighbours in the
    plane of the ray and the axis: c = d tan(theta) / d tan(theta_air) = index^2 s^3.

    Returns:
        (c, dc/du, dc/dindex).
    """
    by_u, by_index = slope_by_u(index, s), slope_by_index(index, s, a)
    if not tangential:
        return s, by_u, by_index
    square = index * index * s * s
    return (
        square * s,
        3.0 * square * by_u,
        2.0 * index * s * s * s + 3.0 * square * by_index,
    )


@inner
def _miss(x, y, z, v, port, tangential):
    """(status, a, s_g, s_w, <n, X>, k + s_w h, f, w (3), g (3)) of a point X."""
    nan = math.nan
    none = (nan, nan, nan)
    if not abs(x) + abs(y) + abs(z) < math.inf:
        return NOT_FINITE, nan, nan, nan, nan, nan, nan, none, none
    status, a, s_g, s_w, w = water_ray(v, port)
    if status != VALID:
        return status, nan, nan, nan, nan, nan, nan, none, none
    point, dist, thick = (x, y, z), port[DISTANCE], port[THICKNESS]
    depth = dot(port, point)
    height = depth - dist - thick
    c_g, _, _ = _focus(port[N_GLASS] / port[N_AIR], s_g, a, tangential)
    c_w, _, _ = _focus(port[N_WATER] / port[N_AIR], s_w, a, tangential)
    focal = (dist + thick * c_g) / c_w
    if not focal + height > 0.0:
        return BEHIND_CAMERA, nan, nan, nan, nan, nan, nan, none, none
    reach = dist + thick * s_g + height * s_w
    g = add(add(point, -depth, port), -reach, w)
    return VALID, a, s_g, s_w, depth, reach, focal, w, g


@inner
def residual(x, y, z, v, cam, port, tangential):
    """The point, projected onto the outer surface, minus where the ray leaves it.

    Args:
        x, y, z: the point in the rig's frame.
        v: (3,) unit direction in air of the observation, camera frame; NaN if none.
        cam: (12,) cam_from_rig as a row of [R | t].
        port: row of the model.
        tangential: which focal point of the ray is the centre: the one on the axis
            (0, sagittal) or the one beside it (1).

    Returns:
        (status, ex, ey, ez) in the camera frame, metres; NaN unless VALID. A point that
        is not in front of the virtual camera is BEHIND_CAMERA.
    """
    px, py, pz = point_in_rig(cam, (x, y, z))
    status, _, _, _, depth, _, focal, _, g = _miss(px, py, pz, v, port, tangential)
    shrink = focal / (focal + depth - port[DISTANCE] - port[THICKNESS])
    return status, shrink * g[0], shrink * g[1], shrink * g[2]


@inner
def residual_with_jac(x, y, z, v, cam, arm, port, tangential, j_rig, j_border):
    """`residual`, with Jacobians by the point in the rig and by the camera.

    Args:
        x, y, z, v, cam, port, tangential: as in `residual`.
        arm: (9,) how the translation of ``cam`` moves with direction (2) and length
            (1): three columns, one after the other.
        j_rig: (3, 3), written.
        j_border: (3, K >= 12), columns written: rotation of cam_from_rig (3), direction
            of its translation (2), its length (1), normal (2, tangent), distance,
            n_water, thickness, n_glass.

    Returns:
        (status, ex, ey, ez); Jacobians are untouched unless the status is VALID.
    """
    px, py, pz = point_in_rig(cam, (x, y, z))
    miss = _miss(px, py, pz, v, port, tangential)
    status, _, _, _, depth, _, focal, _, g = miss
    if status != VALID:
        return status, math.nan, math.nan, math.nan
    shrink = focal / (focal + depth - port[DISTANCE] - port[THICKNESS])
    _by_point_and_port((px, py, pz), v, port, tangential, miss, j_border)
    _chain_to_pose((px - cam[3], py - cam[7], pz - cam[11]), cam, arm, j_rig, j_border)
    return status, shrink * g[0], shrink * g[1], shrink * g[2]


@inner
def _by_point_and_port(point, v, port, tangential, miss, j_border):
    """Write d/dX (camera frame) to columns 0-2, d/d port to columns 6-11.

    With L = k + s_w h, the derivatives of f and L (at fixed h) as f_., L_., and

        nu = (1 - mu) / (f + h),  p = mu (g / (f + h) + s_w w),  q = mu n + p
        b = (mu L / a^2) v + 2/a^3 (mu L_u w - nu f_u g)

        d/dX = mu I - q n^T            d/dn = [mu (L - z) I - q X^T + b v^T] T
        d/dd = p + nu f_d g - mu w     d/dt = p + nu f_t g - mu s_g w
        d/dn_i = nu f_i g - mu L_i w
    """
    _, a, s_g, s_w, depth, reach, focal, w, g = miss
    n_air, thick = port[N_AIR], port[THICKNESS]
    n_glass, n_water = port[N_GLASS] / n_air, port[N_WATER] / n_air
    height = depth - port[DISTANCE] - thick
    f_dist, f_thick, f_glass, f_water, f_u = _focal_jac(
        focal, a, s_g, s_w, port, tangential
    )
    inv_range = 1.0 / (focal + height)
    mu = focal * inv_range
    nu = (1.0 - mu) * inv_range
    by_u = thick * slope_by_u(n_glass, s_g) + height * slope_by_u(n_water, s_w)
    by_glass = thick * slope_by_index(n_glass, s_g, a)
    by_water = height * slope_by_index(n_water, s_w, a)
    t11, t12, t13, t21, t22, t23 = tangents(port[NX], port[NY], port[NZ])
    first, second = (t11, t12, t13), (t21, t22, t23)
    x_1, v_1 = dot(point, first), dot(v, first)
    x_2, v_2 = dot(point, second), dot(v, second)
    direct, turn, bend = mu * (reach - depth), mu * reach / (a * a), 2.0 / (a * a * a)
    for i in range(3):
        g_i, w_i = nu * g[i], mu * w[i]
        p = mu * inv_range * g[i] + s_w * w_i
        q = mu * port[i] + p
        b = turn * v[i] + bend * (by_u * w_i - f_u * g_i)
        for k in range(3):
            j_border[i, k] = -q * port[k]
        j_border[i, i] += mu
        j_border[i, 6] = direct * first[i] - q * x_1 + b * v_1
        j_border[i, 7] = direct * second[i] - q * x_2 + b * v_2
        j_border[i, 8] = p + f_dist * g_i - w_i
        j_border[i, 9] = (f_water * g_i - by_water * w_i) / n_air
        j_border[i, 10] = p + f_thick * g_i - s_g * w_i
        j_border[i, 11] = (f_glass * g_i - by_glass * w_i) / n_air


@inner
def _focal_jac(focal, a, s_g, s_w, port, tangential):
    """Derivatives of f by d, t, n_g, n_w (relative to air) and u."""
    thick = port[THICKNESS]
    c_g, c_g_u, c_g_index = _focus(port[N_GLASS] / port[N_AIR], s_g, a, tangential)
    c_w, c_w_u, c_w_index = _focus(port[N_WATER] / port[N_AIR], s_w, a, tangential)
    by_dist = 1.0 / c_w
    return (
        by_dist,
        c_g * by_dist,
        thick * c_g_index * by_dist,
        -focal * c_w_index * by_dist,
        (thick * c_g_u - focal * c_w_u) * by_dist,
    )


@inner
def _chain_to_pose(turned, cam, arm, j_rig, j_border):
    """From d/dX in columns 0-2 of j_border to d/d(point in the rig), and columns 0-5.

    ``turned`` is the point in the rig, turned into the camera but not yet shifted.
    """
    ax, ay, az = turned
    for i in range(3):
        lx, ly, lz = j_border[i, 0], j_border[i, 1], j_border[i, 2]
        for k in range(3):
            j_rig[i, k] = lx * cam[k] + ly * cam[4 + k] + lz * cam[8 + k]
            j_border[i, 3 + k] = (
                lx * arm[3 * k] + ly * arm[3 * k + 1] + lz * arm[3 * k + 2]
            )
        # l . (w x a) = w . (a x l) for a turn w of the turned point a
        j_border[i, 0] = ay * lz - az * ly
        j_border[i, 1] = az * lx - ax * lz
        j_border[i, 2] = ax * ly - ay * lx
