"""One Jacobian check, and the cameras and ports that it is run on."""

from collections.abc import Callable

import numpy as np
import pycolmap

from uwsfm import FlatPort

# Published calibrations: COLMAP's documentation (the first three), EuRoC cam0 (RADIAL
# without its tangential terms; OPENCV, barrel), URIL's StereoPi (OPENCV, pincushion),
# KITTI cam0 (FULL_OPENCV, five terms), the depth camera of an Azure Kinect (all eight),
# TUM-VI cam0 (OPENCV_FISHEYE).
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


EXAMPLE_PORTS = {
    "straight": FlatPort(),
    "paper": FlatPort(tilted(2, 40), 0.02, 0.03, 1.5, 1.333),
    "thin acrylic, near": FlatPort(tilted(20, 200), 1e-4, 1e-4, 1.49, 1.34),
    "deep-sea sapphire": FlatPort(tilted(5, -70), 0.2, 0.1, 1.77, 1.35),
    "no glass": FlatPort(tilted(10, 100), 0.05, 0.0, 1.5, 1.333),
    "glass below water": FlatPort(tilted(8, 10), 0.03, 0.02, 1.2, 1.36),
    "air outside": FlatPort(tilted(3, 0), 0.03, 0.01, 1.5, 1.0, 1.333),
}


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
) -> None:
    """Compare ``jac`` (..., K) with central differences of ``fn`` through ``plus``.

    Args:
        fn: what is differentiated.
        plus: the manifold's step, (x, delta (K,)) -> x.
        x: where.
        jac: the Jacobian to check.
        step: of the differences, in units of delta.
        rtol: relative to the largest entry of the block.
    """
    numeric = central_differences(lambda delta: fn(plus(x, delta)), jac.shape[-1], step)
    scale = np.abs(numeric).max()
    np.testing.assert_allclose(jac, numeric, rtol=0.0, atol=rtol * scale + 1e-9)
