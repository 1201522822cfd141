"""Slow, obvious oracles, each from another principle than the package's kernels.

Nothing here imports uwsfm: a test that compares with one of these compares two
derivations, not two copies.
"""

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.spatial.transform import Rotation


def plane_axes(normal):
    """Two orthonormal vectors (2, 3) in the plane of a unit normal (3,)."""
    normal = np.asarray(normal, dtype=float)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def least_time_dir(point, normal, distance, thickness, n_air, n_glass, n_water):
    """Unit direction in air of the light from a point, by Fermat's principle.

    The optical path n_a |A| + n_g |B - A| + n_w |X - B| is minimised over the points A
    and B where it crosses the two surfaces of the port: four unknowns, as the paper
    proposes. Newton on the gradient then adds the digits that a minimum, flat to half
    of the digits, cannot give.
    """
    point, normal = np.asarray(point, float), np.asarray(normal, float)
    axes = plane_axes(normal)
    index = np.array([n_air, n_glass, n_water])
    levels = [distance, distance + thickness]
    target, depth = axes @ point, normal @ point
    gaps = np.diff([0.0, *levels, depth])

    def legs(unknowns):
        across = np.diff([np.zeros(2), unknowns[:2], unknowns[2:], target], axis=0)
        return across, np.sqrt(np.sum(across**2, axis=1) + gaps**2)

    def path(unknowns):
        return index @ legs(unknowns)[1]

    def gradient(unknowns):
        across, length = legs(unknowns)
        pull = (index / length)[:, None] * across
        return (pull[:-1] - pull[1:]).ravel()

    def hessian(unknowns):
        across, length = legs(unknowns)
        bend = [
            i * (np.eye(2) / s - np.outer(a, a) / s**3)
            for i, a, s in zip(index, across, length, strict=True)
        ]
        return np.block([[bend[0] + bend[1], -bend[1]], [-bend[1], bend[1] + bend[2]]])

    straight = np.concatenate([level / depth * target for level in levels])
    crossing = minimize(
        path, straight, jac=gradient, hess=hessian, method="trust-exact"
    ).x
    for _ in range(20):
        crossing = crossing - np.linalg.solve(hessian(crossing), gradient(crossing))
    ray = crossing[:2] @ axes + distance * normal
    return ray / np.linalg.norm(ray)


def _refract_by_rotation(ray, normal, index_from, index_to):
    """Paper eq. 2-3: turn the ray about n x ray by theta_out - theta_in."""
    theta_in = np.arccos(min(normal @ ray, 1.0))
    if theta_in < 1e-12:
        return ray  # eq. 3 divides by sin(theta)
    theta_out = np.arcsin(np.sin(theta_in) * index_from / index_to)
    axis = np.cross(normal, ray) / np.sin(theta_in)
    half = 0.5 * (theta_out - theta_in)
    vector, scalar = np.sin(half) * axis / np.linalg.norm(axis), np.cos(half)
    # q v q*, written out for a unit quaternion (vector, scalar)
    twice = 2.0 * np.cross(vector, ray)
    return ray + scalar * twice + np.cross(vector, twice)


def paper_water_ray(ray, normal, distance, thickness, n_air, n_glass, n_water):
    """Sedlazeck & Koch (BMVC 2011) eq. 1-4: (point on the outer surface, direction).

    The printed eq. 3 turns about n x X_a by theta_g - theta_a, and eq. 2 calls the
    index of the glass that of water: both as meant here.
    """
    ray, normal = np.asarray(ray, float), np.asarray(normal, float)
    inner = distance / (normal @ ray) * ray
    in_glass = _refract_by_rotation(ray, normal, n_air, n_glass)
    reach = (thickness + distance - normal @ inner) / (normal @ in_glass)
    in_water = _refract_by_rotation(in_glass, normal, n_glass, n_water)
    return inner + reach * in_glass, in_water


def paper_virtual_error(point, origin, ray, center, normal):
    """Sedlazeck & Koch (BMVC 2011) eq. 6-10 for one observation: projected - observed.

    Eq. 6 prints R_v as the turn about n x e_z by arccos(n_z), and eq. 7 applies it
    transposed. That turn maps n to e_z, so that the virtual camera looks along n, as
    fig. 4 has it, only if it is applied as it is.

    Args:
        point: (3,) X_w, already in the camera frame (first line of eq. 7).
        origin, ray: (3,) X_o and the unit direction in the water.
        center: (3,) C_v, on the caustic.
        normal: (3,) of the port.

    Returns:
        (3,) metres, in the virtual camera, and its rotation from the camera frame.
    """
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    length = np.linalg.norm(axis)
    unit = axis / length if length > 0.0 else np.zeros(3)
    virtual_from_cam = Rotation.from_rotvec(np.arccos(normal[2]) * unit).as_matrix()
    # arccos near 1 gives an angle to 1e-16 / angle only.
    np.testing.assert_allclose(virtual_from_cam @ normal, [0.0, 0.0, 1.0], atol=1e-14)
    x_v = virtual_from_cam @ (point - center)
    x_ov = virtual_from_cam @ (origin - center)
    f_v = (ray @ normal) * np.linalg.norm(center - origin)
    return f_v / x_v[2] * x_v - x_ov, virtual_from_cam


def air_tangent(height, radius, distance, thickness, n_glass, n_water):
    """tan(angle in air) of the ray to a point ``height`` behind a port, off axis.

    By bisection on the angle: how far the ray is carried sideways by the three layers.
    Indices are relative to air.
    """
    critical = np.arcsin(min(1.0, n_glass, n_water))

    def miss(angle):
        carried = distance * np.tan(angle) - radius
        for length, n in ((thickness, n_glass), (height, n_water)):
            carried += length * np.tan(np.arcsin(np.sin(angle) / n))
        return carried

    last = critical * (1.0 - 1e-12)
    if miss(last) < 0.0:
        return np.nan
    return np.tan(brentq(miss, 0.0, last, xtol=1e-15, rtol=1e-15))


def nearest_point(origins, dirs):
    """The point (3,) nearest to rays (N, 3), from stacked equations d x X = d x o."""
    cross = [np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) for x, y, z in dirs]
    rows = np.concatenate(cross)
    right = np.concatenate([c @ o for c, o in zip(cross, origins, strict=True)])
    return np.linalg.lstsq(rows, right, rcond=None)[0]
