"""A rendered reef: 24 stereo frames, the exact range of every pixel."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwsfm.dense.depth_map import pixel_rows
from uwsfm.geometry import rigid3
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.raycasting import RayScene
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rigs import known_cam_from_rig, sample_rig
from uwsfm.simulate.sea_floor import SeaFloorOptions
from uwsfm.simulate.sequence import SequenceSpec, floor_in_view, reseeded
from uwsfm.simulate.trajectories import rich_motion

ASSUMED_PX = 0.3
NUM_RINGS, NUM_STEPS = 8, 5


def reef_spec() -> SequenceSpec:
    """640 x 480, boulders on a relief, 1 to 3 m away."""
    spec = SequenceSpec(
        rig=sample_rig(image_scale=0.8),
        rig_from_world=rich_motion(24, altitude=1.75, extent=0.8),
        floor=SeaFloorOptions(
            relief=Relief(stddev=0.12, correlation_length=0.5),
            num_boulders=14,
            boulder_radius=(0.08, 0.3),
            boulder_extent=1.4,
            texel=0.0008,
            mesh_step=0.012,
        ),
        max_range=4.0,
    )
    spec = replace(spec, sensor=replace(spec.sensor, samples_per_side=2))
    return reseeded(spec, 5)


def floor_of(spec: SequenceSpec) -> RayScene:
    """The surfaces alone: coarse paint, the same shape."""
    return floor_in_view(replace(spec, floor=replace(spec.floor, texel=0.02)))


@dataclass(frozen=True)
class Truth:
    """Of the left images; F frames of H x W pixels."""

    camera: RefractiveCamera
    origins: np.ndarray
    """(H * W, 3) of the water rays, in the camera."""
    dirs: np.ndarray
    ranges: np.ndarray
    """(F, H, W) metres along the water ray."""
    visible: np.ndarray
    """(F, H, W) whether the right image shows the point, nothing in between."""

    @classmethod
    def of(cls, spec: SequenceSpec, cache: Path) -> "Truth":
        left, right = spec.rig.refractive_cameras()
        pose = known_cam_from_rig(spec.rig)[1]
        origins, dirs = left.ray_from_img(pixel_rows(left, 0, left.height))
        if not cache.exists():
            scene = floor_of(spec)
            found = [
                _seen(scene, rig_from_world, (origins, dirs), right, pose)
                for rig_from_world in np.asarray(spec.rig_from_world)
            ]
            shape = len(found), left.height, left.width
            ranges, visible = (
                np.stack(part).reshape(shape) for part in zip(*found, strict=True)
            )
            np.savez(cache, ranges=ranges, visible=visible)
        with np.load(cache) as content:
            return cls(left, origins, dirs, content["ranges"], content["visible"])

    def points(self, frame: int) -> np.ndarray:
        """(H * W, 3) in the left camera."""
        return self.origins + self.ranges[frame].reshape(-1, 1) * self.dirs


def _seen(scene: RayScene, rig_from_world, rays, right, right_from_left):
    """Ranges (N,) and whether the right camera sees the points (N,)."""
    world_from_left = rigid3.inverse(rig_from_world)
    origins = rigid3.transform(world_from_left, rays[0])
    hits = scene.cast(origins, rigid3.rotate(world_from_left, rays[1]))
    ranges = hits.distance.astype(np.float64)
    points = rays[0] + ranges[:, None] * rays[1]
    xy, ok = right.img_from_point(rigid3.transform(right_from_left, points))
    ok &= np.all((xy > 0) & (xy < [right.width, right.height]), axis=1)
    starts, ways = right.ray_from_img(np.where(ok[:, None], xy, 1.0))
    world_from_right = rigid3.compose(world_from_left, rigid3.inverse(right_from_left))
    again = scene.cast(
        rigid3.transform(world_from_right, starts),
        rigid3.rotate(world_from_right, ways),
    )
    in_right = rigid3.transform(right_from_left, points)
    distance = np.linalg.norm(in_right - starts, axis=1)
    # A centimetre: more than single precision and facets can differ by.
    return ranges, ok & (np.abs(again.distance - distance) < 0.01)


@dataclass(frozen=True)
class Scores:
    """Of all depth maps together, against the deviation of 0.3 px of disparity."""

    completeness: float
    """Share of what both cameras see that is within three deviations."""
    median: float
    """Absolute error in deviations."""
    percent_by_radius: list[float]
    """Median relative error of the range, %, in rings from the image centre to its
    corners."""
    percent_by_range: list[float]
    """In fifths of the pixels, the nearest first."""

    @property
    def bend(self) -> float:
        """Largest difference between rings, %."""
        return float(np.ptp(self.percent_by_radius))

    def row(self, name: str) -> str:
        rings = " ".join(f"{value:+.2f}" for value in self.percent_by_radius)
        steps = " ".join(f"{value:+.2f}" for value in self.percent_by_range)
        return (
            f"| {name} | {100 * self.completeness:.1f} | {self.median:.2f} | "
            f"{self.bend:.2f} | {rings} | {steps} |"
        )


def scores(truth: Truth, maps: Iterator[tuple[int, np.ndarray, np.ndarray]]) -> Scores:
    """Of frames, ranges (H, W) and sensitivities (H, W; metres per pixel)."""
    camera = truth.camera
    y, x = np.mgrid[: camera.height, : camera.width]
    radius = np.hypot(x - camera.width / 2, y - camera.height / 2)
    parts = []
    for frame, ranges, sensitivity in maps:
        true, seen = truth.ranges[frame], truth.visible[frame]
        error = (ranges - true)[seen]
        parts.append(
            np.stack([error, ASSUMED_PX * sensitivity[seen], true[seen], radius[seen]])
        )
    error, stddev, true, radius = np.concatenate(parts, axis=1)
    found = np.isfinite(error)
    good = found & (np.abs(error) < 3.0 * stddev)
    percent = 100.0 * error / true

    # Of all that was found: what is within three deviations cannot be far off.
    def medians(values, bounds):
        return [
            float(np.median(percent[found & (values >= low) & (values < high)]))
            for low, high in zip(bounds[:-1], bounds[1:], strict=True)
        ]

    return Scores(
        completeness=float(np.mean(good)),
        median=float(np.median(np.abs(error[found]) / stddev[found])),
        percent_by_radius=medians(radius, np.linspace(0, radius.max(), NUM_RINGS + 1)),
        percent_by_range=medians(
            true, np.percentile(true, np.linspace(0, 100, NUM_STEPS + 1))
        ),
    )
