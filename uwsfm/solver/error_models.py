"""The error functions that the solver can minimise, by name."""

from typing import NamedTuple

import numpy as np

from uwsfm._base.jit import kernel
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import dir_from_img
from uwsfm.models.lens_row import FX, FY
from uwsfm.models.ports.row import DISTANCE, N_AIR, N_GLASS, N_WATER, THICKNESS
from uwsfm.solver.layout import Layout
from uwsfm.solver.state import State

REPROJECTION, VIRTUAL_CAMERA, VIRTUAL_CAMERA_TANGENTIAL, POINT_3D = range(4)

ERROR_CODES = {
    "reprojection": REPROJECTION,
    "virtual_camera": VIRTUAL_CAMERA,
    "virtual_camera_tangential": VIRTUAL_CAMERA_TANGENTIAL,
    "point_3d": POINT_3D,
}
"""Sedlazeck & Koch (BMVC 2011), section 3.1; the virtual camera's centre is the focal
point of the caustic on the axis, or the tangential one."""


class ErrorModel(NamedTuple):
    """What the kernels of `uwsfm.solver.cells` need to know of an error function."""

    code: int
    unit: float
    """Pixels, about, per unit of the error: the losses and the damping are in pixels.
    One number for all observations, so that the minimum is that of the raw error."""
    dirs: Array
    """(N, 3) unit directions in air, in the layout's order; empty for reprojection."""


def error_model(name: str, layout: Layout, state: State) -> ErrorModel:
    """The error function of a name, for a start.

    Raises:
        InputError: a virtual camera would have no focal length.
    """
    code = ERROR_CODES[name]
    if code == REPROJECTION:
        return ErrorModel(code, 1.0, np.empty((0, 3)))
    dirs = np.empty((len(layout.xy), 3))
    _dirs_from_img(layout.xy, layout.camera, state.lenses, dirs)
    focal = np.sqrt(state.lenses[:, FX] * state.lenses[:, FY])
    thick, n_air = state.ports[:, THICKNESS], state.ports[:, N_AIR]
    n_glass, n_water = state.ports[:, N_GLASS], state.ports[:, N_WATER]
    if code == POINT_3D:
        centres = rigid3.inverse(state.rig_from_world)[:, 4:]
        reach = np.median(np.linalg.norm(state.points - centres.mean(axis=0), axis=1))
        return ErrorModel(code, float(np.mean(focal * n_water / n_air) / reach), dirs)
    # Paraxial focal length of the virtual camera, over its magnification n_w.
    length = np.abs(state.ports[:, DISTANCE] + thick * n_air / n_glass)
    if np.any(length == 0.0):
        camera = int(np.flatnonzero(length == 0.0)[0])
        raise InputError(
            f"the port of camera {camera} has no distance and no glass: error {name!r} "
            "is zero there whatever the point, start from a distance"
        )
    return ErrorModel(code, float(np.mean(focal / np.maximum(length, 1e-4))), dirs)


@kernel
def _dirs_from_img(xy, camera, lenses, out):
    for i in range(len(xy)):
        out[i, 0], out[i, 1], out[i, 2] = dir_from_img(
            xy[i, 0], xy[i, 1], lenses[camera[i]]
        )
