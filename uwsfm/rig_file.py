"""rig.yaml, the file that describes a camera rig: read, written and explained.

Whatever is wrong with a file ends in one sentence that names the file and the key.
"""

from __future__ import annotations

import difflib
import math
import re
import reprlib
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
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
    field_validator,
    model_validator,
)

from uwsfm import rig as limits
from uwsfm._files import replaced_file
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY, Array, from_rotmat
from uwsfm.models.port import FlatPort
from uwsfm.rig import Rig, RigCamera

if TYPE_CHECKING:
    import pycolmap

# ---- The keys of the file -----------------------------------------------------------

_Pixels = Annotated[int, Field(ge=1)]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Index = Annotated[_Number, AfterValidator(limits.checked_index)]
# YAML lists arrive as Python lists; strict mode would take nothing but tuples.
_Numbers = Annotated[tuple[_Number, ...], Field(strict=False)]
_Three = Field(strict=False, min_length=3, max_length=3)
_Four = Field(strict=False, min_length=4, max_length=4)
_Vector = Annotated[tuple[_Number, ...], _Three]
_Quaternion = Annotated[tuple[_Number, ...], _Four, AfterValidator(limits.checked_unit)]
_Matrix = Annotated[tuple[_Vector, ...], _Three]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _Water(_Entry):
    refractive_index: _Index


class _Port(_Entry):
    type: Literal["flat"]
    normal: Annotated[_Vector, AfterValidator(limits.checked_normal)]
    distance_m: Annotated[_Number, AfterValidator(limits.checked_port_distance)]
    thickness_m: Annotated[_Number, AfterValidator(limits.checked_thickness)]
    glass_index: _Index
    refine: Annotated[tuple[Literal["normal", "distance"], ...], Field(strict=False)]


class _ColmapLens(_Entry):
    model: str
    width_px: _Pixels
    height_px: _Pixels
    params: _Numbers

    def to_camera(self) -> pycolmap.Camera:
        return limits.camera_from_colmap(
            self.model, self.width_px, self.height_px, self.params
        )


class _OpenCv(_Entry):
    width_px: _Pixels
    height_px: _Pixels
    camera_matrix: _Matrix
    distortion: _Numbers
    fisheye: bool = False
    pixel_origin: Literal["opencv", "colmap"]


class _OpenCvLens(_Entry):
    opencv: _OpenCv

    def to_camera(self) -> pycolmap.Camera:
        block = self.opencv.model_dump()
        size = block.pop("width_px"), block.pop("height_px")
        return limits.camera_from_opencv(*size, **block)


class _CamFromRig(_Entry):
    rotation_xyzw: _Quaternion | None = None
    rotation_matrix: (
        Annotated[_Matrix, AfterValidator(limits.checked_rotation)] | None
    ) = None
    translation_m: _Vector

    @model_validator(mode="after")
    def _has_one_rotation(self) -> _CamFromRig:
        if (self.rotation_xyzw is None) == (self.rotation_matrix is None):
            raise ValueError("needs one of rotation_xyzw and rotation_matrix")
        return self

    def to_pose(self) -> Array:
        """Row (7,)."""
        if self.rotation_matrix is not None:
            return from_rotmat(self.rotation_matrix, self.translation_m)
        return np.array([*(self.rotation_xyzw or ()), *self.translation_m])


def _lens_tag(value: Any) -> str:
    # Tags show up in pydantic's key paths; the brackets mark them for removal.
    return "(opencv)" if isinstance(value, dict) and "opencv" in value else "(colmap)"


class _Camera(_Entry):
    name: Annotated[str, AfterValidator(limits.checked_text)]
    images: Annotated[str, AfterValidator(limits.checked_folder)]
    intrinsics: Annotated[
        Annotated[_ColmapLens, Tag("(colmap)")]
        | Annotated[_OpenCvLens, Tag("(opencv)")],
        Discriminator(_lens_tag),
    ]
    port: _Port
    cam_from_rig: _CamFromRig | None = None
    baseline_m: Annotated[_Number, AfterValidator(limits.checked_baseline)] | None = (
        None
    )

    @field_validator("intrinsics")
    @classmethod
    def _is_plausible(cls, lens: _ColmapLens | _OpenCvLens) -> Any:
        lens.to_camera()
        return lens


class _RigFile(_Entry):
    version: Literal[1]
    water: _Water
    baseline_stddev_m: Annotated[_Number, Field(ge=0)] = 0.0
    cameras: Annotated[tuple[_Camera, ...], Field(strict=False)]


