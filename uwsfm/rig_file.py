"""rig.yaml, the file that describes a camera rig: read, written and explained.

Whatever is wrong with a file ends in one sentence that names the file and the key.
"""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from uwsfm._files import replaced_file
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY, Array, from_rotmat
from uwsfm.rig import UNIT_TOLERANCE, Rig, RigCamera

if TYPE_CHECKING:
    import pycolmap

# What a hand-copied unit vector, quaternion or rotation may be off by: three decimals.
_COPY_TOLERANCE = 1e-3
_MAX_PORT_LENGTH = 0.5
_MAX_BASELINE = 10.0
# A lens this short sees more than 130 degrees without fisheye: a length in millimetres.
_MIN_FOCAL_PER_SIDE = 0.1


# ---- Values -------------------------------------------------------------------------


class _ProblemAt(ValueError):
    """A problem found above the key it concerns: ``at`` is the rest of the key path."""

    def __init__(self, at: tuple[str | int, ...], sentence: str) -> None:
        super().__init__(sentence)
        self.at = at


def _metres(value: float, noun: str, plural: str, limit: float) -> float:
    if value < 0:
        raise ValueError(f"{value:g} m is negative; a {noun} cannot be")
    if value > limit:
        thousandth = np.format_float_positional(value / 1000, min_digits=3)
        raise ValueError(
            f"{value:g} m is not a {noun}; {plural} are in metres, "
            f"did you mean {thousandth}?"
        )
    return value


def _port_distance(value: float) -> float:
    return _metres(value, "port distance", "distances", _MAX_PORT_LENGTH)


def _glass_thickness(value: float) -> float:
    return _metres(value, "glass thickness", "thicknesses", _MAX_PORT_LENGTH)


def _baseline(value: float) -> float:
    if value == 0:
        raise ValueError("a baseline of 0 m gives no scale")
    return _metres(value, "baseline", "baselines", _MAX_BASELINE)


def _translation(value: tuple[float, ...]) -> tuple[float, ...]:
    _metres(float(np.linalg.norm(value)), "baseline", "baselines", _MAX_BASELINE)
    return value


def _refractive_index(value: float) -> float:
    if not 1 <= value <= 2.5:
        raise ValueError(
            f"{value:g} is not a refractive index; expected 1 to 2.5 "
            "(water about 1.33, acrylic 1.49, glass 1.46 to 1.52)"
        )
    return value


def _not_negative(value: float) -> float:
    if value < 0:
        raise ValueError(f"{value:g} is negative; a standard deviation cannot be")
    return value


def _positive(value: int) -> int:
    if value < 1:
        raise ValueError(f"must be at least 1, not {value}")
    return value


def _three(value: tuple) -> tuple:
    if len(value) != 3:
        raise ValueError(f"needs 3 values, got {len(value)}")
    return value


def _unit(value: tuple[float, ...]) -> tuple[float, ...]:
    length = float(np.linalg.norm(value))
    if abs(length - 1) > _COPY_TOLERANCE:
        raise ValueError(f"must have length 1, has length {length:.4g}")
    if abs(length - 1) <= UNIT_TOLERANCE:  # as written: what was dumped comes back
        return value
    return tuple(v / length for v in value)


def _towards_water(value: tuple[float, ...]) -> tuple[float, ...]:
    if value[2] <= 0:
        raise ValueError(
            "points back at the camera (z must be positive): the normal goes from the "
            "camera to the water, is its sign flipped?"
        )
    return value


def _quaternion(value: tuple[float, ...]) -> tuple[float, ...]:
    if len(value) != 4:
        raise ValueError(f"needs 4 numbers (x, y, z, w), got {len(value)}")
    return _unit(value)


def _rotation(value: tuple) -> tuple:
    matrix = np.array(value)
    off = float(np.max(np.abs(matrix @ matrix.T - np.eye(3))))
    if off > _COPY_TOLERANCE:
        raise ValueError(
            "is not a rotation: its rows should be perpendicular and of length 1, they "
            f"are off by {off:.2g}"
        )
    if np.linalg.det(matrix) < 0:
        raise ValueError("is a reflection (determinant -1), not a rotation")
    return value


def _text(value: str) -> str:
    if not value.strip() or not value.isprintable():
        raise ValueError(f"must be one line of text, not {value!r}")
    return value


