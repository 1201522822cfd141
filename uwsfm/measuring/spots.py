"""From picks to places with what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from uwsfm.calibration.clicks import MAX_MISS, pixels_by_point
from uwsfm.calibration.point_placement import misses, placed
from uwsfm.calibration.propagation import Places, Propagation
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.inputs.known_lengths import check_click, image_index
from uwsfm.measuring.measurements_file import Task
from uwsfm.measuring.picks import Pick, PixelPick, PointPick, WorldPick
from uwsfm.measuring.surface import (
    Surface,
    SurfaceImage,
    model_surface,
    surface_of,
    views_of,
)
from uwsfm.results.folder import Result
from uwsfm.scene import IndexArray, Scene

SUSPICIOUS = 4.0
"""Standard deviations that clicks may miss each other by without a word."""


@dataclass(frozen=True, eq=False)
class Spot:
    """A pick, and how it was placed."""

    pick: Pick
    how: str
    num_images: int
    miss_px: float | None = None
    """By which clicks miss each other: RMS, corrected for the place fitted."""
    note: str | None = None
    moved_by: float | None = None
    """From the place that was typed to the point that is meant by it, in the unit of
    the model; None: no place was typed."""


@dataclass(eq=False)
class _Rays:
    """A place by its rays, before the model's errors reach it."""

    camera_idx: IndexArray
    frame_idx: IndexArray
    xy: Array
    stddev_px: float
    point: Array
    extra: Array
    """(3, 3) covariance besides that of the rays."""
    stated: float = np.nan
    """Standard deviation that a cloud states along ``sight``."""
    sight: Array | None = None