_ENTRIES: dict[str, type[_Entry]] = {
    "": _RigFile,
    "water": _Water,
    "cameras": _Camera,
    "(colmap)": _ColmapLens,
    "(opencv)": _OpenCvLens,
    "opencv": _OpenCv,
    "port": _Port,
    "cam_from_rig": _CamFromRig,
}


# ---- Reading ------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """Safe YAML that reads 1e-3 as a number and refuses a key given twice."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                problem = f"the key {key.value!r} is given twice"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            seen.add(key.value)
        return node


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def load_rig(path: str | Path) -> Rig:
    """Read and check a rig.yaml.

    Raises:
        InputError: one sentence with the file, the key path and what is wrong.
    """
    try:
        return _to_rig(_RigFile.model_validate(_read_yaml(Path(path))))
    except ValidationError as error:
        raise InputError(f"{path}: {_first_problem(error)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read_yaml(path: Path) -> dict:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("there is no such file") from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError("is not a text file in UTF-8") from None
    try:
        data = yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}: " if mark else ""
        hint = "; indent with spaces, not tabs" if "\\t" in str(error.problem) else ""
        raise InputError(f"{where}not valid YAML: {error.problem}{hint}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"not valid YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(data, dict):
        what = "is empty" if data is None else f"holds {reprlib.repr(data)}"
        raise InputError(f"{what} instead of keys such as 'version: 1'")
    return data


def _to_rig(file: _RigFile) -> Rig:
    poses, baseline = [IDENTITY], 0.0
    for i, entry in enumerate(file.cameras):
        problem = _placement_problem(entry, i, len(file.cameras))
        if problem:
            raise InputError(f"cameras[{i}]{problem}")
        if i > 0 and entry.cam_from_rig:
            poses.append(entry.cam_from_rig.to_pose())
        if i == 1:
            baseline = entry.baseline_m or float(np.linalg.norm(poses[1][4:]))
    water = file.water.refractive_index
    return Rig(
        cameras=tuple(_rig_camera(entry, water) for entry in file.cameras),
        cam_from_rig=np.array(poses) if len(poses) == len(file.cameras) else None,
        baseline_m=baseline,
        baseline_stddev_m=file.baseline_stddev_m,
    )


def _rig_camera(entry: _Camera, n_water: float) -> RigCamera:
    port = entry.port
    x, y, z = port.normal
    return RigCamera(
        name=entry.name,
        images=entry.images,
        camera=entry.intrinsics.to_camera(),
        port=FlatPort(
            (x, y, z), port.distance_m, port.thickness_m, port.glass_index, n_water
        ),
        refine_normal="normal" in port.refine,
        refine_distance="distance" in port.refine,
    )


def _placement_problem(entry: _Camera, i: int, num_cameras: int) -> str:
    """What is wrong with where a camera is said to be, after its key path; or ''."""
    pose, baseline = entry.cam_from_rig, entry.baseline_m
    if i == 0:
        if baseline is not None:
            return (
                ".baseline_m: belongs to the second camera; the first is the reference"
            )
        if pose and not np.allclose(pose.to_pose(), IDENTITY, rtol=0, atol=1e-9):
            return (
                ".cam_from_rig: the first camera is the reference, leave this key out"
            )
    elif pose:
        if baseline is not None:
            return ": give cam_from_rig or baseline_m, not both"
        try:
            limits.checked_baseline(math.hypot(*pose.translation_m))
        except InputError as error:
            return f".cam_from_rig.translation_m: {error}"
    elif num_cameras > 2:
        return ": needs cam_from_rig (baseline_m is for rigs of two cameras)"
    elif baseline is None:
        return ": needs cam_from_rig or, if only its length is known, baseline_m"
    return ""


def _first_problem(error: ValidationError) -> str:
    """The key path and sentence of the first problem, and how many others there are."""
    problems = error.errors(include_url=False)
    unknown = [p for p in problems if p["type"] == "extra_forbidden"]
    # A misspelt key is one mistake, not an unknown key and a missing one.
    meant = {(*p["loc"][:-1], _meant_key(p["loc"])) for p in unknown}
    rest = [p for p in problems if p not in unknown]
    rest = [p for p in rest if p["type"] != "missing" or p["loc"] not in meant]
    first, *others = [*unknown, *rest]
    key_path = ""
    for part in first["loc"]:
        if isinstance(part, int):
            key_path += f"[{part}]"
        elif not part.startswith("("):
            key_path += f".{part}"
    sentence = f"{key_path.lstrip('.')}: {_sentence(first)}"
    if others:
        plural = "s" if len(others) > 1 else ""
        sentence += f" (and {len(others)} more problem{plural} in this file)"
    return sentence


_WANTED = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "text (between quotes if it looks like a number)",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "model_type": "a block of keys",
    "invalid_key": "text",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge:g}",
}


