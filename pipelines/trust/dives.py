"""What the program is given, as arrays: a rig file, keypoints and matches; the truth.

One form for simulated observations and for features of real images, so that a mistake
is made in the same way in both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm.calibration.given_accuracy import RigAccuracy
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, stereo_rig
from uwsfm.simulate.sequence import PRESETS, SequenceSpec

ImageKey = tuple[int, int]
"""Camera and frame."""
NOISE_PX = 0.35
"""Per coordinate: what SIFT leaves on the rendered sample."""
WRONG_MATCHES = 0.15
DOME_CENTERS = ((0.002, -0.003, 0.008), (-0.003, 0.001, 0.012))


@dataclass(frozen=True, kw_only=True, eq=False)
class Dive:
    """Two or more cameras that saw the same sea floor."""

    rig: Rig
    """As its user wrote it down."""
    true_rig: Rig
    true_poses: Array
    """(F', 7) rig_from_world of all frames that were taken."""
    names: tuple[str, ...]
    """Of the frames (F)."""
    keypoints: dict[ImageKey, Array]
    """(K, 2) pixels, COLMAP's origin."""
    seen: dict[ImageKey, Array]
    """(K, 2) where the same keypoints were in the image as it was taken."""
    points: dict[ImageKey, IndexArray]
    """(K,) which point of the sea floor each keypoint is of; -1: not known."""
    taken: dict[ImageKey, ImageKey]
    """Which camera took an image, in which frame of ``true_poses``."""
    matches: dict[tuple[ImageKey, ImageKey], IndexArray]
    """(M, 2) keypoints of the one image and of the other."""

    @property
    def num_frames(self) -> int:
        return len(self.names)

    @property
    def images(self) -> list[ImageKey]:
        return [
            (c, f) for f in range(self.num_frames) for c in range(len(self.rig.cameras))
        ]

    def frames(self, image_dir: Path) -> Frames:
        """The frames by name; there need not be files."""
        return Frames(
            image_dir=image_dir,
            folders=tuple(camera.images for camera in self.rig.cameras),
            names=self.names,
        )

    def write_database(self, path: Path) -> None:
        """The database that extraction and matching would leave."""
        number = {key: i + 1 for i, key in enumerate(self.images)}
        frames = self.frames(path.parent)
        with opened(path) as database, pycolmap.DatabaseTransaction(database):
            for c, item in enumerate(self.rig.cameras):
                lens = pycolmap.Camera(
                    camera_id=c + 1,
                    model=item.camera.model_name,
                    width=item.camera.width,
                    height=item.camera.height,
                    params=item.camera.params,
                )
                database.write_camera(lens, use_camera_id=True)
            for (c, f), image_id in number.items():
                name = frames.image_name(c, f)
                image = pycolmap.Image(name=name, camera_id=c + 1, image_id=image_id)
                database.write_image(image, use_image_id=True)
                xy = self.keypoints[c, f].astype(np.float32)
                database.write_keypoints(image_id, xy)
            for (a, b), rows in self.matches.items():
                database.write_matches(number[a], number[b], rows.astype(np.uint32))


def simulated_dive(
    preset: str = "sample",
    *,
    num_frames: int | None = None,
    domes: bool = False,
    num_points: int = 1200,
    seed: int = 0,
) -> Dive:
    """Observations of a preset of ``uwsfm simulate images``, without its images.

    Args:
        preset: A name in `PRESETS`.
        num_frames: Its first frames only; None: all.
        domes: Domes around its cameras, in place of its ports.
        num_points: Seen at least twice.
        seed: Of floor, points, noise and wrong matches, and of the rig: where its ports
            are, and how its cameras are turned against each other.
    """
    spec = _spec(preset, num_frames, domes, seed)
    simulated = simulate_scene(
        spec.rig,
        spec.rig_from_world,
        Relief(stddev=0.1, correlation_length=0.4, seed=seed),
        ObservationOptions(
            num_points=num_points,
            noise_px=NOISE_PX,
            detection_rate=0.6,
            max_range=spec.max_range,
            seed=seed,
        ),
    )
    scene = simulated.scene
    dive = dive_of(
        nominal_rig(spec.rig),
        spec.rig,
        np.asarray(scene.rig_from_world),
        lambda path, frames: write_features(
            path, scene, frames, wrong=WRONG_MATCHES, seed=seed
        ),
    )
    dive = replace(dive, points=points_of(scene, dive.images))
    # Noise moves some of them out of their image, where no feature is found.
    return with_keypoints_moved(dive, lambda c, f, xy: xy, (0, 1))


def points_of(scene: Scene, images: list[ImageKey]) -> dict[ImageKey, IndexArray]:
    """The point of each keypoint, in the order of `write_features`."""
    return {
        (c, f): scene.point_idx[(scene.camera_idx == c) & (scene.frame_idx == f)]
        for c, f in images
    }


def dive_of(
    rig: Rig,
    true_rig: Rig,
    rig_from_world: Array,
    write: Callable[[Path, Frames], None],
) -> Dive:
    """A dive from what writes its database of features."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        frames = frames_of(rig, len(rig_from_world), path.parent)
        write(path, frames)
        return read_dive(path, frames, rig, true_rig, rig_from_world)


def read_dive(
    path: Path, frames: Frames, rig: Rig, true_rig: Rig, rig_from_world: Array
) -> Dive:
    """A dive from a database with keypoints and raw matches."""
    keypoints: dict[ImageKey, Array] = {}
    matches: dict[tuple[ImageKey, ImageKey], IndexArray] = {}
    images = [(c, f) for f in range(len(frames.names)) for c in range(len(rig.cameras))]
    with opened(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        number = {(c, f): ids[frames.image_name(c, f)] for c, f in images}
        for key, image_id in number.items():
            xy = database.read_keypoints(image_id)[:, :2]
            keypoints[key] = xy.astype(np.float64)
        for i, a in enumerate(images):
            for b in images[i + 1 :]:
                rows = database.read_matches(number[a], number[b])
                if len(rows):
                    matches[a, b] = rows.astype(np.int64)
    return Dive(
        # Simulated rigs are exact; a person states no accuracy, so it is assumed.
        rig=replace(rig, accuracy=RigAccuracy()),
        true_rig=true_rig,
        true_poses=np.asarray(rig_from_world, dtype=np.float64),
        names=frames.names,
        keypoints=keypoints,
        seen=keypoints,
        points={key: np.full(len(xy), -1) for key, xy in keypoints.items()},
        taken={key: key for key in images},
        matches=matches,
    )


def with_keypoints_moved(
    dive: Dive, move: Callable[[int, int, Array], Array], cameras: tuple[int, ...]
) -> Dive:
    """Keypoints of some cameras elsewhere; those that leave their image are lost.

    Args:
        dive: Any.
        move: Gives the new pixels (K, 2) of camera and frame; not finite: lost.
        cameras: Whose images change.
    """
    moved, seen, points, kept = {}, {}, {}, {}
    for (c, f), xy in dive.keypoints.items():
        new = move(c, f, xy) if c in cameras else xy
        lens = dive.rig.cameras[c].camera
        with np.errstate(invalid="ignore"):
            inside = (new >= 0.0) & (new <= [lens.width, lens.height])
        keep = inside.all(axis=1) if c in cameras else np.ones(len(xy), dtype=bool)
        moved[c, f], seen[c, f] = new[keep], dive.seen[c, f][keep]
        points[c, f], kept[c, f] = dive.points[c, f][keep], keep
    matches = _matches_of(dive, kept)
    return replace(dive, keypoints=moved, seen=seen, points=points, matches=matches)


def _matches_of(
    dive: Dive, kept: dict[ImageKey, NDArray[np.bool_]]
) -> dict[tuple[ImageKey, ImageKey], IndexArray]:
    """The matches of the keypoints that were kept, in their new numbers."""
    number = {key: np.cumsum(mask) - 1 for key, mask in kept.items()}
    matches = {}
    for (a, b), rows in dive.matches.items():
        good = kept[a][rows[:, 0]] & kept[b][rows[:, 1]]
        rows = rows[good]
        if len(rows):
            new = [number[a][rows[:, 0]], number[b][rows[:, 1]]]
            matches[a, b] = np.column_stack(new)
    return matches


def with_frames_of(dive: Dive, camera: int, source: IndexArray) -> Dive:
    """The images of one camera under the names of other frames.

    Args:
        dive: Any.
        camera: Whose images are renamed.
        source: (F,) which of its images now bears the name of each frame; -1: none, and
            the frame is lost.
    """
    used = np.flatnonzero(source >= 0)
    place: dict[ImageKey, ImageKey] = {}
    for new, f in enumerate(used.tolist()):
        for c in range(len(dive.rig.cameras)):
            place[c, int(source[f]) if c == camera else f] = (c, new)
    names = tuple(dive.names[f] for f in used)
    return renamed(replace(dive, names=names), place)


def renamed(dive: Dive, place: dict[ImageKey, ImageKey]) -> Dive:
    """Images as those of other cameras and frames; those without a place are lost."""
    matches: dict[tuple[ImageKey, ImageKey], IndexArray] = {}
    for (a, b), rows in dive.matches.items():
        if a not in place or b not in place:
            continue
        first, second = place[a], place[b]
        if second[::-1] < first[::-1]:  # frame by frame, as the database has them
            first, second, rows = second, first, rows[:, ::-1]
        matches[first, second] = rows
    return replace(
        dive,
        keypoints={new: dive.keypoints[old] for old, new in place.items()},
        seen={new: dive.seen[old] for old, new in place.items()},
        points={new: dive.points[old] for old, new in place.items()},
        taken={new: dive.taken[old] for old, new in place.items()},
        matches=matches,
    )


def _spec(preset: str, num_frames: int | None, domes: bool, seed: int) -> SequenceSpec:
    """A preset whose rig is drawn: the same lenses, other ports and another toe-in."""
    rng = np.random.default_rng(seed)
    spec = PRESETS[preset]()
    left, right = spec.rig.cameras
    axis = rng.normal(size=3)
    flat = stereo_rig(
        (left.camera, right.camera),
        distance=rng.uniform(0.015, 0.04),
        thickness=0.02,
        tilts_deg=tuple(
            (rng.uniform(0.5, 3.0), rng.uniform(-180.0, 180.0)) for _ in range(2)
        ),
        baseline=0.2,
        right_rotvec_deg=rng.uniform(2.0, 5.0) * axis / np.linalg.norm(axis),
    )
    rig = flat
    if domes:
        ports = [DomePort(place, 0.05, 0.007, 1.49, 1.333) for place in DOME_CENTERS]
        cameras = tuple(
            replace(
                camera,
                port=port,
                refine_normal=False,
                refine_distance=False,
                refine_center=True,
            )
            for camera, port in zip(flat.cameras, ports, strict=True)
        )
        rig = replace(flat, cameras=cameras)
    return replace(spec, rig=rig, rig_from_world=spec.rig_from_world[:num_frames])
