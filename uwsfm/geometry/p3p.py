"""Pose from three points seen along three rays that need not share an origin.

Three points at known distances from each other, one on each ray: three quadrics in the
three ranges along the rays, with up to eight solutions. Behind a port the rays nearly
meet, and four of those are close to the ones of a central camera: Grunert's quartic
(1841; Haralick et al., IJCV 1994) gives these, and Newton's method follows them while
the origins move from the common centre to where they are. Solutions that have no
central counterpart are not looked for: RANSAC draws another sample.
"""

import cmath
import math

from uwsfm._base.jit import inner
from uwsfm.geometry.vec3 import dot

NEWTON_STEPS = 8
# Of the squared distances: Newton's steps converge to rounding within its number.
RANGE_TOLERANCE = 1e-12
# How far the origins may move at once, relative to the ranges.
MAX_SHIFT = 0.1


@inner
def _quartic_roots(a4, a3, a2, a1, a0):
    """The four complex roots, by Ferrari's method; accurate to about 1e-6."""
    b3, b2, b1, b0 = a3 / a4, a2 / a4, a1 / a4, a0 / a4
    # x = y - b3 / 4:  y^4 + p y^2 + q y + r
    s = b3 * b3
    p = b2 - 0.375 * s
    q = b1 - 0.5 * b2 * b3 + 0.125 * s * b3
    r = b0 - 0.25 * b1 * b3 + 0.0625 * b2 * s - 0.01171875 * s * s
    # The resolvent m^3 + p m^2 + (p^2/4 - r) m - q^2/8 has a root m >= 0.
    third = p / 3.0
    c1 = 0.25 * p * p - r
    big_p = c1 - 3.0 * third * third
    big_q = 2.0 * third**3 - third * c1 - 0.125 * q * q
    disc = cmath.sqrt(0.25 * big_q * big_q + big_p**3 / 27.0 + 0j)
    cube = -0.5 * big_q + disc
    if abs(-0.5 * big_q - disc) > abs(cube):
        cube = -0.5 * big_q - disc
    w = cube ** (1.0 / 3.0) if abs(cube) > 0.0 else 0j
    m = (w - big_p / (3.0 * w) if abs(w) > 0.0 else 0j) - third
    root = cmath.sqrt(2.0 * m)
    turn = q / root if abs(root) > 1e-12 else 0j
    one = cmath.sqrt(-2.0 * m - 2.0 * p - 2.0 * turn)
    two = cmath.sqrt(-2.0 * m - 2.0 * p + 2.0 * turn)
    shift = -0.25 * b3
    return (
        shift + 0.5 * (root + one),
        shift + 0.5 * (root - one),
        shift + 0.5 * (two - root),
        shift - 0.5 * (two + root),
    )


@inner
def _central_ranges(cos_bc, cos_ac, cos_ab, d_bc, d_ac, d_ab, ranges):
    """Grunert: ranges (4, 3) of points on rays from one origin, written.

    Args:
        cos_bc, cos_ac, cos_ab: cosines between the rays a, b, c.
        d_bc, d_ac, d_ab: squared distances between the points.
        ranges: complex pairs of roots are taken as their real part, which is near a
            double root and far from any solution otherwise.

    Returns:
        How many were written.
    """
    p, q = (d_bc - d_ab) / d_ac, (d_bc + d_ab) / d_ac
    bc2, ab2 = cos_bc * cos_bc, cos_ab * cos_ab
    mixed = cos_bc * cos_ab
    a_ab, a_bc = d_ab / d_ac, d_bc / d_ac
    a4 = (p - 1.0) ** 2 - 4.0 * a_ab * bc2
    a3 = 4.0 * (p * (1.0 - p) * cos_ac - (1.0 - q) * mixed + 2.0 * a_ab * bc2 * cos_ac)
    a2 = 2.0 * (
        p * p
        - 1.0
        + 2.0 * p * p * cos_ac * cos_ac
        + 2.0 * (1.0 - a_ab) * bc2
        - 4.0 * q * mixed * cos_ac
        + 2.0 * (1.0 - a_bc) * ab2
    )
    a1 = 4.0 * (-p * (1.0 + p) * cos_ac + 2.0 * a_bc * ab2 * cos_ac - (1.0 - q) * mixed)
    a0 = (1.0 + p) ** 2 - 4.0 * a_bc * ab2
    found = 0
    for root in _quartic_roots(a4, a3, a2, a1, a0):
        v = root.real
        if not (v > 0.0 and abs(root.imag) < 0.1 * v):
            continue
        range_a = math.sqrt(d_ac / (1.0 + v * v - 2.0 * v * cos_ac))
        u = ((p - 1.0) * v * v - 2.0 * p * cos_ac * v + 1.0 + p) / (
            2.0 * (cos_ab - v * cos_bc)
        )
        if u > 0.0 and range_a < math.inf:
            ranges[found, 0] = range_a
            ranges[found, 1] = u * range_a
            ranges[found, 2] = v * range_a
            found += 1
    return found