def _sentence(problem: Any) -> str:
    kind, value, context = problem["type"], problem["input"], problem.get("ctx", {})
    if kind == "missing":
        return "this key is missing"
    if kind == "extra_forbidden":
        return _unknown_key(problem["loc"])
    if kind == "value_error":
        return str(context["error"])
    if kind in ("too_short", "too_long"):
        number = context.get("min_length", context.get("max_length"))
        return f"needs {number} values, got {len(value)}"
    if kind not in _WANTED:
        return problem["msg"]
    shown = "empty" if value is None else reprlib.repr(value)
    return f"must be {_WANTED[kind].format(**context)}, not {shown}"


_UNIT = re.compile(
    r"_(m|[mcµu]m|met(er|re)s?|in(ch(es)?)?|ft|px|pixels?|deg|rad|xyzw)$"
)


def _meant_key(loc: tuple[int | str, ...]) -> str | None:
    """The known key nearest to an unknown one: another unit, or a slip of the pen."""
    known, key = _known_keys(loc), str(loc[-1]).lower()
    stem = _UNIT.sub("", key)
    close = [k for k in known if _UNIT.sub("", k) == stem]
    close += difflib.get_close_matches(key, known, n=1)
    return close[0] if close else None


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    parents = [part for part in loc[:-1] if isinstance(part, str)]
    return list(_ENTRIES[parents[-1] if parents else ""].model_fields)


def _unknown_key(loc: tuple[int | str, ...]) -> str:
    meant = _meant_key(loc)
    if meant is None:
        return f"unknown key; the keys here are {', '.join(_known_keys(loc))}"
    unit = {"_m": " (in metres)", "_px": " (in pixels)", "_xyzw": " (w last)"}
    suffix = next((text for end, text in unit.items() if meant.endswith(end)), "")
    return f"unknown key, did you mean {meant}{suffix}?"


# ---- Writing ------------------------------------------------------------------------


