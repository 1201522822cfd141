"""The keys of rig.yaml and what their values may be, as pydantic models."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Union

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from uwsfm.calibration.given_accuracy import (
    CameraAccuracy,
    NamedCovariance,
    RigAccuracy,
)
from uwsfm.geometry.rigid3 import Array, from_rotmat
from uwsfm.models.ports.kind import FILE_KEYS
from uwsfm.models.ports.port import KINDS, Port
from uwsfm.rig.covariance_file import named_covariance, read_covariance
from uwsfm.rig.rig import (
    camera_from_colmap,
    camera_from_opencv,
    camera_from_radial_undistortion,
)
from uwsfm.rig.values import (
    checked_accuracy,
    checked_baseline,
    checked_center,
    checked_folder,
    checked_index,
    checked_normal,
    checked_port_distance,
    checked_radius,
    checked_rotation,
    checked_text,
    checked_thickness,
    checked_unit,
)

if TYPE_CHECKING:
    import pycolmap

    from uwsfm.models.radial_undistortion import LensConversion

_Pixels = Annotated[int, Field(ge=1, le=100_000)]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Radius = Annotated[_Number, Field(gt=0)]
_Index = Annotated[_Number, AfterValidator(checked_index)]
# YAML lists arrive as Python lists; strict mode would take nothing but tuples.
_Numbers = Annotated[tuple[_Number, ...], Field(strict=False)]
_Three = Field(strict=False, min_length=3, max_length=3)
_Four = Field(strict=False, min_length=4, max_length=4)
_Vector = Annotated[tuple[_Number, ...], _Three]
_Quaternion = Annotated[tuple[_Number, ...], _Four, AfterValidator(checked_unit)]
_Matrix = Annotated[tuple[_Vector, ...], _Three]


class Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class WaterEntry(Entry):
    refractive_index: _Index


def _distance(kind: type[Port]) -> Any:
    check = partial(checked_port_distance, limit=kind.max_distance_m)
    return Annotated[_Number, AfterValidator(check)]


_PORT_KEYS: dict[str, Callable[[type[Port]], Any]] = {
    "normal": lambda kind: Annotated[_Vector, AfterValidator(checked_normal)],
    "distance": _distance,
    "center": lambda kind: Annotated[_Vector, AfterValidator(checked_center)],
    "radius": lambda kind: Annotated[_Number, AfterValidator(checked_radius)],
    "thickness": lambda kind: Annotated[_Number, AfterValidator(checked_thickness)],
    "n_glass": lambda kind: _Index,
}
"""What each number of a port may be, by its kind."""
_WORDS = tuple(kind.word for kind in KINDS)


class PortEntry(Entry):
    """A port; its keys are those of its kind, see `_entry`."""

    kind: ClassVar[type[Port]]
    type: Literal[_WORDS]  # type: ignore[valid-type]

    def to_port(self, n_water: float) -> Port:
        numbers = {name: getattr(self, FILE_KEYS[name]) for name in self.kind.numbers}
        own: float | None = getattr(self, "water_index", None)
        return self.kind.of_numbers(numbers, own or n_water)

    @model_validator(mode="after")
    def _is_one(self) -> PortEntry:
        self.to_port(1.333)
        return self

    @property
    def refined(self) -> tuple[str, ...]:
        return getattr(self, "refine", ())


def _entry(kind: type[Port]) -> type[PortEntry]:
    """The keys of a kind of port: its numbers, its water and what may be refined."""
    keys: dict[str, Any] = {
        FILE_KEYS[name]: (_PORT_KEYS[name](kind), ...) for name in kind.numbers
    }
    if kind.refracts:
        keys["water_index"] = (_Index | None, None)
    if kind.refinable:
        choices = tuple[Literal[kind.refinable], ...]  # type: ignore[name-defined]
        keys["refine"] = (Annotated[choices, Field(strict=False)], ...)
    entry = create_model(f"{kind.__name__}Entry", __base__=PortEntry, **keys)
    entry.kind = kind
    return entry


class UnknownPortEntry(Entry):
    """Its type is what is wrong, whatever else is there."""

    model_config = ConfigDict(extra="ignore")

    type: Literal[_WORDS]  # type: ignore[valid-type]


def _port_tag(value: Any) -> str:
    if not isinstance(value, dict) or "type" not in value:
        return "(flat)"
    return f"({value['type']})" if value["type"] in _WORDS else "(unknown)"


_PORT_ENTRIES = {f"({kind.word})": _entry(kind) for kind in KINDS}
_TAGGED_PORTS = [
    Annotated[entry, Tag(tag)]
    for tag, entry in {**_PORT_ENTRIES, "(unknown)": UnknownPortEntry}.items()
]
if TYPE_CHECKING:
    _AnyPort = PortEntry
else:
    _AnyPort = Annotated[Union[tuple(_TAGGED_PORTS)], Discriminator(_port_tag)]  # noqa: UP007


class ColmapLens(Entry):
    model: str
    width_px: _Pixels
    height_px: _Pixels
    params: _Numbers
    valid_radius_px: _Radius | None = None

    def to_camera(self) -> pycolmap.Camera:
        return camera_from_colmap(
            self.model, self.width_px, self.height_px, self.params
        )


class OpenCvBlock(Entry):
    width_px: _Pixels
    height_px: _Pixels
    camera_matrix: _Matrix
    distortion: _Numbers
    fisheye: bool = False
    pixel_origin: Literal["opencv", "colmap"]


class OpenCvLens(Entry):
    opencv: OpenCvBlock
    valid_radius_px: _Radius | None = None

    def to_camera(self) -> pycolmap.Camera:
        block = self.opencv.model_dump()
        size = block.pop("width_px"), block.pop("height_px")
        return camera_from_opencv(*size, **block)


class RadialUndistortionBlock(Entry):
    width_px: _Pixels
    height_px: _Pixels
    camera_matrix: _Matrix
    undistortion: _Numbers
    pixel_origin: Literal["opencv", "colmap"]


class RadialUndistortionLens(Entry):
    radial_undistortion: RadialUndistortionBlock
    valid_radius_px: _Radius | None = None

    def to_camera(self) -> pycolmap.Camera:
        return self.converted()[0]

    def converted(self) -> tuple[pycolmap.Camera, LensConversion]:
        block = self.radial_undistortion.model_dump()
        size = block.pop("width_px"), block.pop("height_px")
        return camera_from_radial_undistortion(*size, **block)


class CamFromRig(Entry):
    rotation_xyzw: _Quaternion | None = None
    rotation_matrix: Annotated[_Matrix, AfterValidator(checked_rotation)] | None = None
    translation_m: _Vector

    @model_validator(mode="after")
    def _has_one_rotation(self) -> CamFromRig:
        if (self.rotation_xyzw is None) == (self.rotation_matrix is None):
            raise ValueError("needs one of rotation_xyzw and rotation_matrix")
        return self

    def to_pose(self) -> Array:
        """Row (7,)."""
        if self.rotation_matrix is not None:
            return from_rotmat(self.rotation_matrix, self.translation_m)
        return np.array([*(self.rotation_xyzw or ()), *self.translation_m])


_LENS_BLOCKS = ("opencv", "radial_undistortion")


def _lens_tag(value: Any) -> str:
    keys = [str(key).lower() for key in value] if isinstance(value, dict) else []
    for block in _LENS_BLOCKS:
        # A misspelt block is still meant: its error should suggest the right name.
        if difflib.get_close_matches(block, keys, n=1, cutoff=0.7):
            # Tags show up in pydantic's key paths; the brackets mark them for removal.
            return f"({block})"
    return "(colmap)"


_Lens = ColmapLens | OpenCvLens | RadialUndistortionLens
_TaggedLens = Annotated[
    Annotated[ColmapLens, Tag("(colmap)")]
    | Annotated[OpenCvLens, Tag("(opencv)")]
    | Annotated[RadialUndistortionLens, Tag("(radial_undistortion)")],
    Discriminator(_lens_tag),
]


_Stddev = Annotated[_Number, Field(ge=0)]


class AccuracyEntry(Entry):
    """Standard deviations; their keys are those of `ACCURACIES`."""

    @field_validator("*")
    @classmethod
    def _has_the_unit(cls, value: Any, info: ValidationInfo) -> Any:
        checked_accuracy(info.field_name or "", value)
        return value


class CameraAccuracyEntry(AccuracyEntry):
    focal: _Stddev | None = None
    principal_point_px: _Stddev | None = None
    distortion: (
        Annotated[tuple[_Stddev, ...], Field(strict=False, min_length=1)] | None
    ) = None
    thickness_m: _Stddev | None = None
    glass_index: _Stddev | None = None
    radius_m: _Stddev | None = None
    normal_deg: _Stddev | None = None
    distance_m: _Stddev | None = None
    center_m: _Stddev | None = None
    rotation_deg: _Stddev | None = None
    direction_deg: _Stddev | None = None

    def to_accuracy(self) -> CameraAccuracy:
        return CameraAccuracy(**self.model_dump())


class CovarianceBlock(Entry):
    names: Annotated[tuple[str, ...], Field(strict=False, min_length=1)]
    matrix: Annotated[tuple[_Numbers, ...], Field(strict=False)]

    @model_validator(mode="after")
    def _is_a_covariance(self) -> CovarianceBlock:
        self.to_covariance()
        return self

    def to_covariance(self) -> NamedCovariance:
        return named_covariance(self.model_dump())


def _file_or_block(value: Any) -> str:
    return "(file)" if isinstance(value, str) else "(covariance)"


class RigAccuracyEntry(AccuracyEntry):
    baseline_m: _Stddev | None = None
    water_index: _Stddev | None = None
    covariance: (
        Annotated[
            Annotated[str, Tag("(file)")]
            | Annotated[CovarianceBlock, Tag("(covariance)")],
            Discriminator(_file_or_block),
        ]
        | None
    ) = None
    lens_prior: Literal["independent", "correlated"] = "independent"

    def to_accuracy(self, folder: Path) -> RigAccuracy:
        """Args:
        folder: of the rig file, for the name of a file.
        """
        covariance = None
        if isinstance(self.covariance, str):
            covariance = read_covariance(folder / self.covariance)
        elif self.covariance is not None:
            covariance = self.covariance.to_covariance()
        return RigAccuracy(
            baseline_m=self.baseline_m,
            water_index=self.water_index,
            covariance=covariance,
            lens_prior=self.lens_prior,
        )


def _rig_accuracy_tag(value: Any) -> str:
    return "(exact)" if isinstance(value, str) else "(rig accuracy)"


_RigAccuracy = Annotated[
    Annotated[Literal["exact"], Tag("(exact)")]
    | Annotated[RigAccuracyEntry, Tag("(rig accuracy)")],
    Discriminator(_rig_accuracy_tag),
]


class CameraEntry(Entry):
    name: Annotated[str, AfterValidator(checked_text)]
    images: Annotated[str, AfterValidator(checked_folder)]
    intrinsics: _TaggedLens
    port: _AnyPort
    cam_from_rig: CamFromRig | None = None
    baseline_m: Annotated[_Number, AfterValidator(checked_baseline)] | None = None
    accuracy: CameraAccuracyEntry = CameraAccuracyEntry()

    @field_validator("intrinsics")
    @classmethod
    def _is_plausible(cls, lens: _Lens) -> Any:
        lens.to_camera()
        return lens


class RigFile(Entry):
    version: Literal[1]
    scale: Literal["metric", "arbitrary"] = "metric"
    water: WaterEntry
    baseline_stddev_m: Annotated[_Number, Field(ge=0)] = 0.0
    refine_cam_from_rig: bool = True
    estimated: bool = False
    verdict: Literal["fits", "doubtful", "does not fit"] = "fits"
    accuracy: _RigAccuracy = RigAccuracyEntry()
    cameras: Annotated[tuple[CameraEntry, ...], Field(strict=False)]


ENTRIES: dict[str, type[Entry]] = {
    "": RigFile,
    "water": WaterEntry,
    "cameras": CameraEntry,
    "(colmap)": ColmapLens,
    "(opencv)": OpenCvLens,
    "opencv": OpenCvBlock,
    "(radial_undistortion)": RadialUndistortionLens,
    "radial_undistortion": RadialUndistortionBlock,
    **_PORT_ENTRIES,
    "cam_from_rig": CamFromRig,
    "accuracy": CameraAccuracyEntry,
    "(rig accuracy)": RigAccuracyEntry,
    "(covariance)": CovarianceBlock,
}