@inner
def _newton_step(ray_a, ray_b, ray_c, ranges, squares, centre, share):
    """One Newton step on the three distances, with origins moved by a share.

    Args:
        ray_a, ray_b, ray_c: (6,) origin and unit direction.
        ranges: (3,), changed in place.
        squares: the squared distances bc, ac, ab.
        centre: where the origins come from.
        share: 0 for all origins in the centre, 1 for where they are.

    Returns:
        The largest relative error of the squared distances before the step.
    """
    rest = 1.0 - share
    la, lb, lc = ranges[0], ranges[1], ranges[2]
    a = (ray_a[3], ray_a[4], ray_a[5])
    b = (ray_b[3], ray_b[4], ray_b[5])
    c = (ray_c[3], ray_c[4], ray_c[5])
    ax = rest * centre[0] + share * ray_a[0] + la * a[0]
    ay = rest * centre[1] + share * ray_a[1] + la * a[1]
    az = rest * centre[2] + share * ray_a[2] + la * a[2]
    bx = rest * centre[0] + share * ray_b[0] + lb * b[0]
    by = rest * centre[1] + share * ray_b[1] + lb * b[1]
    bz = rest * centre[2] + share * ray_b[2] + lb * b[2]
    cx = rest * centre[0] + share * ray_c[0] + lc * c[0]
    cy = rest * centre[1] + share * ray_c[1] + lc * c[1]
    cz = rest * centre[2] + share * ray_c[2] + lc * c[2]
    bc = (bx - cx, by - cy, bz - cz)
    ac = (ax - cx, ay - cy, az - cz)
    ab = (ax - bx, ay - by, az - bz)
    e1 = dot(bc, bc) - squares[0]
    e2 = dot(ac, ac) - squares[1]
    e3 = dot(ab, ab) - squares[2]
    # d e1 = (. b1 c1), d e2 = (a2 . c2), d e3 = (a3 b3 .)
    b1, c1 = 2.0 * dot(bc, b), -2.0 * dot(bc, c)
    a2, c2 = 2.0 * dot(ac, a), -2.0 * dot(ac, c)
    a3, b3 = 2.0 * dot(ab, a), -2.0 * dot(ab, b)
    inv = 1.0 / (b1 * c2 * a3 + c1 * a2 * b3)
    ranges[0] = la - (-c2 * b3 * e1 + c1 * b3 * e2 + b1 * c2 * e3) * inv
    ranges[1] = lb - (c2 * a3 * e1 - c1 * a3 * e2 + c1 * a2 * e3) * inv
    ranges[2] = lc - (a2 * b3 * e1 + b1 * a3 * e2 - b1 * a2 * e3) * inv
    return max(abs(e1) / squares[0], abs(e2) / squares[1], abs(e3) / squares[2])


@inner
def _follow(ray_a, ray_b, ray_c, ranges, squares, centre, shift):
    """Move the origins from the centre to their places; whether ranges came along."""
    stages = 1 + int(min(shift / MAX_SHIFT, 20.0))
    error = 1.0
    for stage in range(stages):
        share = (stage + 1.0) / stages
        for _ in range(NEWTON_STEPS):
            error = _newton_step(ray_a, ray_b, ray_c, ranges, squares, centre, share)
            if not error > RANGE_TOLERANCE:
                break
    ahead = ranges[0] > 0.0 and ranges[1] > 0.0 and ranges[2] > 0.0
    return ahead and error < 1e3 * RANGE_TOLERANCE


