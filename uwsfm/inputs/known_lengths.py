"""What a user knows of lengths, by the names of images and frames, put into a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.calibration.lengths import Distances, Lengths, Positions
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.inputs.lengths_file import (
    Click,
    LengthsFile,
    PositionTable,
    ScaleBar,
    load_lengths,
    load_positions,
)
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene

LONGEST_ARM_M = 30.0
"""Of a lever arm; longer ones are millimetres."""
WRONG_UNIT = 5.0
"""Times as long as in a metric map, or shorter: no error of measurement."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownLengths:
    """What a user gives besides the rig, by the names of images and frames."""

    file: LengthsFile | None = None
    source: str = ""
    """Of ``file``."""
    table: PositionTable | None = None
    lever_arm: Array

    @classmethod
    def read(
        cls,
        lengths: str | Path | None,
        positions: str | Path | None,
        lever_arm: ArrayLike | None,
    ) -> KnownLengths:
        """Read the files that are given.

        Raises:
            InputError: as `load_lengths` and `load_positions`; or a lever arm that is
                not three numbers, or has no positions.
        """
        arm = np.zeros(3) if lever_arm is None else np.asarray(lever_arm, dtype=float)
        if arm.shape != (3,) or not np.all(np.isfinite(arm)):
            raise InputError(
                f"--lever-arm (lever_arm) must be three numbers, got {arm.tolist()}"
            )
        if np.abs(arm).max() > LONGEST_ARM_M:
            raise InputError(
                f"--lever-arm (lever_arm) {arm.tolist()} is in metres: the antenna is "
                f"not {np.abs(arm).max():g} m away from the camera"
            )
        if lever_arm is not None and positions is None:
            raise InputError("--lever-arm (lever_arm) has no effect without positions")
        return cls(
            file=None if lengths is None else load_lengths(lengths),
            source=str(lengths),
            table=None if positions is None else load_positions(positions),
            lever_arm=arm,
        )

    @property
    def given(self) -> bool:
        """Whether there is any."""
        return self.file is not None or self.table is not None

    def check_names(self, rig: Rig, frame_names: Sequence[str]) -> None:
        """Refuse names that no image has.

        Raises:
            InputError: the first name that is unknown.
        """
        known = set(frame_names)
        if self.table is not None:
            unknown = [name for name in self.table.frames if name not in known]
            if unknown:
                raise InputError(
                    f"{self.table.source}: frame {unknown[0]!r} is not among the "
                    f"images, whose names are like {frame_names[0]!r}"
                    + (f" (nor are {len(unknown) - 1} more)" if unknown[1:] else "")
                )
        if self.file is None:
            return
        for i, distance in enumerate(self.file.frame_distances):
            for name in distance.frames:
                if name not in known:
                    raise InputError(
                        f"{self.source}: frame_distances[{i}].frames: {name!r} is not "
                        f"among the images, whose names are like {frame_names[0]!r}"
                    )
        images = image_index(rig, frame_names)
        for i, bar in enumerate(self.file.scale_bars):
            for j, clicks in enumerate(bar.ends):
                for click in clicks:
                    check_click(
                        f"{self.source}: scale_bars[{i}].ends[{j}]", click, images, rig
                    )

    def placed(
        self, rig: Rig, frame_names: Sequence[str], scene: Scene
    ) -> tuple[Scene, Lengths | None]:
        """A scene with the ends of scale bars as points of its own, and its lengths.

        Args:
            rig: whose folders the images are in.
            frame_names: (F,) of the scene's frames; what is said of others is left out.
            scene: its points and observations keep their indices.

        Raises:
            InputError: an end of a scale bar, or a frame of a distance, is not there.
        """
        if not self.given:
            return scene, None
        index = {name: f for f, name in enumerate(frame_names)}
        lengths = Lengths()
        if self.table is not None:
            lengths = replace(lengths, positions=self._positions(self.table, index))
        if self.file is not None and self.file.frame_distances:
            known = self._distances(index)
            if rig.baseline_m is not None:
                self._check_distances(known, scene)
            lengths = replace(lengths, between_frames=known)
        if self.file is not None and self.file.scale_bars:
            ends = _Ends(self.source, self.file.scale_bars)
            scene, lengths = ends.placed(scene, lengths, image_index(rig, frame_names))
        return scene, lengths

    def _positions(self, table: PositionTable, index: dict[str, int]) -> Positions:
        rows = [row for row, name in enumerate(table.frames) if name in index]
        if len(rows) < 3:
            raise InputError(
                f"{table.source}: {len(rows)} positions belong to frames of the model: "
                "at least 3 are needed"
            )
        return Positions.from_arrays(
            [index[table.frames[row]] for row in rows],
            table.positions[rows],
            table.stddevs[rows],
            self.lever_arm,
            table.source,
            [not table.depths_only, not table.depths_only, True],
        )

    def _check_distances(self, known: Distances, scene: Scene) -> None:
        """Refuse lengths that a metric map contradicts grossly: another unit."""
        centers = rigid3.inverse(scene.rig_from_world)[:, 4:]
        first, second = known.ends.T
        found = np.linalg.norm(centers[first] - centers[second], axis=1)
        for i, (length, there) in enumerate(zip(known.lengths_m, found, strict=True)):
            if not 1.0 / WRONG_UNIT < length / max(there, 1e-9) < WRONG_UNIT:
                raise InputError(
                    f"{self.source}: frame_distances[{i}].length_m: {length:g} m, but "
                    f"by the rig's baseline these frames are {there:.3g} m apart: is "
                    "it in metres, and of these frames?"
                )

    def _distances(self, index: dict[str, int]) -> Distances:
        assert self.file is not None
        ends = []
        for i, item in enumerate(self.file.frame_distances):
            for name in item.frames:
                if name not in index:
                    raise InputError(
                        f"{self.source}: frame_distances[{i}]: frame {name!r} is not "
                        "in the model"
                    )
            ends.append([index[name] for name in item.frames])
        items = self.file.frame_distances
        return Distances.from_arrays(
            ends, [i.length_m for i in items], [i.stddev_m for i in items]
        )


