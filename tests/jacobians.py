"""One Jacobian check, and the cameras and ports that it is run on."""

from collections.abc import Callable

import numpy as np
import pycolmap

from uwsfm import DomePort, FlatPort, InterfacePort, NoPort
from uwsfm.geometry import unit_vector
from uwsfm.models.ports.port import Port

# Published calibrations: COLMAP's documentation (the first three), EuRoC cam0 (RADIAL
# without its tangential terms; OPENCV, barrel), URIL's StereoPi (OPENCV, pincushion),
# KITTI cam0 (FULL_OPENCV, five terms), the depth camera of an Azure Kinect (all eight),
# TUM-VI cam0 (OPENCV_FISHEYE). The last five are of the size that such lenses have.
_CALIBRATIONS = """
SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
PINHOLE 3072 2304 2560.56 2560.56 1536 1152
SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
RADIAL 752 480 458.654 367.215 248.375 -0.28340811 0.07395907
OPENCV 752 480 458.654 457.296 367.215 248.375 -0.28340811 0.07395907 1.9359e-4 1.762e-5
OPENCV 640 480 501.08 499.89 322.91 249.04 0.1624 -0.2485 -7.29e-4 3.5e-3
FULL_OPENCV 1392 512 984.24 980.81 690 233.2 -0.373 0.204 2.2e-3 1.4e-3 -0.0723 0 0 0
FULL_OPENCV 1024 1024 504.8 505 510.6 504.8 3.87 2.07 1.6e-4 7e-5 0.086 4.2 3.33 0.509
OPENCV_FISHEYE 512 512 190.978 190.973 254.932 256.897 3.48e-3 7.15e-4 -2.05e-3 2.03e-4
SIMPLE_RADIAL_FISHEYE 800 600 400 400 300 0.01
RADIAL_FISHEYE 800 600 400 401 300 0.01 -0.002
THIN_PRISM_FISHEYE 800 600 400 401 399 305 .01 .001 1e-3 2e-3 -2e-4 1e-5 1e-3 -2e-3
FOV 640 480 256 255 319 239 0.92
EUCM 800 600 380 381 400 300 0.58 1.1
"""


def camera_from_line(line: str) -> pycolmap.Camera:
    """A camera from "MODEL width height params..."."""
    model, width, height, *params = line.split()
    return pycolmap.Camera(
        model=model,
        width=int(width),
        height=int(height),
        params=[float(value) for value in params],
    )


EXAMPLE_CAMERAS = [camera_from_line(line) for line in _CALIBRATIONS.split("\n") if line]
CAMERA_IDS = [f"{camera.model_name}{i}" for i, camera in enumerate(EXAMPLE_CAMERAS)]


def tilted(degrees: float, azimuth: float) -> tuple[float, float, float]:
    """Unit normal, tilted against the optical axis; angles in degrees."""
    t, a = np.radians([degrees, azimuth])
    return (
        float(np.sin(t) * np.cos(a)),
        float(np.sin(t) * np.sin(a)),
        float(np.cos(t)),
    )


FLAT_PORTS = {
    "straight": FlatPort(),
    "paper": FlatPort(tilted(2, 40), 0.02, 0.03, 1.5, 1.333),
    "thin acrylic, near": FlatPort(tilted(20, 200), 1e-4, 1e-4, 1.49, 1.34),
    "deep-sea sapphire": FlatPort(tilted(5, -70), 0.2, 0.1, 1.77, 1.35),
    "no glass": FlatPort(tilted(10, 100), 0.05, 0.0, 1.5, 1.333),
    "glass below water": FlatPort(tilted(8, 10), 0.03, 0.02, 1.2, 1.36),
    "air outside": FlatPort(tilted(3, 0), 0.03, 0.01, 1.5, 1.0, 1.333),
}
DOMES = {
    "concentric": DomePort(),
    "a hair off": DomePort((1e-9, 0.0, -2e-9)),
    "forward": DomePort((0.0, 0.0, 0.01)),
    "far off, thick": DomePort((0.01, -0.012, -0.03), 0.05, 0.02, 1.52, 1.334),
    "vacuum's water": DomePort((0.004, 0.0, 0.02), 0.07, 0.0, 1.5, 1.36),
    "filled with oil": DomePort((0.006, -0.004, 0.02), 0.06, 0.01, 1.6, 1.39, 1.3),
}
INTERFACES = {
    "above the surface": InterfacePort(tilted(6, 30), 0.4, 1.333),
    "film": InterfacePort(tilted(15, -110), 1e-3, 1.34),
    "from oil into air": InterfacePort(tilted(4, 60), 0.05, 1.0, 1.4),
}
EXAMPLE_PORTS: dict[str, Port] = {
    **FLAT_PORTS,
    **DOMES,
    **INTERFACES,
    "none": NoPort(),
}
"""Every kind of port, and every index other than one somewhere: a factor of n_air is
one in every housing that is filled with air."""


