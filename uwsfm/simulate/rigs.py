"""Stereo rigs to simulate: the true ones, and the start a user would write down."""

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from uwsfm.calibration.given_accuracy import RigAccuracy
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort, FlatPort, PlanePort, Port
from uwsfm.rig.rig import Rig, RigCamera

PAPER_TILTS_DEG = ((2.0, 40.0), (1.0, -10.0))
"""Tilt and azimuth of the left and the right port normal."""


def tilted_normal(tilt_deg: float, azimuth_deg: float) -> tuple[float, float, float]:
    """Unit normal ``(sin th cos ph, sin th sin ph, cos th)`` in the camera frame."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    x, y = np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth)
    return float(x), float(y), float(np.cos(tilt))


def stereo_rig(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    *,
    distance: float = 0.02,
    thickness: float = 0.005,
    tilts_deg: tuple[tuple[float, float], tuple[float, float]] = PAPER_TILTS_DEG,
    baseline: float = 0.2,
    right_rotvec_deg: ArrayLike = (0.0, 0.0, 0.0),
    n_glass: float = 1.5,
    n_water: float = 1.333,
) -> Rig:
    """A left and a right camera, each behind its own flat port.

    Args:
        cameras: The in-air cameras, left (reference) and right.
        distance: Camera centre to the inner surface of the port, metres.
        thickness: Of the glass, metres.
        tilts_deg: Tilt and azimuth of each port normal, degrees.
        baseline: The right camera centre is at (baseline, 0, 0) in the rig, metres.
        right_rotvec_deg: Rotation vector (3,) of the right camera, degrees.
        n_glass: Refractive index of the ports.
        n_water: Refractive index of the water.
    """
    ports = [
        FlatPort(tilted_normal(*tilt), distance, thickness, n_glass, n_water)
        for tilt in tilts_deg
    ]
    quat = rigid3.quat_from_rotvec(np.radians(np.asarray(right_rotvec_deg, float)))
    rotation = np.concatenate([quat, np.zeros(3)])
    right_in_rig = np.array([baseline, 0.0, 0.0])
    right_from_rig = np.concatenate([quat, -rigid3.rotate(rotation, right_in_rig)])
    for camera in cameras:
        camera.has_prior_focal_length = True  # calibrated in air, by construction
    return Rig(
        cameras=tuple(
            RigCamera(
                name=name,
                images=name,
                camera=camera,
                port=port,
                refine_normal=True,
                refine_distance=True,
            )
            for name, camera, port in zip(
                ("left", "right"), cameras, ports, strict=True
            )
        ),
        cam_from_rig=np.stack([rigid3.IDENTITY, right_from_rig]),
        baseline_m=baseline,
        baseline_stddev_m=0.0,
        accuracy=RigAccuracy(exact=True),
    )


def paper_rig(
    *, thickness: float = 0.005, focal_px: float = 1000.0, distance: float = 0.02
) -> Rig:
    """The rig of Sedlazeck & Koch (BMVC 2011): 1200x900, 200 mm, tilts 2 and 1 deg."""
    left, right = (
        pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=1200,
            height=900,
            params=[focal_px, 600.0, 450.0],
        )
        for _ in range(2)
    )
    return stereo_rig((left, right), distance=distance, thickness=thickness)


def sample_rig(*, image_scale: float = 1.0) -> Rig:
    """The rig of the rendered sample: wide lenses, thick glass, toed-in cameras.

    Args:
        image_scale: Scales the 800x600 images, the focal lengths with them.
    """
    left = [591.4, 590.9, 404.7, 297.2, -0.052, 0.018, 2e-4, -1e-4]
    right = [594.1, 594.8, 396.3, 303.9, -0.047, 0.015, -1e-4, 2e-4]
    size = {"width": round(800 * image_scale), "height": round(600 * image_scale)}
    cameras = tuple(
        pycolmap.Camera(
            model="OPENCV",
            params=[value * image_scale for value in row[:4]] + row[4:],
            **size,
        )
        for row in (left, right)
    )
    return stereo_rig(
        (cameras[0], cameras[1]),
        thickness=0.02,
        right_rotvec_deg=(0.6, 1.9, -0.8),
    )


def known_cam_from_rig(rig: Rig) -> Array:
    """Where the cameras of a rig are (C, 7).

    Raises:
        InputError: only the baseline length of the rig is known.
    """
    if rig.cam_from_rig is None:
        raise InputError("a simulated rig needs its cam_from_rig, not only a baseline")
    return rig.cam_from_rig


def nominal_rig(rig: Rig, *, distance_scale: float = 0.5) -> Rig:
    """What a user would write: straight ports, a rough guess of their distances."""
    ports = [rough_port(c.port, distance_scale=distance_scale) for c in rig.cameras]
    return rig.with_geometry(known_cam_from_rig(rig), ports)


def rough_port(
    port: Port, *, straight: bool = True, distance_scale: float = 0.5
) -> Port:
    """A guess of a port: straight or concentric, at a share of its distance."""
    if isinstance(port, PlanePort):
        normal = (0.0, 0.0, 1.0) if straight else port.normal
        return port.changed(normal=normal, distance=distance_scale * port.distance)
    if isinstance(port, DomePort) and straight:
        return replace(port, center=(0.0, 0.0, 0.0))
    return port