@inner
def _frame(p, q, r):
    """Orthonormal axes of a triangle, 9 scalars: along pq, across, normal."""
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    inv = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux * inv, uy * inv, uz * inv
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    inv = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx * inv, ny * inv, nz * inv
    return (
        ux,
        uy,
        uz,
        ny * uz - nz * uy,
        nz * ux - nx * uz,
        nx * uy - ny * ux,
        nx,
        ny,
        nz,
    )


@inner
def _on_ray(ray, length):
    return (
        ray[0] + length * ray[3],
        ray[1] + length * ray[4],
        ray[2] + length * ray[5],
    )


@inner
def _origins(ray_a, ray_b, ray_c):
    """The mean of three origins, and how far apart they are."""
    x = (ray_a[0] + ray_b[0] + ray_c[0]) / 3.0
    y = (ray_a[1] + ray_b[1] + ray_c[1]) / 3.0
    z = (ray_a[2] + ray_b[2] + ray_c[2]) / 3.0
    spread = abs(ray_a[0] - x) + abs(ray_a[1] - y) + abs(ray_a[2] - z)
    spread += abs(ray_b[0] - x) + abs(ray_b[1] - y) + abs(ray_b[2] - z)
    return (x, y, z), spread


@inner
def _write_pose(in_rig, rig_anchor, in_world, world_anchor, pose):
    """The row of [R | t] that takes axes and a point of the world to the rig's."""
    for m in range(3):
        turned = 0.0
        for l in range(3):
            pose[4 * m + l] = (
                in_rig[m] * in_world[l]
                + in_rig[3 + m] * in_world[3 + l]
                + in_rig[6 + m] * in_world[6 + l]
            )
            turned += pose[4 * m + l] * world_anchor[l]
        pose[4 * m + 3] = rig_anchor[m] - turned


@inner
def poses_from_three(rays, points, i, j, k, ranges, poses):
    """Poses from three points and the rays that they lie on.

    Args:
        rays: (N, 6) origins and unit directions in the rig; the origins of rays of one
            camera should be near each other, not far out on the port.
        points: (N, 3) in the world.
        i, j, k: which three.
        ranges: (4, 3) scratch.
        poses: (4, 12) rows of [R | t], rig_from_world, written.

    Returns:
        How many poses there are, at most 4; none if the points are collinear.
    """
    ray_a, ray_b, ray_c = rays[i], rays[j], rays[k]
    a, b, c = points[i], points[j], points[k]
    bc = (b[0] - c[0], b[1] - c[1], b[2] - c[2])
    ac = (a[0] - c[0], a[1] - c[1], a[2] - c[2])
    ab = (a[0] - b[0], a[1] - b[1], a[2] - b[2])
    squares = (dot(bc, bc), dot(ac, ac), dot(ab, ab))
    found = _central_ranges(
        dot(ray_b[3:], ray_c[3:]),
        dot(ray_a[3:], ray_c[3:]),
        dot(ray_a[3:], ray_b[3:]),
        squares[0],
        squares[1],
        squares[2],
        ranges,
    )
    centre, spread = _origins(ray_a, ray_b, ray_c)
    in_world = _frame(a, b, c)
    kept = 0
    for n in range(found):
        row = ranges[n]
        shift = spread / min(row[0], row[1], row[2])
        if not _follow(ray_a, ray_b, ray_c, row, squares, centre, shift):
            continue
        anchor = _on_ray(ray_a, row[0])
        in_rig = _frame(anchor, _on_ray(ray_b, row[1]), _on_ray(ray_c, row[2]))
        pose = poses[kept]
        _write_pose(in_rig, anchor, in_world, a, pose)
        if abs(pose[0]) < math.inf:
            kept += 1
    return kept
