"""The fixed structure of a bundle adjustment: sorted observations and columns.

Observations are sorted by point, then frame, then camera. One point seen from one frame
is a *cell*: only there do point and pose meet, whatever the number of cameras.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals.border import LENS
from uwsfm.scene import IndexArray, Scene

HELD = -1

ShortIndexArray = NDArray[np.int32]
"""Frames and cameras of every observation: half the memory."""


class Layout(NamedTuple):
    """Index arrays that kernels read; K cells, N observations, B border columns."""

    xy: Array
    """(N, 2) observations in sorted order."""
    camera: ShortIndexArray
    """(N,) camera of each sorted observation."""
    cell_start: IndexArray
    """(K + 1,) first observation of each cell."""
    cell_frame: ShortIndexArray
    """(K,) frame of each cell, rising within a point."""
    point_start: IndexArray
    """(P + 1,) first cell of each point."""
    frame_col: IndexArray
    """(F,) first of a frame's 6 columns in the reduced system, or HELD."""
    border_col: IndexArray
    """(C, BORDER_SIZE) column of each camera parameter in the border, or HELD."""
    order: ShortIndexArray
    """(N,) index of each sorted observation in the scene."""
    free_start: IndexArray
    """(C + 1,) first of a camera's entries in ``free_slot``."""
    free_slot: IndexArray
    """Camera parameters that have a column, camera after camera."""
    free_col: IndexArray
    """Their columns."""
    free_lens: bool
    """Whether a lens parameter is among them."""
    num_nav_cols: int
    """6 if nav_from_world is estimated, else 0: after the cameras' columns."""
    num_lengths: int
    """Known lengths, one column each at the end: see
    `uwsfm.solver.linear.quasidefinite`."""

    @property
    def num_frame_cols(self) -> int:
        return 6 * int(np.count_nonzero(self.frame_col != HELD))

    @property
    def num_camera_cols(self) -> int:
        return int(self.border_col.max(initial=-1)) + 1

    @property
    def num_border_cols(self) -> int:
        return self.num_camera_cols + self.num_nav_cols + self.num_lengths

    @property
    def num_unknowns(self) -> int:
        """Of the reduced system; the column of a length is none."""
        return self.num_frame_cols + self.num_camera_cols + self.num_nav_cols


def build_layout(
    scene: Scene,
    border_col: IndexArray,
    held_frames: NDArray[np.bool_] | None = None,
    *,
    navigation: bool = False,
    num_lengths: int = 0,
) -> Layout:
    """Sort a scene's observations.

    Args:
        scene: every point with an observation has at least two.
        border_col: (C, BORDER_SIZE).
        held_frames: (F,) frames that do not move. None: the first observed one, which
            fixes the place of the world.
        navigation: whether nav_from_world is estimated.
        num_lengths: how many lengths are known.

    Raises:
        InputError: the scene has no observations.
    """
    if scene.num_observations == 0:
        raise InputError("the scene has no observations")
    keys = (scene.camera_idx, scene.frame_idx, scene.point_idx)
    order: ShortIndexArray = np.lexsort(keys).astype(np.int32)
    point = scene.point_idx[order].astype(np.int32)
    frame = scene.frame_idx[order].astype(np.int32)
    new_cell = np.ones(len(order), dtype=bool)
    new_cell[1:] = (point[1:] != point[:-1]) | (frame[1:] != frame[:-1])
    starts = np.nonzero(new_cell)[0]
    cells_of_point = np.bincount(point[starts], minlength=scene.num_points)
    observed = np.flatnonzero(np.bincount(frame))
    frame_col = np.full(scene.num_frames, HELD, dtype=np.int64)
    free = observed[1:] if held_frames is None else observed[~held_frames[observed]]
    frame_col[free] = 6 * np.arange(len(free))
    layout = Layout(
        xy=np.ascontiguousarray(scene.xy[order]),
        camera=scene.camera_idx[order].astype(np.int32),
        cell_start=np.append(starts, len(order)).astype(np.int64),
        cell_frame=frame[starts],
        point_start=np.concatenate([[0], np.cumsum(cells_of_point)]).astype(np.int64),
        frame_col=frame_col,
        border_col=border_col,
        order=order,
        free_start=np.empty(0, dtype=np.int64),
        free_slot=np.empty(0, dtype=np.int64),
        free_col=np.empty(0, dtype=np.int64),
        free_lens=False,
        num_nav_cols=6 if navigation else 0,
        num_lengths=num_lengths,
    )
    return with_columns(layout, border_col)


def with_columns(layout: Layout, border_col: IndexArray) -> Layout:
    """The same observations with other border columns (C, BORDER_SIZE)."""
    free = border_col != HELD
    return layout._replace(
        border_col=np.ascontiguousarray(border_col, dtype=np.int64),
        free_start=np.concatenate([[0], np.cumsum(free.sum(axis=1))]).astype(np.int64),
        free_slot=np.nonzero(free)[1].astype(np.int64),
        free_col=np.ascontiguousarray(border_col[free], dtype=np.int64),
        free_lens=bool(np.any(free[:, LENS])),
    )
