"""Error in space (Sedlazeck & Koch, BMVC 2011, section 3.1), and its Jacobian.

The residual of a cell, one point in one frame, is the point triangulated from the water
rays of the cell's cameras, minus the point: e, in the rig's frame, metres. Triangulated
is least squares, as in `geometry.rays.triangulate_tracks`: with a ray's origin o and
unit direction r in the rig's frame, P = I - r r^T, and the point X,

    A e = sum P (o - X),   A = sum P
"""

import math

from uwsfm._base.jit import inner
from uwsfm.geometry.unit_vector import tangents
from uwsfm.geometry.vec3 import add, dot, scaled
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
from uwsfm.models.status import BEHIND_CAMERA, NO_INTERSECTION, NOT_FINITE, VALID
from uwsfm.residuals.reprojection import point_in_rig
from uwsfm.residuals.water_ray import slope_by_index, slope_by_u, water_ray

MIN_DET = 1e-14
"""Of A: rays within 1e-7 radians of each other count as parallel."""


@inner
def _turned_into_rig(cam, p):
    """R^T p, with R the rotation of a row of [R | t]."""
    return (
        cam[0] * p[0] + cam[4] * p[1] + cam[8] * p[2],
        cam[1] * p[0] + cam[5] * p[1] + cam[9] * p[2],
        cam[2] * p[0] + cam[6] * p[1] + cam[10] * p[2],
    )


@inner
def _ray_in_rig(v, cam, port):
    """(status, origin (3), unit direction (3)) of a water ray in the rig's frame."""
    none = (math.nan, math.nan, math.nan)
    status, _, s_g, s_w, w = water_ray(v, port)
    if status != VALID:
        return status, none, none
    n = (port[NX], port[NY], port[NZ])
    origin = add(
        scaled(port[DISTANCE] + port[THICKNESS], n),
        port[DISTANCE] + port[THICKNESS] * s_g,
        w,
    )
    origin = add(origin, -1.0, (cam[3], cam[7], cam[11]))
    rho = add(n, s_w, w)
    unit = scaled(1.0 / math.sqrt(dot(rho, rho)), rho)
    return VALID, _turned_into_rig(cam, origin), _turned_into_rig(cam, unit)


@inner
def _inverse_symmetric(xx, xy, xz, yy, yz, zz):
    """(regular, upper triangle (6) of the inverse) of a symmetric matrix (3x3)."""
    nan = math.nan
    ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * ixx + xy * ixy + xz * ixz
    if not det > MIN_DET:
        return False, (nan, nan, nan, nan, nan, nan)
    inv = 1.0 / det
    iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return True, (inv * ixx, inv * ixy, inv * ixz, inv * iyy, inv * iyz, inv * izz)


@inner
def _times_symmetric(matrix, p):
    xx, xy, xz, yy, yz, zz = matrix
    return (
        xx * p[0] + xy * p[1] + xz * p[2],
        xy * p[0] + yy * p[1] + yz * p[2],
        xz * p[0] + yz * p[1] + zz * p[2],
    )


@inner
def _triangulate(x, y, z, dirs, camera, first, last, cams, ports):
    """(status, e (3), A^-1 (6, upper triangle)): see `residual`."""
    nan = math.nan
    lost, none = (nan, nan, nan), (nan, nan, nan, nan, nan, nan)
    if not abs(x) + abs(y) + abs(z) < math.inf:
        return NOT_FINITE, lost, none
    point, b = (x, y, z), (0.0, 0.0, 0.0)
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        k = camera[i]
        status, origin, r = _ray_in_rig(dirs[i], cams[k], ports[k])
        if status != VALID:
            return status, lost, none
        away = add(origin, -1.0, point)
        b = add(add(b, 1.0, away), -dot(r, away), r)
        rx, ry, rz = r
        xx, yy, zz = xx + 1.0 - rx * rx, yy + 1.0 - ry * ry, zz + 1.0 - rz * rz
        xy, xz, yz = xy - rx * ry, xz - rx * rz, yz - ry * rz
    regular, inverse = _inverse_symmetric(xx, xy, xz, yy, yz, zz)
    if not regular:
        return NO_INTERSECTION, lost, none
    e = _times_symmetric(inverse, b)
    for i in range(first, last):
        port = ports[camera[i]]
        in_cam = point_in_rig(cams[camera[i]], add(point, 1.0, e))
        if not dot(port, in_cam) > port[DISTANCE] + port[THICKNESS]:
            return BEHIND_CAMERA, lost, none
    return VALID, e, inverse


@inner
def residual(x, y, z, dirs, camera, first, last, cams, ports):
    """The triangulated point, minus the point; one cell.

    Args:
        x, y, z: the point in the rig's frame.
        dirs: (N, 3) unit directions in air of all observations, camera frames.
        camera: (N,) camera of each observation.
        first, last: the cell's observations are first, ..., last - 1.
        cams: (C, 12) cam_from_rig as rows of [R | t].
        ports: (C, PORT_SIZE) rows of the model.

    Returns:
        (status, ex, ey, ez) in the rig's frame, metres; NaN unless VALID. A cell of
        which one observation has no ray has no residual; rays that run apart and meet
        behind a port, not in the water, are BEHIND_CAMERA.
    """
    status, e, _ = _triangulate(x, y, z, dirs, camera, first, last, cams, ports)
    return status, e[0], e[1], e[2]