def _tilt(row: np.ndarray, delta: np.ndarray) -> np.ndarray:
    return np.concatenate([unit_vector.plus(row[:3], delta), row[3:]])


def _add(slots: list[int]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda row, delta: row + delta @ np.eye(len(row))[slots]


def port_blocks(port: Port) -> list[tuple[slice | list[int], Callable, float]]:
    """(columns, step of a port row, size of the differences) of each block of a port.

    Columns count from the port's first one, in the order of
    `uwsfm.models.projection.JAC_SIZE`: normal (2) and distance, or centre (3);
    thickness, n_glass, n_water; radius. Lengths of a flat port may pass through zero:
    its model is smooth there.
    """
    water: tuple[slice | list[int], Callable, float] = ([5], _add([7]), 1e-4)
    glass = [([4], _add([6]), 1e-4), water]
    if isinstance(port, DomePort):
        centre = [(slice(0, 3), _add([0, 1, 2]), 1e-4)]
        return [*centre, ([3], _add([4]), 1e-4), *glass, ([6], _add([3]), 1e-4)]
    window = [(slice(0, 2), _tilt, 1e-4), ([2], _add([3]), 1e-5)]
    if not port.has("thickness") and port.refracts:
        return [*window, water]
    return [*window, ([3], _add([4]), 1e-5), *glass]


def central_differences(
    fn: Callable[[np.ndarray], np.ndarray], size: int, step: float
) -> np.ndarray:
    """d fn / d delta at zero, (..., size), by a five-point stencil.

    Fourth order: with steps of 1e-3 of the scale of the problem, truncation is about
    1e-12 of it and rounding 1e-13 / 1e-3, so that 1e-8 relative is within reach.
    """
    columns = []
    for k in range(size):
        delta = np.zeros(size)
        delta[k] = step
        near, far = fn(delta) - fn(-delta), fn(2 * delta) - fn(-2 * delta)
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=-1)


def check_jacobian(
    fn: Callable[[object], np.ndarray],
    plus: Callable[[object, np.ndarray], object],
    x: object,
    jac: np.ndarray,
    *,
    step: float,
    rtol: float = 1e-6,
    size: float = 0.0,
) -> None:
    """Compare ``jac`` (..., K) with central differences of ``fn`` through ``plus``.

    Args:
        fn: what is differentiated.
        plus: the manifold's step, (x, delta (K,)) -> x.
        x: where.
        jac: the Jacobian to check.
        step: of the differences, in units of delta.
        rtol: relative to the largest entry of the block.
        size: of the numbers that ``fn`` is a difference of, where it is one: pixels.
    """
    numeric = central_differences(lambda delta: fn(plus(x, delta)), jac.shape[-1], step)
    scale = np.abs(numeric).max()
    # The last digit of what is differenced, 4e-13 of pixels of 3000, over the step.
    rounding = 4.0 * np.spacing(max(size, np.abs(fn(x)).max())) / step
    atol = rtol * scale + max(rounding, 1e-9)
    np.testing.assert_allclose(jac, numeric, rtol=0.0, atol=atol)
