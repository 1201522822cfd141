"""The perspective start of Sedlazeck & Koch (BMVC 2011), section 3.2.2.

Pinholes stand in for the refractive cameras: focal lengths in water are 1.333 times
those in air, and a radial distortion takes up what it can. A pinhole is a port that
does not refract, so this is the same bundle adjustment as the refractive one.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.result import CalibrateSummary
from uwsfm.geometry.rays import finite_rows
from uwsfm.models.lens_row import CENTER, CX, CY, FX, FY
from uwsfm.models.ports.port import NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import Scene


def perspective_adjustment(
    scene: Scene, *, loss: str = "l2", **options: Any
) -> tuple[Scene, CalibrateSummary]:
    """Bundle adjustment with pinholes: the start that the paper calibrates from.

    Lens distortion is undone first. Rig poses, cam_from_rig (its lengths held), two
    radial distortion parameters per camera and the points are refined.

    Args:
        scene: poses, points and observations to begin with; its ports are not used,
            but for the index of the water.
        loss: as in `CalibrateOptions`.
        **options: further fields of `CalibrateOptions`.

    Returns:
        The scene with the adjusted cam_from_rig, poses and points and its own cameras,
        and what happened; its errors are those of the pinholes, in undistorted pixels.

    Raises:
        InputError: as `calibrate`.
    """
    pinholes, xy = [], np.empty_like(scene.xy)
    for index, camera in enumerate(scene.cameras):
        rows = scene.camera_idx == index
        pinholes.append(_pinhole(camera))
        _, dirs = RefractiveCamera(camera.camera, NoPort()).ray_from_img(scene.xy[rows])
        focal = np.sqrt(camera.lens[FX] * camera.lens[FY])
        xy[rows] = focal * dirs[:, :2] / dirs[:, 2:] + camera.lens[CENTER]
    seen = finite_rows(xy)
    flat, used = replace(scene, cameras=tuple(pinholes), xy=xy).select(seen)
    result = calibrate(
        flat,
        loss=loss,
        refine_normals=False,
        refine_distances=False,
        refine_distortion=True,
        **options,
    )
    points = np.full_like(scene.points, np.nan)
    points[used] = result.scene.points
    adjusted = replace(
        scene,
        cam_from_rig=result.scene.cam_from_rig,
        rig_from_world=result.scene.rig_from_world,
        points=points,
    )
    return adjusted, result.summary


def _pinhole(camera: RefractiveCamera) -> RefractiveCamera:
    """Eq. f_water = 1.333 f_air, without distortion yet."""
    lens, port = camera.lens, camera.port
    focal = port.n_water / port.n_air * np.sqrt(lens[FX] * lens[FY])
    make: Any = type(camera.camera)
    pinhole = make(
        model="RADIAL",
        width=camera.width,
        height=camera.height,
        params=[focal, lens[CX], lens[CY], 0.0, 0.0],
    )
    return RefractiveCamera(pinhole, NoPort())