def image_index(rig: Rig, frame_names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """(camera, frame) of each image by its name, "folder/file"."""
    return {
        str(PurePosixPath(camera.images) / name): (c, f)
        for c, camera in enumerate(rig.cameras)
        for f, name in enumerate(frame_names)
    }


def check_click(
    where: str, click: Click, images: dict[str, tuple[int, int]], rig: Rig
) -> None:
    if click.image not in images:
        raise InputError(
            f"{where}: {click.image!r} is not among the images, whose names are like "
            f"{next(iter(images))!r}"
        )
    camera: Any = rig.cameras[images[click.image][0]].camera
    x, y = click.xy
    if not (0.0 <= x <= camera.width and 0.0 <= y <= camera.height):
        raise InputError(
            f"{where}: xy ({x:g}, {y:g}) is outside of {click.image}, which has "
            f"{camera.width}x{camera.height} pixels"
        )


@dataclass(frozen=True)
class _Ends:
    """The ends of scale bars, as points and observations of their own."""

    source: str
    bars: Sequence[ScaleBar]

    def placed(
        self, scene: Scene, lengths: Lengths, images: dict[str, tuple[int, int]]
    ) -> tuple[Scene, Lengths]:
        rows: list[tuple[int, int, int]] = []
        pixels: list[tuple[float, float]] = []
        for i, bar in enumerate(self.bars):
            for j, clicks in enumerate(bar.ends):
                seen = [click for click in clicks if click.image in images]
                if len({click.image for click in seen}) < 2:
                    raise InputError(
                        f"{self.source}: scale_bars[{i}].ends[{j}]: it takes two "
                        "different images of the model to place it, there are "
                        f"{len({click.image for click in seen})}"
                    )
                point = scene.num_points + 2 * i + j
                rows += [(*images[click.image], point) for click in seen]
                pixels += [click.xy for click in seen]
        camera, frame, point_idx = (_column(rows, k) for k in range(3))
        first = scene.num_points + 2 * np.arange(len(self.bars))
        clicked = scene.num_observations + np.arange(len(rows))
        placed = replace(
            scene,
            points=np.vstack([scene.points, np.full((2 * len(self.bars), 3), np.nan)]),
            camera_idx=np.append(scene.camera_idx, camera),
            frame_idx=np.append(scene.frame_idx, frame),
            point_idx=np.append(scene.point_idx, point_idx),
            xy=np.vstack([scene.xy, np.array(pixels)]),
        )
        known = Distances.from_arrays(
            np.column_stack([first, first + 1]),
            [bar.length_m for bar in self.bars],
            [bar.stddev_m for bar in self.bars],
        )
        noise = np.array([bar.click_stddev_px for bar in self.bars])
        return placed, replace(
            lengths, between_points=known, clicked=clicked, click_stddevs_px=noise
        )


def _column(rows: list[tuple[int, int, int]], k: int) -> IndexArray:
    return np.array([row[k] for row in rows], dtype=np.int64)