def _folder(value: str) -> str:
    path = PurePosixPath(_text(value))
    if "\\" in value:
        raise ValueError(f"write {value!r} with forward slashes")
    if path.is_absolute() or PureWindowsPath(value).drive:
        raise ValueError(
            f"{value!r} is absolute; give the folder inside the image directory"
        )
    if not path.parts or ".." in path.parts:
        raise ValueError(f"{value!r} must name a folder inside the image directory")
    return str(path)


_Number = Annotated[float, Field(allow_inf_nan=False)]
# YAML lists are Python lists: strict mode would take only tuples.
_Numbers = Annotated[tuple[_Number, ...], Field(strict=False)]
_Vector3 = Annotated[_Numbers, AfterValidator(_three)]
_Matrix3 = Annotated[
    tuple[_Vector3, ...], Field(strict=False), AfterValidator(_three)
]
_Index = Annotated[_Number, AfterValidator(_refractive_index)]
_Pixels = Annotated[int, AfterValidator(_positive)]


# ---- Keys ---------------------------------------------------------------------------


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _Water(_Entry):
    refractive_index: _Index


class _Port(_Entry):
    type: Literal["flat"]
    normal: Annotated[_Vector3, AfterValidator(_unit), AfterValidator(_towards_water)]
    distance_m: Annotated[_Number, AfterValidator(_port_distance)]
    thickness_m: Annotated[_Number, AfterValidator(_glass_thickness)]
    glass_index: _Index
    refine: Annotated[
        tuple[Literal["normal", "distance"], ...], Field(strict=False)
    ]


class _Lens(_Entry):
    """Intrinsics by the name and parameters of a COLMAP camera model."""

    model: str
    width_px: _Pixels
    height_px: _Pixels
    params: _Numbers

    @field_validator("model")
    @classmethod
    def _known(cls, model: str) -> str:
        if model not in _lens_models():
            raise ValueError(
                f"{model!r} is not a COLMAP camera model for a flat port; "
                f"choose from {', '.join(_lens_models())}"
            )
        return model

    @field_validator("params")
    @classmethod
    def _plausible(
        cls, params: tuple[float, ...], info: ValidationInfo
    ) -> tuple[float, ...]:
        if not {"model", "width_px", "height_px"} <= info.data.keys():
            return params  # one of these was wrong, and is reported
        camera = _colmap_camera(**info.data, params=params)
        names = camera.params_info.split(", ")
        if len(params) != len(names):
            raise ValueError(
                f"{camera.model_name} has {len(names)} parameters "
                f"({camera.params_info}), got {len(params)}"
            )
        for k in [*camera.focal_length_idxs(), *camera.principal_point_idxs()]:
            side = camera.height if names[k] in ("fy", "cy") else camera.width
            _check_pinhole(names[k], params[k], side)
        return params

    def to_camera(self) -> pycolmap.Camera:
        return _colmap_camera(self.model, self.width_px, self.height_px, self.params)