class Spotter:
    """Finds the places of picks in one result."""

    def __init__(self, result: Result, propagation: Propagation) -> None:
        self.result, self.propagation = result, propagation
        self.scene = result.model.scene
        model = result.model
        self._images = {
            name: place
            for name, place in image_index(model.rig, model.frame_names).items()
            if model.has_image(*place)
        }
        self._spots: list[Spot] = []
        self._sources: list[int | _Rays] = []
        """Of each spot: a point of the model, or rays."""
        self._known: dict[tuple, int] = {}
        self._last: tuple[tuple[int, int], SurfaceImage] | None = None

    @cached_property
    def surface(self) -> Surface:
        return surface_of(self.result)

    @cached_property
    def _model(self) -> Surface:
        return self.surface if self.surface.is_model else model_surface(self.scene)

    def rows_of(self, task: Task) -> list[int]:
        """Where the places of a task are among `places`.

        Raises:
            InputError: a pick cannot be placed; names it.
        """
        rows = []
        for pick, key in zip(task.picks, task.keys, strict=True):
            where = f"{task.where}.{key}"
            try:
                rows.append(self._row(pick, task.click_stddev_px, where))
            except InputError as error:
                text = str(error)
                if not text.startswith(where):
                    text = f"{where}: {pick}: {text}"
                raise InputError(text) from None
        return rows

    def entered(self, task: Task) -> bool:
        """Whether a scale bar is one that the adjustment was given."""
        bars = self.result.calibration.bars
        if bars is None or not all(isinstance(p, PixelPick) for p in task.picks):
            return False
        columns = (bars.camera_idx.tolist(), bars.frame_idx.tolist(), *bars.xy.T)
        known = set(zip(*columns, strict=True))
        return all(
            (*self._images[click.image], *click.xy) in known
            for pick in task.picks
            if isinstance(pick, PixelPick)
            for click in pick.clicks
        )

    @property
    def spots(self) -> Sequence[Spot]:
        return self._spots

    def _row(self, pick: Pick, stddev_px: float, where: str) -> int:
        # What is one pick is one place: its errors are shared.
        key = (pick, stddev_px if isinstance(pick, PixelPick) else None)
        if key not in self._known:
            self._known[key] = self._new_row(pick, stddev_px, where)
        return self._known[key]

    def _new_row(self, pick: Pick, stddev_px: float, where: str) -> int:
        found: tuple[Spot, int | _Rays]
        if isinstance(pick, PointPick):
            found = self._of_point(pick)
        elif isinstance(pick, WorldPick):
            found = self._of_place(pick)
        elif len(pick.clicks) > 1:
            found = self._of_clicks(pick, stddev_px, where)
        else:
            found = self._of_one_click(pick, stddev_px, where)
        spot, source = found
        if isinstance(source, int) and source in self._sources:
            return self._sources.index(source)  # picked in another way before
        self._spots.append(spot)
        self._sources.append(source)
        return len(self._spots) - 1

    def _of_point(self, pick: PointPick) -> tuple[Spot, int]:
        count = self.scene.num_points
        if not 1 <= pick.point_id <= count:
            raise InputError(f"there is no such point: the ids run from 1 to {count}")
        return self._model_spot(pick, pick.point_id - 1, "point of the model")

    def _model_spot(self, pick: Pick, point: int, how: str) -> tuple[Spot, int]:
        count = int(np.count_nonzero(self.scene.point_idx == point))
        return Spot(pick, how, count), point

    def _of_place(self, pick: WorldPick) -> tuple[Spot, int | _Rays]:
        row, gap = self.surface.nearest(np.array(pick.xyz))
        if self.surface.is_model:
            how = f"nearest point of the model, {row + 1}"
            spot, point = self._model_spot(pick, row, how)
            return replace(spot, moved_by=gap), point
        assert self.surface.stddev is not None
        rays = self._seen(self.surface.points[row], float(self.surface.stddev[row]))
        how = (
            f"nearest point of {self.surface.name}; its deviation is predicted from "
            f"the rays of the {len(rays.xy)} images that see the place"
        )
        return Spot(pick, how, len(rays.xy), moved_by=gap), rays

    def _seen(self, point: Array, stated: float = np.nan) -> _Rays:
        """A place by the images that see it, each as good as a feature."""
        camera, frame, xy = views_of(self.scene, self._model, point)
        if len(xy) < 2:
            raise InputError("no two images see this place: nothing tells its depth")
        noise = self.result.calibration.summary.sigma_px
        return _Rays(camera, frame, xy, noise, point, np.zeros((3, 3)), stated)

    def _clicks(
        self, pick: PixelPick, where: str
    ) -> tuple[IndexArray, IndexArray, Array]:
        for click in pick.clicks:
            check_click(where, click, self._images, self.result.model.rig)
        places = np.array([self._images[click.image] for click in pick.clicks])
        return places[:, 0], places[:, 1], np.array([c.xy for c in pick.clicks])

    def _of_clicks(
        self, pick: PixelPick, stddev_px: float, where: str
    ) -> tuple[Spot, _Rays]:
        camera, frame, xy = self._clicks(pick, where)
        seen = self._observed(camera, frame, xy)
        seen = replace(seen, points=placed(seen))
        if not np.all(np.isfinite(seen.points)):
            raise InputError(
                "its images see it from the same side, or not at one place in front "
                "of them"
            )
        # Two images leave one number over, the gap between their rays.
        miss = float(np.sqrt(np.sum(misses(seen) ** 2) / (2 * len(xy) - 3)))
        times, note = miss / stddev_px, None
        told = f"miss each other by {miss:.1f} px, {times:.0f} standard deviations"
        if times > MAX_MISS:
            raise InputError(
                f"its clicks {told}: was the same spot clicked in all images?"
            )
        if times > SUSPICIOUS:
            note = f"the clicks of {pick} {told}, and were taken to be so noisy"
            stddev_px = miss
        how = f"clicked in {len(xy)} images"
        rays = _Rays(camera, frame, xy, stddev_px, seen.points[0], np.zeros((3, 3)))
        return Spot(pick, how, len(xy), miss, note), rays

    def _of_one_click(
        self, pick: PixelPick, stddev_px: float, where: str
    ) -> tuple[Spot, _Rays]:
        """A pixel on the surface: it slides there as the click errs."""
        camera, frame, xy = self._clicks(pick, where)
        patch = self._image(int(camera[0]), int(frame[0])).patch(pick.clicks[0].xy)
        rays = self._seen(patch.point, patch.stddev)
        one = replace(self._observed(camera, frame, xy), points=patch.point[None])
        sliding = np.linalg.inv(np.vstack([pixels_by_point(one)[0], patch.normal]))
        slide = stddev_px * sliding[:, :2]
        rays.extra = slide @ slide.T + patch.relief**2 * np.outer(
            patch.sight, patch.sight
        )
        rays.sight = patch.sight
        how = (
            f"clicked in one image, at the depth of {self.surface.name} within "
            f"{patch.reach_px:.0f} px"
        )
        return Spot(pick, how, len(rays.xy)), rays

    def _image(self, camera: int, frame: int) -> SurfaceImage:
        """The last one is kept: clicks come image after image."""
        if self._last is None or self._last[0] != (camera, frame):
            image = SurfaceImage(self.surface, self.scene, camera, frame)
            self._last = (camera, frame), image
        return self._last[1]

    def _observed(self, camera: IndexArray, frame: IndexArray, xy: Array) -> Scene:
        return replace(
            self.scene,
            points=np.full((1, 3), np.nan),
            camera_idx=camera,
            frame_idx=frame,
            point_idx=np.zeros(len(xy), dtype=np.int64),
            xy=xy,
        )

    def places(self) -> Places:
        """Of all spots, in their order."""
        points = {s: i for i, s in enumerate(self._sources) if isinstance(s, int)}
        rays = {i: s for i, s in enumerate(self._sources) if isinstance(s, _Rays)}
        parts, order = [], [*points.values(), *rays]
        if points:
            index = np.array(list(points), dtype=np.int64)
            parts.append(self.propagation.of_points(index))
        if rays:
            parts.append(self._places_of_rays(list(rays.values())))
        return Places.joined(parts).select(np.argsort(order))

    def _places_of_rays(self, found: Sequence[_Rays]) -> Places:
        counts = [len(item.xy) for item in found]
        seen = replace(
            self.scene,
            points=np.array([item.point for item in found]),
            camera_idx=np.concatenate([item.camera_idx for item in found]),
            frame_idx=np.concatenate([item.frame_idx for item in found]),
            point_idx=np.repeat(np.arange(len(found)), counts),
            xy=np.vstack([item.xy for item in found]),
        )
        noise = np.array([item.stddev_px for item in found])
        places = self.propagation.of_rays(seen, noise)
        own = places.own + np.array([item.extra for item in found])
        places = replace(places, own=own)
        return replace(places, own=own + self._stated(places, found, seen))

    def _stated(self, places: Places, rays: Sequence[_Rays], seen: Scene) -> Array:
        """(M, 3, 3) what a cloud's own deviations are larger by, along the sight."""
        extra = np.zeros((len(rays), 3, 3))
        _, dirs = seen.water_rays()
        for m, item in enumerate(rays):
            if not np.isfinite(item.stated):
                continue
            sight = item.sight
            if sight is None:
                sight = dirs[seen.point_idx == m].mean(axis=0)
                sight /= np.linalg.norm(sight)
            slope = np.zeros((1, len(rays), 3))
            slope[0, m] = sight
            known = self.propagation.covariance(places, slope).item()
            more = np.nan_to_num(item.stated**2 - known)
            extra[m] = max(more, 0.0) * np.outer(sight, sight)
        return extra