@inner
def residual_with_jac(x, y, z, dirs, camera, first, last, cams, arms, ports, j_border):
    """`residual`, with its Jacobians by the cameras; by the point it is -I.

    Args:
        x, y, z, dirs, camera, first, last, cams, ports: as in `residual`.
        arms: (C, 9) how the translations of ``cams`` move with direction (2) and length
            (1): three columns each, one after the other.
        j_border: (last - first or more, 3, K >= 12); entry i - first is written with
            the derivatives by the camera of observation i: rotation of cam_from_rig
            (3), direction of its translation (2), its length (1), normal (2, tangent),
            distance, n_water, thickness, n_glass.

    Returns:
        (status, ex, ey, ez); Jacobians are untouched unless the status is VALID.
    """
    status, e, inverse = _triangulate(x, y, z, dirs, camera, first, last, cams, ports)
    if status != VALID:
        return status, e[0], e[1], e[2]
    met = add((x, y, z), 1.0, e)
    for i in range(first, last):
        k, jac = camera[i], j_border[i - first]
        _by_camera(met, dirs[i], cams[k], arms[k], ports[k], jac)
        for column in range(12):
            moved = (jac[0, column], jac[1, column], jac[2, column])
            moved = _times_symmetric(inverse, _turned_into_rig(cams[k], moved))
            jac[0, column], jac[1, column], jac[2, column] = moved
    return status, e[0], e[1], e[2]


@inner
def _by_camera(met, v, cam, arm, port, jac):
    """Write A de, as one camera causes it and in its frame, to columns 0-11 of jac.

    The triangulated X solves 0 = sum P (o - X). Along rho = n + s_w w, with the range c
    of the ray's point nearest to X and m from there to X, a moving ray contributes

        P (do + c drho) + rho <m, drho> / |rho|^2

    Seen from the rig, a turn w of cam_from_rig (R' = exp(w) R) moves the ray back by
    do = (o - t) x w, drho = rho x w, and a shift dt by do = -dt.
    """
    _, a, s_g, s_w, w = water_ray(v, port)
    n = (port[NX], port[NY], port[NZ])
    rho = add(n, s_w, w)
    inv = 1.0 / dot(rho, rho)
    level, side = (
        port[DISTANCE] + port[THICKNESS],
        port[DISTANCE] + port[THICKNESS] * s_g,
    )
    origin = add(scaled(level, n), side, w)
    in_cam = point_in_rig(cam, met)
    from_origin = add(in_cam, -1.0, origin)
    c = dot(rho, from_origin) * inv
    m = add(from_origin, -c, rho)
    _turn_and_shift(add(in_cam, -1.0, m), m, rho, inv, cam, arm, jac)
    n_air, thick = port[N_AIR], port[THICKNESS]
    n_glass, n_water = port[N_GLASS] / n_air, port[N_WATER] / n_air
    g_u, w_u = thick * slope_by_u(n_glass, s_g), slope_by_u(n_water, s_w)
    t11, t12, t13, t21, t22, t23 = tangents(n[0], n[1], n[2])
    for k in range(2):
        dn = (t11, t12, t13) if k == 0 else (t21, t22, t23)
        da = dot(v, dn)
        du = -2.0 * da / (a * a * a)
        dw = scaled(-1.0, add(dn, da / (a * a), v))
        drho = add(add(dn, w_u * du, w), s_w, dw)
        do = add(add(scaled(level, dn), g_u * du, w), side, dw)
        _write(jac, 6 + k, add(do, c, drho), drho, m, rho, inv)
    none = (0.0, 0.0, 0.0)
    drho = scaled(slope_by_index(n_water, s_w, a) / n_air, w)
    lift = thick * slope_by_index(n_glass, s_g, a) / n_air
    _write(jac, 8, add(n, 1.0, w), none, m, rho, inv)
    _write(jac, 9, scaled(c, drho), drho, m, rho, inv)
    _write(jac, 10, add(n, s_g, w), none, m, rho, inv)
    _write(jac, 11, scaled(lift, w), none, m, rho, inv)


@inner
def _turn_and_shift(foot, m, rho, inv, cam, arm, jac):
    """Write columns 0-5 of `_by_camera`; ``foot`` is the ray's point nearest to X."""
    fx, fy, fz = foot[0] - cam[3], foot[1] - cam[7], foot[2] - cam[11]
    rx, ry, rz = rho
    none = (0.0, 0.0, 0.0)
    _write(jac, 0, (0.0, fz, -fy), (0.0, rz, -ry), m, rho, inv)
    _write(jac, 1, (-fz, 0.0, fx), (-rz, 0.0, rx), m, rho, inv)
    _write(jac, 2, (fy, -fx, 0.0), (ry, -rx, 0.0), m, rho, inv)
    for k in range(3):
        shift = (-arm[3 * k], -arm[3 * k + 1], -arm[3 * k + 2])
        _write(jac, 3 + k, shift, none, m, rho, inv)


@inner
def _write(jac, column, dfoot, drho, m, rho, inv):
    """Write P dfoot + rho <m, drho> / |rho|^2, with ``inv`` = 1 / |rho|^2."""
    slide = (dot(m, drho) - dot(rho, dfoot)) * inv
    for i in range(3):
        jac[i, column] = dfoot[i] + slide * rho[i]
