"""`RefractiveCamera`: a lens in air behind a port in water."""

import copy
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models import projection
from uwsfm.models.lens import SUPPORTED_MODELS, lens_row, param_slots
from uwsfm.models.ports.caustic import caustic_points
from uwsfm.models.ports.port import KINDS, PlanePort, Port
from uwsfm.models.status import VALID

StatusArray = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class InAirCamera(Protocol):
    """What is read of a `pycolmap.Camera`."""

    width: int
    height: int

    params: Any
    """(K,) numbers."""

    @property
    def model_name(self) -> str: ...

    def cam_ray_from_img(self, image_points: Array) -> Array: ...


def _rows(name: str, values: ArrayLike, columns: int) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(f"{name}.shape={array.shape}, expected (N, {columns})")
    return array


class RefractiveCamera:
    """A camera, calibrated in air, that looks through a port into water.

    Every COLMAP camera model unprojects; the models in `lens.SUPPORTED_MODELS` project
    as well and have Jacobians.

    Args:
        camera: a `pycolmap.Camera` with in-air intrinsics.
        port: the window, in the camera frame; or `NoPort`.

    Raises:
        InputError: the camera's parameters are not usable.
    """

    def __init__(self, camera: InAirCamera, port: Port) -> None:
        if not hasattr(camera, "model_name"):
            raise InputError(f"camera must be a pycolmap.Camera, got {camera!r}")
        if not isinstance(port, Port):
            raise InputError(
                f"port must be one of {', '.join(k.__name__ for k in KINDS)}, got "
                f"{port!r}"
            )
        self._camera = camera
        self._port = port
        self._row = port.row
        self._lens = None
        if camera.model_name in SUPPORTED_MODELS:
            self._lens = lens_row(camera.model_name, camera.params)

    def __repr__(self) -> str:
        model, size = self._camera.model_name, f"{self.width}x{self.height}"
        return f"RefractiveCamera({model}, {size}, {self._port})"

    @property
    def camera(self) -> InAirCamera:
        return self._camera

    @property
    def port(self) -> Port:
        return self._port

    @property
    def width(self) -> int:
        return int(self._camera.width)

    @property
    def height(self) -> int:
        return int(self._camera.height)

    @property
    def lens(self) -> Array:
        """The lens row of `uwsfm.models.lens`.

        Raises:
            InputError: the camera model can only be unprojected.
        """
        if self._lens is None:
            return lens_row(self._camera.model_name, self._camera.params)
        return self._lens

    def with_port(self, port: Port) -> "RefractiveCamera":
        """The same lens behind another port."""
        return RefractiveCamera(self._camera, port)

    def with_lens(self, lens: Array) -> "RefractiveCamera":
        """The same model and port with the parameters of a lens row."""
        if np.array_equal(lens, self.lens):
            return self
        camera = copy.deepcopy(self._camera)
        camera.params = lens[list(param_slots(self._camera.model_name))].tolist()
        return RefractiveCamera(camera, self._port)

    def ray_from_img(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Water rays of pixels (paper eq. 1-4).

        Args:
            xy: (N, 2) pixels; the centre of the first pixel is (0.5, 0.5).

        Returns:
            Origins on the outer surface (N, 3) and unit directions (N, 3) in the camera
            frame; NaN rows where there is no ray (see `status_from_img`).
        """
        rays, _ = self._unproject(xy)
        return np.ascontiguousarray(rays[:, :3]), np.ascontiguousarray(rays[:, 3:])

    def status_from_img(self, xy: ArrayLike) -> StatusArray:
        """Reason codes (N,) of `ray_from_img`, see `uwsfm.Status`."""
        return self._unproject(xy)[1]

    def caustic(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Where the water ray of a pixel meets those of its neighbours (paper fig. 3).

        Args:
            xy: (N, 2) pixels.

        Returns:
            The sagittal focal points, all on the axis through the camera along the
            port's normal, and the tangential ones; (N, 3) each, in the camera frame,
            NaN where the pixel has no ray.

        Raises:
            InputError: the port is no plane.
        """
        if not isinstance(self._port, PlanePort):
            raise InputError(
                f"the caustic is known of planes only, not of {self._port}"
            )
        return caustic_points(*self.ray_from_img(xy), self._port)

    def img_from_point(self, points_in_cam: ArrayLike) -> tuple[Array, Mask]:
        """Exact projection of points in the water.

        Args:
            points_in_cam: (N, 3) in the camera frame, metres.

        Returns:
            Pixels (N, 2), NaN where invalid (they may lie outside the image), and the
            mask ``valid`` (N,). `status_from_point` tells why a point is not valid.

        Raises:
            InputError: the camera model can only be unprojected.
        """
        xy, status = self._project(points_in_cam)
        return xy, status == VALID

    def status_from_point(self, points_in_cam: ArrayLike) -> StatusArray:
        """Reason codes (N,) of `img_from_point`, see `uwsfm.Status`."""
        return self._project(points_in_cam)[1]

    def img_from_point_with_jac(
        self, points_in_cam: ArrayLike
    ) -> tuple[Array, Array, Mask]:
        """`img_from_point`, with its Jacobian.

        Returns:
            Pixels (N, 2), the Jacobian (N, 2, 10) and ``valid`` (N,). The columns are:
            point (3); normal (2, in `unit_vector.tangent_basis`) and distance, or the
            centre (3) of a dome; thickness, n_glass, n_water; radius of a dome.
        """
        points = _rows("points_in_cam", points_in_cam, 3)
        xy = np.empty((len(points), 2))
        jac = np.empty((len(points), 2, projection.JAC_SIZE))
        status = np.empty(len(points), dtype=np.uint8)
        projection.project_with_jac_batch(points, self.lens, self._row, xy, jac, status)
        return xy, jac, status == VALID

    def _project(self, points_in_cam: ArrayLike) -> tuple[Array, StatusArray]:
        points = _rows("points_in_cam", points_in_cam, 3)
        xy = np.empty((len(points), 2))
        status = np.empty(len(points), dtype=np.uint8)
        projection.project_batch(points, self.lens, self._row, xy, status)
        return xy, status

    def _unproject(self, xy: ArrayLike) -> tuple[Array, StatusArray]:
        pixels = _rows("xy", xy, 2)
        rays = np.empty((len(pixels), 6))
        status = np.empty(len(pixels), dtype=np.uint8)
        if self._lens is not None:
            projection.unproject_batch(pixels, self._lens, self._row, rays, status)
            return rays, status
        dirs = np.full((len(pixels), 3), np.nan)
        finite = np.all(np.isfinite(pixels), axis=1)
        dirs[finite] = self._camera.cam_ray_from_img(pixels[finite])
        projection.refract_batch(dirs, self._row, rays, status)
        status[~finite] = projection.NOT_FINITE
        return rays, status
