"""The values a bundle adjustment moves, and how a step moves them."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from uwsfm.geometry import rigid3, unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import NUM_PARAMS, with_limit
from uwsfm.models.ports.port import kind_of_row, port_from_row
from uwsfm.models.ports.row import N_GLASS, N_WATER, PLACE, THICKNESS
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import HELD, Layout

# Columns of a port's row that simply add, whatever its kind.
PORT_COLUMNS = {
    border.THICKNESS: THICKNESS,
    border.GLASS_INDEX: N_GLASS,
    border.WATER_INDEX: N_WATER,
}


class KernelState(NamedTuple):
    """The values of all parameters, as rows that kernels read."""

    frames: Array
    """(F, 12) rig_from_world as [R | t]."""
    cams: Array
    """(C, 12) cam_from_rig as [R | t]."""
    arms: Array
    """(C, 9) derivative of the translation by direction (2) and length (1)."""
    lenses: Array
    """(C, LENS_SIZE)"""
    ports: Array
    """(C, PORT_SIZE)"""
    points: Array
    """(P, 3)"""


@dataclass(frozen=True)
class State:
    """Poses, ports and points. A port's distance may pass through negative values here:
    the model is smooth there, a clamp at zero would make false stops."""

    rig_from_world: Array
    cam_from_rig: Array
    ports: Array
    """(C, PORT_SIZE)"""
    points: Array
    lenses: Array
    """(C, LENS_SIZE)"""
    nav_from_world: Array = field(default_factory=lambda: rigid3.IDENTITY)
    """(7,) where the world is in the frame of the position priors."""

    @classmethod
    def from_scene(cls, scene: Scene) -> "State":
        return cls(
            rig_from_world=scene.rig_from_world,
            cam_from_rig=scene.cam_from_rig,
            ports=np.array([port.row for port in scene.ports]),
            points=scene.points,
            lenses=np.array([camera.lens for camera in scene.cameras]),
        )

    def to_scene(self, scene: Scene) -> Scene:
        """The scene with this state's values.

        Raises:
            InputError: a port is not physical (a negative distance, say).
        """
        cameras = tuple(
            camera.with_port(port_from_row(port)).with_lens(lens)
            for camera, port, lens in zip(
                scene.cameras, self.ports, self.lenses, strict=True
            )
        )
        return replace(
            scene,
            cameras=cameras,
            cam_from_rig=self.cam_from_rig,
            rig_from_world=self.rig_from_world,
            points=self.points,
        )

    @property
    def baselines(self) -> Array:
        """(C,) lengths of the translations of cam_from_rig, metres."""
        return np.linalg.norm(self.cam_from_rig[:, 4:], axis=1)

    def kernel_state(self) -> KernelState:
        """The same object whenever it is asked for."""
        return self._rows

    @cached_property
    def _rows(self) -> KernelState:
        return KernelState(
            frames=rigid3.matrix_rows(self.rig_from_world),
            cams=rigid3.matrix_rows(self.cam_from_rig),
            arms=np.array([translation_arm(pose[4:]) for pose in self.cam_from_rig]),
            lenses=self.lenses,
            ports=self.ports,
            points=self.points,
        )

    def moved(self, layout: Layout, step: Array, points_step: Array) -> "State":
        """Apply a step of the reduced system (n,) and of the points (P, 3)."""
        frames_step = np.zeros((len(self.rig_from_world), 6))
        free = layout.frame_col != HELD
        offset = layout.num_frame_cols
        frames_step[free] = step[:offset].reshape(-1, 6)
        deltas = spread_border(layout.border_col, step[offset:])
        nav_step = np.zeros(6)
        if layout.num_nav_cols:
            first = offset + layout.num_camera_cols
            nav_step = step[first : first + layout.num_nav_cols]
        cam_from_rig, ports = self.cam_from_rig.copy(), self.ports.copy()
        for c, delta in enumerate(deltas):
            cam_from_rig[c] = _moved_camera(cam_from_rig[c], delta)
            step = np.append(delta[border.PLACE], delta[border.RADIUS])
            ports[c, PLACE] = kind_of_row(ports[c]).plus(ports[c, PLACE], step)
        for slot, column in PORT_COLUMNS.items():
            ports[:, column] += deltas[:, slot]
        lenses = self.lenses
        if layout.free_lens:
            lenses = lenses.copy()
            lenses[:, :NUM_PARAMS] += deltas[:, border.LENS]
            lenses = np.array([with_limit(row) for row in lenses])
        return replace(
            self,
            rig_from_world=rigid3.perturb(self.rig_from_world, frames_step),
            cam_from_rig=cam_from_rig,
            ports=ports,
            points=self.points + points_step,
            lenses=lenses,
            nav_from_world=rigid3.perturb(self.nav_from_world, nav_step),
        )

    def border_difference(self, reference: "State") -> Array:
        """How far the border is from that of a reference, (C, BORDER_SIZE).

        In the units of a step; rotations and directions of cam_from_rig are left zero.
        """
        difference = np.zeros((len(self.ports), border.BORDER_SIZE))
        difference[:, border.LENGTH] = self.baselines - reference.baselines
        for c, (port, other) in enumerate(
            zip(self.ports, reference.ports, strict=True)
        ):
            step = kind_of_row(port).minus(port[PLACE], other[PLACE])
            difference[c, border.PLACE], difference[c, border.RADIUS] = (
                step[:3],
                step[3],
            )
        for slot, column in PORT_COLUMNS.items():
            difference[:, slot] = self.ports[:, column] - reference.ports[:, column]
        difference[:, border.LENS] = (
            self.lenses[:, :NUM_PARAMS] - reference.lenses[:, :NUM_PARAMS]
        )
        return difference


def spread_border(border_col: IndexArray, step: Array) -> Array:
    """Steps per camera (C, BORDER_SIZE), zero for what is held."""
    padded = np.append(step, 0.0)  # HELD = -1 reads the zero at the end
    return padded[border_col]


def translation_arm(translation: Array) -> Array:
    """Derivative of a translation by its direction (2) and its length (1), as (9,)."""
    length = float(np.linalg.norm(translation))
    if length == 0.0:
        return np.zeros(9)
    direction = translation / length
    sideways = length * unit_vector.tangent_basis(direction).T
    return np.concatenate([sideways.ravel(), direction])


def _moved_camera(cam_from_rig: Array, delta: Array) -> Array:
    """Turn the rotation, then turn and stretch the translation."""
    turn = rigid3.quat_from_rotvec(delta[border.ROTATION])
    quat = rigid3.multiply_quats(turn, cam_from_rig[:4])
    length = float(np.linalg.norm(cam_from_rig[4:]))
    translation = cam_from_rig[4:]
    if length > 0.0:
        direction = unit_vector.plus(translation / length, delta[border.DIRECTION])
        translation = (length + delta[border.LENGTH]) * direction
    return np.concatenate([quat / np.linalg.norm(quat), translation])
