"""rig.yaml, the file that describes a camera rig: read, written and explained.

Whatever is wrong with a file ends in one sentence that names the file and the key.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from uwsfm._base.files import replaced_file
from uwsfm._base.yaml import read_yaml
from uwsfm.calibration.given_accuracy import RigAccuracy
from uwsfm.calibration.parameters import OF_RIG
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY
from uwsfm.models.ports.port import Port
from uwsfm.residuals import border
from uwsfm.rig.problems import first_problem
from uwsfm.rig.rig import Rig, RigCamera, refine_flags
from uwsfm.rig.schema import CameraEntry, RadialUndistortionLens, RigFile
from uwsfm.rig.values import ACCURACIES, IMPLAUSIBLE_ALLOWED, checked_baseline

FRESH_WATER = 1.333

# ---- Reading ------------------------------------------------------------------------


def load_rig(path: str | Path) -> Rig:
    """Read and check a rig.yaml.

    Raises:
        InputError: one sentence with the file, the key path and what is wrong.
    """
    token = None
    try:
        data = read_yaml(Path(path))
        # What the images estimated stands, however far it is from any housing.
        anything = data.get("scale") == "arbitrary" or data.get("estimated") is True
        token = IMPLAUSIBLE_ALLOWED.set(anything)
        return _to_rig(RigFile.model_validate(data), Path(path).parent)
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    finally:
        if token is not None:
            IMPLAUSIBLE_ALLOWED.reset(token)


def _to_rig(file: RigFile, folder: Path) -> Rig:
    poses: list[Any] = [IDENTITY]
    baseline = None
    for i, entry in enumerate(file.cameras):
        problem = _placement_problem(entry, i, len(file.cameras))
        if problem:
            raise InputError(f"cameras[{i}]{problem}")
        if i > 0 and entry.cam_from_rig:
            poses.append(entry.cam_from_rig.to_pose())
        if i == 1:
            baseline = entry.baseline_m or float(np.linalg.norm(poses[1][4:]))
    water = file.water.refractive_index
    if isinstance(file.accuracy, str):
        accuracy = RigAccuracy(exact=True)
    else:
        try:
            accuracy = file.accuracy.to_accuracy(folder)
        except InputError as error:
            raise InputError(f"accuracy.covariance: {error}") from None
    rig = Rig(
        cameras=tuple(_rig_camera(entry, water) for entry in file.cameras),
        cam_from_rig=np.array(poses) if len(poses) == len(file.cameras) else None,
        baseline_m=baseline,
        baseline_stddev_m=file.baseline_stddev_m,
        refine_cam_from_rig=file.refine_cam_from_rig,
        accuracy=accuracy,
        verdict=file.verdict,
    )
    _check_accuracy(rig)
    return rig


def _check_accuracy(rig: Rig) -> None:
    """Refuse the accuracy of what this rig does not have."""
    from uwsfm.models.lens import SUPPORTED_MODELS  # compiles kernels: not for init

    models = {camera.camera.model_name for camera in rig.cameras}
    if models <= set(SUPPORTED_MODELS):  # others are refused where they are used
        given = rig.given_accuracy()
        _check_covariance(rig)
        stated = ~given.assumed & (given.stddevs > 0.0)
        if given.correlated_prior and not stated[:, border.LENS].any():
            raise InputError(
                "accuracy.lens_prior: correlated needs the accuracy of a lens, and "
                "none is given: add accuracy.covariance, or focal, principal_point_px "
                "and distortion to the accuracy of a camera, or leave lens_prior out"
            )


def _check_covariance(rig: Rig) -> None:
    """Refuse standard deviations that no single accuracy may have."""
    from uwsfm.calibration.given_accuracy import MAX_CORNER
    from uwsfm.calibration.named_unit import named_unit

    named = rig.accuracy.covariance
    if named is None or IMPLAUSIBLE_ALLOWED.get():
        return
    cameras = rig.cameras_as_given()
    for name, variance in zip(named.names, np.diag(named.matrix), strict=True):
        own, stddev = named_unit(cameras, name), float(np.sqrt(variance))
        most = MAX_CORNER
        if own.key != "distortion":
            most = ACCURACIES[own.key][0]
        if stddev * own.factor >= most:
            raise InputError(
                f"accuracy.covariance: the standard deviation of {name} is "
                f"{stddev:g} {own.unit}".rstrip()
                + f", and must be less than {most / own.factor:.3g}; the matrix holds "
                "variances, the squares of standard deviations"
            )


GLASSY = 1.42
"""No water, and no liquid that is dived in, bends light more."""


def _check_order(port: Port) -> None:
    """Refuse glass and water whose indices are exchanged, or that no window has."""
    if port.refracts and port.n_glass < port.n_water > GLASSY:
        raise InputError(
            f"water.refractive_index: {port.n_water:g} is the index of a glass, and "
            f"glass_index {port.n_glass:g} that of a liquid: are they exchanged? Water "
            "has about 1.333, glass 1.5"
        )
    if not port.refracts or port.thickness == 0.0 or IMPLAUSIBLE_ALLOWED.get():
        return
    if port.n_glass < port.n_water:
        raise InputError(
            f"glass_index: {port.n_glass:g} is less than the water's "
            f"{port.n_water:g}, and no window is made of such a material (acrylic has "
            "1.49, glass 1.46 to 1.52); a port without glass has thickness_m: 0"
        )


def _rig_camera(entry: CameraEntry, n_water: float) -> RigCamera:
    port, lens = entry.port, entry.intrinsics
    conversion = None
    if isinstance(lens, RadialUndistortionLens):
        camera, conversion = lens.converted()
    else:
        camera = lens.to_camera()
    _check_order(port.to_port(n_water))
    return RigCamera(
        name=entry.name,
        images=entry.images,
        camera=camera,
        port=port.to_port(n_water),
        **refine_flags(port.refined),
        valid_radius_px=lens.valid_radius_px,
        conversion_max_px=conversion.max_px if conversion else None,
        conversion_rms_px=conversion.rms_px if conversion else None,
        accuracy=entry.accuracy.to_accuracy(),
    )


def _placement_problem(entry: CameraEntry, i: int, num_cameras: int) -> str:
    """What is wrong with where a camera is said to be, after its key path; or ''."""
    pose, baseline = entry.cam_from_rig, entry.baseline_m
    if i == 0:
        if baseline is not None:
            return ".baseline_m: the first camera is the reference, leave this key out"
        if pose and not np.allclose(pose.to_pose(), IDENTITY, rtol=0, atol=1e-9):
            return ".cam_from_rig: is the identity for the first camera, leave it out"
    elif pose:
        if baseline is not None:
            return ": give cam_from_rig or baseline_m, not both"
        try:
            checked_baseline(math.hypot(*pose.translation_m))
        except InputError as error:
            return f".cam_from_rig.translation_m: {error}"
    elif num_cameras > 2:
        return ": needs cam_from_rig (baseline_m is for rigs of two cameras)"
    elif baseline is None:
        return ": needs cam_from_rig or, if only its length is known, baseline_m"
    return ""


# ---- Writing ------------------------------------------------------------------------


def dump_rig(
    rig: Rig,
    path: str | Path,
    header_comment: str = "",
    comments: Mapping[str, Sequence[str]] | None = None,
    *,
    arbitrary_scale: bool = False,
    estimated: bool = False,
) -> None:
    """Write a rig.yaml that `load_rig` reads back to the same values.

    Args:
        rig: Any rig with air inside its housings.
        path: Replaced as a whole, or left as it was.
        header_comment: Lines for the top of the file, without "#".
        comments: Lines above a camera, by its name; say, standard deviations.
        arbitrary_scale: Its lengths have no unit.
        estimated: It is a result: a length that no housing has is read back as well.
    """
    comments = comments or {}
    unknown = set(comments) - {camera.name for camera in rig.cameras}
    if unknown:
        raise InputError(
            f"comments on cameras that are not in the rig: {sorted(unknown)}"
        )
    top: dict[str, Any] = {
        "version": 1,
        **({"scale": "arbitrary"} if arbitrary_scale else {}),
        "water": {"refractive_index": _common_water(rig)},
    }
    if len(rig.cameras) > 1:
        top["baseline_stddev_m"] = float(rig.baseline_stddev_m)
        top["refine_cam_from_rig"] = rig.refine_cam_from_rig
    if estimated:
        top["estimated"] = True
    if rig.verdict != "fits":
        top["verdict"] = rig.verdict
    top |= _shared_accuracy(rig.accuracy)
    text = _commented(header_comment.splitlines()) + _yaml(top) + "cameras:\n"
    for i, camera in enumerate(rig.cameras):
        lines = [*comments.get(camera.name, ()), *_conversion_lines(camera)]
        block = _commented(lines) + _yaml([_block(rig, i)])
        text += textwrap.indent(block, "  ")
    with replaced_file(Path(path)) as partial:
        partial.write_text(text, encoding="utf-8")


def _conversion_lines(camera: RigCamera) -> list[str]:
    """A comment on a lens that is written in another convention than it was given."""
    if camera.conversion_max_px is None:
        return []
    return [
        "lens: converted from a radial undistortion, off by at most "
        f"{camera.conversion_max_px:.2g} px (RMS {camera.conversion_rms_px:.2g} px)"
    ]


def _block(rig: Rig, i: int) -> dict[str, Any]:
    """The keys of camera ``i``, as `CameraEntry` reads them."""
    camera, lens = rig.cameras[i], rig.cameras[i].camera
    block: dict[str, Any] = {
        "name": camera.name,
        "images": camera.images,
        "intrinsics": {
            "model": lens.model_name,
            "width_px": lens.width,
            "height_px": lens.height,
            "params": lens.params.tolist(),
        },
        "port": _port_block(camera, _common_water(rig)),
    }
    if camera.valid_radius_px is not None:
        block["intrinsics"]["valid_radius_px"] = camera.valid_radius_px
    own = {
        key: list(value) if isinstance(value, tuple) else value
        for key, value in asdict(camera.accuracy).items()
        if value is not None
    }
    if own:
        block["accuracy"] = own
    if i > 0 and rig.cam_from_rig is None:
        block["baseline_m"] = rig.baseline_m
    elif i > 0 and rig.cam_from_rig is not None:
        pose = rig.cam_from_rig[i].tolist()
        block["cam_from_rig"] = {"rotation_xyzw": pose[:4], "translation_m": pose[4:]}
    return block


def _shared_accuracy(accuracy: RigAccuracy) -> dict[str, Any]:
    """The key "accuracy" of the file; nothing if all of it is assumed."""
    if accuracy.exact:
        return {"accuracy": "exact"}
    found: dict[str, Any] = {}
    for key in OF_RIG:
        if getattr(accuracy, key) is not None:
            found[key] = getattr(accuracy, key)
    if accuracy.covariance is not None:
        found["covariance"] = {
            "names": list(accuracy.covariance.names),
            "matrix": accuracy.covariance.matrix.tolist(),
        }
    if accuracy.lens_prior != "independent":
        found["lens_prior"] = accuracy.lens_prior
    return {"accuracy": found} if found else {}


def _common_water(rig: Rig) -> float:
    """The water index of the first port; of a rig without one, that of water, for the
    port that somebody may put there."""
    indices = [c.port.n_water for c in rig.cameras if c.port.refracts]
    return indices[0] if indices else FRESH_WATER


def _port_block(camera: RigCamera, n_water: float) -> dict[str, Any]:
    """The keys of a port, as the entries of `uwsfm.rig.schema` read them."""
    port = camera.port
    if port.n_air != 1.0:
        raise InputError(f"{camera.name}: a rig file has no key for an air index != 1")
    block = {"type": port.word, **port.stated()}
    if port.refracts and port.n_water != n_water:
        block["water_index"] = port.n_water
    if port.refinable:
        block["refine"] = [
            name for name in port.refinable if getattr(camera, f"refine_{name}")
        ]
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
    return files("uwsfm.rig").joinpath("rig_template.yaml").read_text(encoding="utf-8")
