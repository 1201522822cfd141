"""A scene as it would have been given with wrong numbers, slot by slot, by hand."""

from dataclasses import fields, replace

import numpy as np

from uwsfm.calibration.assumed import assumed_accuracy
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.models.ports.port import DomePort, FlatPort
from uwsfm.residuals import border

FIELDS = {
    border.WATER_INDEX: "n_water",
    border.THICKNESS: "thickness",
    border.GLASS_INDEX: "n_glass",
    border.RADIUS: "radius",
}


def scaled_accuracy(scene, factor, **options) -> GivenAccuracy:
    """The assumed deviations, times a factor."""
    assumed = assumed_accuracy(scene)
    return GivenAccuracy(
        covariance=factor**2 * assumed.covariance,
        assumed=assumed.assumed,
        names=("left", "right", "third")[: len(scene.cameras)],
        **options,
    )


def with_changes(scene, changes):
    """The same observations; given numbers off by ``changes`` (C, BORDER_SIZE)."""
    rig, cameras = scene.cam_from_rig.copy(), []
    for c, (camera, delta) in enumerate(zip(scene.cameras, changes, strict=True)):
        lens, port = camera.lens.copy(), camera.port
        lens[:12] += delta[border.LENS]
        for slot, name in FIELDS.items():
            if name in {item.name for item in fields(port)}:
                port = replace(port, **{name: getattr(port, name) + delta[slot]})
        if isinstance(port, FlatPort):
            normal = unit_vector.plus(port.normal, delta[border.NORMAL])
            distance = port.distance + delta[border.DISTANCE]
            port = replace(port, normal=tuple(normal), distance=distance)
        elif isinstance(port, DomePort):
            center = np.array(port.center) + delta[border.CENTER]
            port = replace(port, center=tuple(center))
        cameras.append(camera.with_lens(lens).with_port(port))
        if c == 0:
            continue
        turn = rigid3.quat_from_rotvec(delta[border.ROTATION])
        length = np.linalg.norm(rig[c, 4:])
        along = unit_vector.plus(rig[c, 4:] / length, delta[border.DIRECTION])
        rig[c, :4] = rigid3.multiply_quats(turn, rig[c, :4])
        rig[c, 4:] = (length + delta[border.LENGTH]) * along
    return replace(scene, cameras=tuple(cameras), cam_from_rig=rig)