class _OpenCv(_Entry):
    """Intrinsics as OpenCV's calibrateCamera or fisheye.calibrate return them."""

    width_px: _Pixels
    height_px: _Pixels
    pixel_origin: Literal["opencv", "colmap"]
    fisheye: bool = False
    camera_matrix: _Matrix3
    distortion: _Numbers

    @field_validator("camera_matrix")
    @classmethod
    def _pinhole(cls, matrix: tuple, info: ValidationInfo) -> tuple:
        (fx, skew, cx), (zero, fy, cy), last = matrix
        if skew != 0:
            raise ValueError(
                f"has a skew of {skew:g}; calibrate without skew, no lens model of "
                "COLMAP has one"
            )
        if zero != 0 or last != (0, 0, 1):
            raise ValueError("must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if {"width_px", "height_px", "pixel_origin"} <= info.data.keys():
            shift = _shift_from_origin(info.data["pixel_origin"])
            for name, value in (("fx", fx), ("cx", cx + shift)):
                _check_pinhole(name, value, info.data["width_px"])
            for name, value in (("fy", fy), ("cy", cy + shift)):
                _check_pinhole(name, value, info.data["height_px"])
        return matrix

    @field_validator("distortion")
    @classmethod
    def _number_of_values(
        cls, values: tuple[float, ...], info: ValidationInfo
    ) -> tuple[float, ...]:
        if info.data.get("fisheye"):
            if len(values) != 4:
                raise ValueError(
                    "an OpenCV fisheye calibration has 4 values (k1, k2, k3, k4), "
                    f"got {len(values)}"
                )
        elif len(values) not in (0, 4, 5, 8):
            raise ValueError(
                "needs 0, 4, 5 or 8 values (k1, k2, p1, p2, k3, k4, k5, k6), "
                f"got {len(values)}"
            )
        return values

    def to_camera(self) -> pycolmap.Camera:
        (fx, _, cx), (_, fy, cy), _ = self.camera_matrix
        shift = _shift_from_origin(self.pixel_origin)
        values = self.distortion
        if self.fisheye:
            model = "OPENCV_FISHEYE"
        elif not values:
            model = "PINHOLE"
        elif any(values[4:]):
            model, values = "FULL_OPENCV", (*values, 0.0, 0.0, 0.0)[:8]
        else:
            model, values = "OPENCV", values[:4]
        params = (fx, fy, cx + shift, cy + shift, *values)
        return _colmap_camera(model, self.width_px, self.height_px, params)


class _OpenCvLens(_Entry):
    opencv: _OpenCv

    def to_camera(self) -> pycolmap.Camera:
        return self.opencv.to_camera()


def _lens_kind(value: Any) -> str:
    return "(opencv)" if isinstance(value, dict) and "opencv" in value else "(colmap)"


class _CamFromRig(_Entry):
    rotation_xyzw: Annotated[_Numbers, AfterValidator(_quaternion)] | None = None
    rotation_matrix: Annotated[_Matrix3, AfterValidator(_rotation)] | None = None
    translation_m: Annotated[_Vector3, AfterValidator(_translation)]

    @model_validator(mode="after")
    def _one_rotation(self) -> _CamFromRig:
        if (self.rotation_xyzw is None) == (self.rotation_matrix is None):
            raise ValueError("needs either rotation_xyzw or rotation_matrix")
        return self

    def to_pose(self) -> Array:
        """Row (7,)."""
        if self.rotation_matrix is not None:
            return from_rotmat(self.rotation_matrix, self.translation_m)
        assert self.rotation_xyzw is not None
        return np.array([*self.rotation_xyzw, *self.translation_m])


class _Camera(_Entry):
    name: Annotated[str, AfterValidator(_text)]
    images: Annotated[str, AfterValidator(_folder)]
    # The tags appear in pydantic's key paths; the brackets mark them for removal.
    intrinsics: Annotated[
        Annotated[_Lens, Tag("(colmap)")] | Annotated[_OpenCvLens, Tag("(opencv)")],
        Discriminator(_lens_kind),
    ]
    port: _Port
    cam_from_rig: _CamFromRig | None = None
    baseline_m: Annotated[_Number, AfterValidator(_baseline)] | None = None

    @property
    def baseline(self) -> float:
        """Distance to the reference camera, metres."""
        if self.cam_from_rig is None:
            return self.baseline_m or 0.0
        return float(np.linalg.norm(self.cam_from_rig.translation_m))


class _RigFile(_Entry):
    version: Literal[1]
    water: _Water
    baseline_stddev_m: Annotated[_Number, AfterValidator(_not_negative)] = 0.0
    cameras: Annotated[tuple[_Camera, ...], Field(strict=False)]

    @field_validator("cameras")
    @classmethod
    def _consistent(cls, cameras: tuple[_Camera, ...]) -> tuple[_Camera, ...]:
        if len(cameras) < 2:
            raise ValueError(
                f"{len(cameras)} camera{'' if cameras else 's'} listed, at least two "
                "are needed: the baseline between them is the only source of scale"
            )
        _check_distinct(cameras)
        _check_placement(cameras)
        return cameras

    @model_validator(mode="after")
    def _baseline_is_known(self) -> _RigFile:
        baseline = self.cameras[1].baseline
        if self.baseline_stddev_m > baseline:
            raise _ProblemAt(
                ("baseline_stddev_m",),
                f"{self.baseline_stddev_m:g} m is more than the baseline itself, "
                f"{baseline:g} m",
            )
        return self

    def to_rig(self) -> Rig:
        poses = [c.cam_from_rig.to_pose() for c in self.cameras[1:] if c.cam_from_rig]
        return Rig(
            cameras=tuple(
                _rig_camera(camera, self.water.refractive_index)
                for camera in self.cameras
            ),
            cam_from_rig=np.array([IDENTITY, *poses]) if poses else None,
            baseline_m=self.cameras[1].baseline,
            baseline_stddev_m=self.baseline_stddev_m,
        )