def dump_rig(
    rig: Rig,
    path: str | Path,
    header_comment: str = "",
    comments: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write a rig.yaml that `load_rig` reads back to the same values.

    Args:
        rig: Any rig with air inside its housings.
        path: Replaced as a whole, or left as it was.
        header_comment: Lines for the top of the file, without "#".
        comments: Lines above a camera, by its name; say, standard deviations.
    """
    comments = comments or {}
    unknown = set(comments) - {camera.name for camera in rig.cameras}
    if unknown:
        raise InputError(f"comments on cameras that are not in the rig: {unknown}")
    top = {
        "version": 1,
        "water": {"refractive_index": rig.cameras[0].port.n_water},
        "baseline_stddev_m": float(rig.baseline_stddev_m),
    }
    text = _commented(header_comment.splitlines()) + _yaml(top) + "cameras:\n"
    for i, camera in enumerate(rig.cameras):
        block = _commented(comments.get(camera.name, ())) + _yaml([_block(rig, i)])
        text += textwrap.indent(block, "  ")
    with replaced_file(Path(path)) as partial:
        partial.write_text(text, encoding="utf-8")


def _block(rig: Rig, i: int) -> dict[str, Any]:
    """The keys of camera ``i``, as `_Camera` reads them."""
    camera, lens, port = rig.cameras[i], rig.cameras[i].camera, rig.cameras[i].port
    if port.n_air != 1.0:
        raise InputError(f"{camera.name}: rig.yaml has no key for an air index != 1")
    refine = {"normal": camera.refine_normal, "distance": camera.refine_distance}
    block: dict[str, Any] = {
        "name": camera.name,
        "images": camera.images,
        "intrinsics": {
            "model": lens.model_name,
            "width_px": lens.width,
            "height_px": lens.height,
            "params": lens.params.tolist(),
        },
        "port": {
            "type": "flat",
            "normal": list(port.normal),
            "distance_m": port.distance,
            "thickness_m": port.thickness,
            "glass_index": port.n_glass,
            "refine": [name for name, chosen in refine.items() if chosen],
        },
    }
    if i > 0 and rig.cam_from_rig is None:
        block["baseline_m"] = float(rig.baseline_m)
    elif i > 0 and rig.cam_from_rig is not None:
        pose = rig.cam_from_rig[i].tolist()
        block["cam_from_rig"] = {"rotation_xyzw": pose[:4], "translation_m": pose[4:]}
    return block


def _yaml(data: Any) -> str:
    # None: lists of numbers on one line, blocks on several.
    return yaml.safe_dump(
        data,
        default_flow_style=None,
        sort_keys=False,
        allow_unicode=True,
        width=math.inf,
    )


def _commented(lines: Iterable[str]) -> str:
    return "".join(f"# {line}".rstrip() + "\n" for line in lines)


def template() -> str:
    """A rig.yaml to start from, which explains every number."""
    return _TEMPLATE


_TEMPLATE = """\
# A stereo rig behind flat ports, for: uwsfm reconstruct rig.yaml images/ -o out/
# Replace every number by that of your rig. Lengths are in metres (20 mm is 0.020).
# Camera axes: x to the right in the image, y down, z forward, out of the lens.
version: 1

# Fresh water 1.333, sea water 1.339 to 1.343.
water: {refractive_index: 1.333}

# How well the distance between the cameras is known: one standard deviation.
# 0 takes it as exact. It is the only source of scale: 1 % here is 1 % everywhere.
baseline_stddev_m: 0.0

cameras:
  # The first camera is the reference: it has no cam_from_rig.
  - name: left
    images: left            # its folder: images/left/0001.jpg, images/left/0002.jpg ...
    # From a calibration IN AIR, without the port: a chequerboard on the bench, with the
    # lens, focus and zoom of the dive. Here in COLMAP's form: any of its models, params
    # in its order (fx, fy, cx, cy, k1, k2, p1, p2), first pixel centred at (0.5, 0.5).
    intrinsics:
      model: OPENCV
      width_px: 1920
      height_px: 1080
      params: [1400.0, 1400.0, 960.0, 540.0, -0.1, 0.05, 0.0, 0.0]
    port:
      type: flat
      # Unit vector square to the glass, from the camera to the water, along the camera
      # axes. [0, 0, 1]: the camera looks straight through. A good start for most rigs.
      normal: [0.0, 0.0, 1.0]
      # From the camera's centre (its entrance pupil, inside the lens) to the inner side
      # of the glass. A ruler along the lens is good enough: it is refined.
      distance_m: 0.020
      # Calliper or data sheet; index: acrylic 1.49, glass 1.52, sapphire 1.77.
      thickness_m: 0.010
      glass_index: 1.49
      # What the images may correct. [] holds both.
      refine: [normal, distance]

  # Images with the same file name in both folders were taken at the same moment.
  - name: right
    images: right
    # The same kind of calibration, as OpenCV gives it.
    intrinsics:
      opencv:
        width_px: 1920
        height_px: 1080
        camera_matrix:
          - [1400.0, 0.0, 959.5]
          - [0.0, 1400.0, 539.5]
          - [0.0, 0.0, 1.0]
        # k1, k2, p1, p2, then k3 or k3, k4, k5, k6, or none at all: []
        # For cv2.fisheye: its 4 values, and a line "fisheye: true".
        distortion: [-0.1, 0.05, 0.0, 0.0, 0.0]
        # Centre of the first pixel: opencv is (0, 0), colmap is (0.5, 0.5).
        pixel_origin: opencv
    port:
      type: flat
      normal: [0.0, 0.0, 1.0]
      distance_m: 0.020
      thickness_m: 0.010
      glass_index: 1.49
      refine: [normal, distance]
    # From reference coordinates to those of this camera: X_cam = R X_rig + t.
    # A camera 0.2 m to the RIGHT of the reference (+x) sees them 0.2 m further LEFT:
    # its t_x is NEGATIVE. R and T of OpenCV's stereoCalibrate are this R and t (with T
    # in the unit of the board's squares). Other programs may give the inverse.
    cam_from_rig:
      rotation_xyzw: [0.0, 0.0, 0.0, 1.0]   # or rotation_matrix: three rows
      translation_m: [-0.2, 0.0, 0.0]
    # If only the distance between the two cameras is known, instead of cam_from_rig:
    # baseline_m: 0.2
"""
