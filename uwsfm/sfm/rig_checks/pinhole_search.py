"""COLMAP's mapper, begun where its model agrees with its own matches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pycolmap

from uwsfm._base.progress import Progress
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.mapping.correspondences import Correspondences, read_correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.initialization import PairSearch, start_tolerance_px
from uwsfm.sfm.noise_floor import NoiseFloor, map_floor
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.mapper import map_images
from uwsfm.sfm.pinhole.mapping_database import image_id_of, indices_of, virtual_rig
from uwsfm.sfm.rig_checks.fixed_rig import FixedRig
from uwsfm.sfm.workspace import Workspace

DOUBTFUL_RATIO = 3.0
"""Of a model's error and its noise floor: pinholes behind ports reach 2, a wrong basin
of forward motion has 10 and more."""
MAX_AGAIN = 3
MIN_SHARE = 0.8
"""Of the frames of the larger of two models: with fewer, a better fit is no gain."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeModels:
    """What COLMAP's mapper made of a mapping database."""

    models: list[pycolmap.Reconstruction]
    """The largest first."""
    floor: NoiseFloor | None
    """Of the first model, in the virtual pinholes."""
    num_starts: int
    """Which beginning, from 1, the models are from."""


def search_models(
    rig: Rig,
    frames: Frames,
    fixed: FixedRig,
    space: Workspace,
    options: StartOptions,
    progress: Progress,
) -> PinholeModels:
    """Map with pinholes, from other pairs as long as the largest model is far above the
    noise floor of its matches: that separates a wrong solution from a right one.

    Args:
        rig: Lenses and initial ports.
        frames: The images.
        fixed: Pinholes and rig of the mapping database.
        space: Where the databases are.
        options: How.
        progress: Called with the step "mapping", in frames.

    Raises:
        UwsfmError: nothing could be reconstructed.
    """
    judge = _Judge(rig, frames, fixed, space, options)
    best: PinholeModels | None = None
    failure: UwsfmError | None = None
    for num_starts, pair in enumerate(islice(judge.beginnings(), 1 + MAX_AGAIN), 1):
        try:
            models = map_images(
                space.mapping, frames, options, first_pair=pair, progress=progress
            )
        except UwsfmError as error:  # another pair may do
            failure = failure or error
            continue
        found = PinholeModels(
            models=models, floor=judge.floor(models[0]), num_starts=num_starts
        )
        best = found if best is None else _better(best, found)
        if not judge.doubts(best):
            break
    if best is None:
        assert failure is not None  # there is always a beginning
        raise failure
    return best


class _Judge:
    """Compares models with the matches that they were made of."""

    def __init__(
        self,
        rig: Rig,
        frames: Frames,
        fixed: FixedRig,
        space: Workspace,
        options: StartOptions,
    ) -> None:
        self.rig = rig
        self.frames = frames
        self.fixed = fixed
        self.options = options
        self.of = read_correspondences(space.features, space.mapping, frames, rig)
        self.virtual = self._in_virtual_pixels()

    def _in_virtual_pixels(self) -> Correspondences:
        xy = np.full_like(self.of.xy, np.nan)
        pairs = zip(self.rig.refractive_cameras(), self.fixed.pinholes, strict=True)
        for c, (camera, pinhole) in enumerate(pairs):
            rows = self.of.camera == c
            xy[rows] = pinhole.img_from_real_img(camera, self.of.xy[rows])
        return replace(self.of, xy=xy)

    def floor(self, model: pycolmap.Reconstruction) -> NoiseFloor | None:
        """Of the matches between the frames of a model."""
        poses = np.tile(rigid3.IDENTITY, (self.of.num_frames, 1))
        registered = np.zeros(self.of.num_frames, dtype=bool)
        for frame_id in model.reg_frame_ids():
            frame = model.frames[frame_id]
            image_id = next(iter(frame.image_ids)).id
            index = indices_of(self.frames, image_id)[1]
            pose = frame.rig_from_world
            assert pose is not None  # of a registered frame
            poses[index] = pose.params
            registered[index] = True
        cameras = [
            RefractiveCamera(pinhole.camera(), NoPort())
            for pinhole in self.fixed.pinholes
        ]
        placement = virtual_rig(self.fixed.rotation.cam_from_rig, self.fixed.pinholes)
        return map_floor(
            self.virtual, registered, cameras, placement, poses, self.options.seed
        )

    def doubts(self, found: PinholeModels) -> bool:
        return found.floor is not None and found.floor.ratio > DOUBTFUL_RATIO

    def beginnings(self) -> Iterator[tuple[int, int] | None]:
        """Images of the first camera to begin with; None: the mapper chooses.

        A rig holds its first frames in place. A single camera that moves forward over
        a flat scene is led astray by the pair that COLMAP likes best.
        """
        if len(self.rig.cameras) > 1:
            yield None
        yield from self._pairs()
        if len(self.rig.cameras) == 1:
            yield None

    def _pairs(self) -> Iterator[tuple[int, int]]:
        """The best first, each once."""
        empty = GrowingMap(
            self.of,
            self.rig.refractive_cameras(),
            self.fixed.rotation.cam_from_rig,
            np.radians(self.options.mapping.min_angle_deg),
        )
        search = PairSearch(
            empty,
            np.ones(self.of.num_frames, dtype=bool),
            start_tolerance_px(empty),
            self.options.scene_distance_m,
            self.options.seed,
        )
        seen: set[tuple[int, int]] = set()
        for beginning in islice(search.beginnings(), 2 * MAX_AGAIN):
            a, b = (image_id_of(self.frames, 0, f) for f in beginning.frames.tolist())
            if (a, b) not in seen:  # a flat pair comes with both of its motions
                seen.add((a, b))
                yield a, b


def _better(best: PinholeModels, other: PinholeModels) -> PinholeModels:
    """More frames; or, where the loser lacks few, the smaller error."""
    most = max(one.models[0].num_reg_frames() for one in (best, other))
    enough = [
        one
        for one in (best, other)
        if one.models[0].num_reg_frames() >= MIN_SHARE * most
    ]
    return min(enough, key=lambda one: one.floor.ratio if one.floor else np.inf)
