"""Cameras as they were given, and the accuracy that is assumed of them."""

from collections.abc import Sequence

from uwsfm.calibration.given_accuracy import (
    CameraAccuracy,
    GivenAccuracy,
    GivenCamera,
    RigAccuracy,
    given_accuracy,
)
from uwsfm.calibration.parameters import LENS_NAMES
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import param_slots
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import Scene


def camera_as_given(
    name: str,
    camera: RefractiveCamera,
    translation: Array,
    accuracy: CameraAccuracy | None = None,
) -> GivenCamera:
    """What the accuracy of a camera's numbers depends on.

    Args:
        name: of the camera.
        camera: with the given lens and port.
        translation: (3,) of cam_from_rig; zeros if only its length is known.
        accuracy: None: all of it is assumed.

    Raises:
        InputError: its lens model can only be unprojected.
    """
    port, lens = camera.port, camera.lens  # which refuses other models
    slots = param_slots(camera.camera.model_name)
    return GivenCamera(
        name=name,
        lens=lens,
        param_names=_param_names(slots),
        slots=slots,
        size_px=(camera.width, camera.height),
        port=type(port),
        port_row=port.row,
        translation=translation,
        accuracy=accuracy or CameraAccuracy(),
    )


def _param_names(slots: Sequence[int]) -> tuple[str, ...]:
    """COLMAP's names of a lens model's parameters."""
    if 1 in slots:
        return tuple(LENS_NAMES[slot] for slot in slots)
    names = ["f", "cx", "cy", "k1", "k2"][: len(slots)]
    return tuple(["f", "cx", "cy", "k"] if len(slots) == 4 else names)


def assumed_accuracy(scene: Scene) -> GivenAccuracy:
    """The defaults, of a scene of which nothing else is known."""
    cameras = [
        camera_as_given(f"camera {c}", camera, pose[4:])
        for c, (camera, pose) in enumerate(
            zip(scene.cameras, scene.cam_from_rig, strict=True)
        )
    ]
    return given_accuracy(cameras, RigAccuracy())
