"""Simulated observations in one .npz file, readable with numpy alone."""

from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.files import replaced_file
from uwsfm._base.npz import read_npz
from uwsfm.errors import InputError
from uwsfm.models.ports.port import port_from_row
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import Scene
from uwsfm.simulate.observations import SimulatedScene

ARRAYS = {
    "camera_model": "(C,) COLMAP model names of the in-air lenses",
    "camera_size": "(C, 2) width and height, pixels",
    "camera_params": "(C, K) in-air intrinsics, padded with NaN",
    "port_rows": "(C, 9) true [Nx, Ny, Nz, distance, thickness, n_a, n_g, n_w, kind]; "
    "kind 0; of a dome [Cx, Cy, Cz, radius, ...], kind 1; none: kind 2",
    "cam_from_rig": "(C, 7) true poses [qx, qy, qz, qw, tx, ty, tz]",
    "rig_from_world": "(F, 7) true poses",
    "points": "(P, 3) true points, metres",
    "camera_idx": "(N,) of each observation",
    "frame_idx": "(N,)",
    "point_idx": "(N,)",
    "xy": "(N, 2) observed pixels; the centre of the first pixel is (0.5, 0.5)",
    "true_xy": "(N, 2) exact projections",
    "is_outlier": "(N,)",
}
"""Names and meaning of the arrays in the file."""


def write_observations(simulated: SimulatedScene, path: Path) -> None:
    """Write the arrays of `ARRAYS`, replacing the file as a whole."""
    truth = simulated.truth
    lenses = [camera.camera for camera in truth.cameras]
    params = np.full((len(lenses), max(len(lens.params) for lens in lenses)), np.nan)
    for row, lens in zip(params, lenses, strict=True):
        row[: len(lens.params)] = lens.params
    with replaced_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            camera_model=np.array([lens.model_name for lens in lenses]),
            camera_size=np.array([[lens.width, lens.height] for lens in lenses]),
            camera_params=params,
            port_rows=np.stack([port.row for port in truth.ports]),
            cam_from_rig=truth.cam_from_rig,
            rig_from_world=truth.rig_from_world,
            points=truth.points,
            camera_idx=truth.camera_idx,
            frame_idx=truth.frame_idx,
            point_idx=truth.point_idx,
            xy=simulated.scene.xy,
            true_xy=truth.xy,
            is_outlier=simulated.is_outlier,
        )


def read_observations(path: Path) -> SimulatedScene:
    """Read what `write_observations` wrote.

    Raises:
        InputError: the file is not there, or not such a file.
    """
    try:
        return _simulated(read_npz(path))
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: not a file of simulated observations: {reason}"
        ) from None


def _simulated(data: dict[str, np.ndarray]) -> SimulatedScene:
    shapes = {name: data[name].shape for name in ARRAYS}
    num_cameras = len(data["camera_model"])
    expected = {
        "camera_size": (num_cameras, 2),
        "camera_params": (num_cameras, *shapes["camera_params"][1:2]),
        "port_rows": (num_cameras, 9),
        "is_outlier": shapes["camera_idx"],
    }
    for name, shape in expected.items():
        if shapes[name] != shape:
            raise InputError(f"{name} has shape {shapes[name]}, expected {shape}")
    cameras = [
        RefractiveCamera(
            pycolmap.Camera(
                model=str(model),
                width=int(size[0]),
                height=int(size[1]),
                params=params[np.isfinite(params)],
            ),
            port_from_row(port),
        )
        for model, size, params, port in zip(
            *(data[name] for name in list(ARRAYS)[:4]), strict=True
        )
    ]
    shared = {name: data[name] for name in list(ARRAYS)[4:10]}
    return SimulatedScene(
        scene=Scene.from_arrays(cameras=cameras, xy=data["xy"], **shared),
        truth=Scene.from_arrays(cameras=cameras, xy=data["true_xy"], **shared),
        is_outlier=data["is_outlier"],
    )
