"""`uwsfm dense`: a dense cloud from a result folder and its images."""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._base.disk import explained, require_room
from uwsfm._base.files import require_writable
from uwsfm._base.partial import remove_stale
from uwsfm._base.progress import Progress, silent
from uwsfm.cloud import Cloud, write_cloud
from uwsfm.dense.exposure import balancing_gains
from uwsfm.dense.fuse import (
    FuseCounts,
    Noise,
    Placed,
    Rule,
    differences_px,
    fuse,
    robust_stddev,
)
from uwsfm.dense.maps import DepthMaps
from uwsfm.dense.options import ASSUMED_NOISE_PX, DenseOptions
from uwsfm.dense.plan import FUSE_PIXELS, PLACED_BYTES, Load, Plan, plan
from uwsfm.dense.views import neighbours
from uwsfm.dense.voxels import Fused, Voxels
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.folder import DENSE_CLOUD, Result, open_result
from uwsfm.results.log import job_log
from uwsfm.results.summary import write_json

SUMMARY = "summary.json"
"""Beside the cloud."""
_NOISE_VIEWS, _NOISE_NEIGHBOURS = 24, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class DenseResult:
    """What `dense_cloud` made; the same is on disk."""

    cloud: Cloud
    summary: dict[str, Any]
    path: Path
    """Of the cloud's file."""


def dense_cloud(
    out: str | Path,
    images: str | Path | None = None,
    *,
    progress: Progress = silent,
    **options: Any,
) -> DenseResult:
    """Make a dense cloud of a reconstruction.

    Depth maps are kept in ``out/uwsfm-work/dense``: a run that was stopped goes on with
    the first that is missing, and one with other options makes again what they change.

    Args:
        out: Folder of `reconstruct` or `refine_model`; receives ``dense/cloud.ply`` and
            ``dense/summary.json``, each replaced as a whole.
        images: The images' folder; default: where they were.
        progress: Called with the step and what is done of it.
        **options: Fields of `DenseOptions`.

    Raises:
        InputError: An option, the folder or an image is not usable.
        UwsfmError: No depth could be found; the message says why.
    """
    asked = {**locals()}
    settings = _parsed(options)
    result = open_result(out, images)
    source = result.require_images()
    remove_stale(result.folder, deep=True)
    with (
        explained(result.folder),
        job_log(result.folder, "uwsfm dense", asked, progress) as log,
    ):
        with _Run(result, source, settings, log.progress) as run:
            cloud = run.cloud()
        log.result(cloud.summary)
        return cloud


def _parsed(options: dict[str, Any]) -> DenseOptions:
    unknown = sorted(set(options) - set(DenseOptions.__dataclass_fields__))
    if unknown:
        raise InputError(
            f"unknown option {unknown[0]}: there are "
            + ", ".join(DenseOptions.__dataclass_fields__)
        )
    return DenseOptions(**options)


class _Run:
    def __init__(
        self, result: Result, images: Path, options: DenseOptions, progress: Progress
    ) -> None:
        self.result, self.images, self.options = result, images, options
        self.model, self.progress = result.model, progress
        self.maps = DepthMaps(result, images, options)
        self.views = self.maps.views
        cores = os.cpu_count() or 1
        self.threads = cores if options.num_threads < 1 else options.num_threads
        self.rule = Rule(min_views=options.min_views, keep_single=options.keep_single)
        self.seconds: dict[str, float] = {}
        self.plan = self._planned()
        self.store = _Store(self.maps.placed, self.plan.store_bytes)

    def __enter__(self) -> _Run:
        # OpenCV's own threads would fight with ours.
        self._cv_threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        return self

    def __exit__(self, *_: object) -> None:
        cv2.setNumThreads(self._cv_threads)

    def check(self) -> None:
        """What would fail after the work.

        Raises:
            InputError: one sentence.
            DiskFullError: there is no room for the depth maps.
        """
        count, wanted = len(self.views), self.options.min_views
        if wanted > (max(count, 2) if self.options.keep_single else count):
            there = "is 1 depth map" if count == 1 else f"are {count} depth maps"
            raise InputError(f"--min-views {wanted}: there {there}")
        most = self.options.max_neighbours + 1
        if wanted > most:
            raise InputError(
                f"--min-views {wanted}: each depth map is compared with "
                f"{most - 1} others, so that {most} can agree"
            )
        require_writable(self.result.folder / DENSE_CLOUD)
        self.maps.require_images()
        needed = self.maps.missing_bytes()
        require_room(self.result.folder, needed, "making depth maps")

    def cloud(self) -> DenseResult:
        self.check()
        self.progress(f"plan: {self.plan}", 0, None)
        matched = self._timed("depth maps", self._match_all)
        noise, assumed = self._timed("noise", self._noise)
        voxel = self.options.voxel or self._footprint()
        counts, cloud, size = self._timed(
            "fusion", lambda: self._fuse_all(noise, voxel)
        )
        if not len(cloud):
            raise UwsfmError(self._why_empty(counts))
        path = self.result.folder / DENSE_CLOUD
        unit = self.result.unit
        write_cloud(cloud, path, unit)
        summary = {
            "cloud": path.name,
            "model": self.result.fingerprint,
            "num_points": len(cloud),
            "unit": unit,
            "voxel": size,
            "voxel_asked": voxel,
            "noise_px": noise.own,
            "noise_from": "assumed" if assumed else "differences between depth maps",
            "calibration_stddev_max": self._calibration_summary(),
            "stddev_percentiles": _percentiles(cloud.stddev),
            "range_percentiles": _percentiles(cloud.view_range),
            "num_plain": int(np.count_nonzero(cloud.plain)),
            "num_views_mean": float(np.mean(cloud.num_views)),
            "depth_maps": matched,
            "pairs_left_out": {
                f"{a}-{b}": reason for (a, b), reason in self.maps.refused.items()
            },
            **counts,
            "options": asdict(self.options),
            "plan": asdict(self.plan),
            "seconds": self.seconds,
        }
        write_json(summary, path.with_name(SUMMARY))
        return DenseResult(cloud=cloud, summary=summary, path=path)

    def _why_empty(self, counts: dict[str, Any]) -> str:
        contradicted = counts["num_contradicted"]
        unchecked = counts["num_unchecked"]
        if contradicted > unchecked and self.options.noise_px is not None:
            advice = "try a larger --noise-px, or none"
        elif contradicted > unchecked:
            advice = "they disagree: is the rig's calibration right, do the images fit?"
        else:
            advice = "the frames overlap too little: try a smaller --min-views, or "
            advice += "--keep-single"
        return (
            f"no point is confirmed by {self.options.min_views} depth maps: of "
            f"{counts['num_measured']} depths, {contradicted} were contradicted by "
            f"other depth maps and {unchecked} were seen by too few; {advice}"
        )

    def _timed(self, step: str, action: Callable[[], Any]) -> Any:
        start = time.monotonic()
        value = action()
        self.seconds[step] = round(time.monotonic() - start, 3)
        return value

    # Depth maps.

    def _match_all(self) -> list[dict[str, Any]]:
        """Make every depth map that is not there; what is known of each."""
        passes: list[tuple[str, Callable[[int], Any]]] = []
        if self.maps.num_passes > 1:
            passes.append(("first depths", self.maps.search))
        budget = self.plan.match_bytes
        passes.append(("depth maps", lambda index: self.maps.make(index, budget)))
        for step, action in passes:
            entries = self._of_all_views(step, action)
        return entries

    def _of_all_views(self, step: str, action: Callable[[int], Any]) -> list[Any]:
        found: list[Any] = [None for _ in self.views]
        self.progress(step, 0, len(self.views))
        with ThreadPoolExecutor(self.plan.matchers) as pool:
            jobs = {pool.submit(action, index): index for index in range(len(found))}
            try:
                for done, job in enumerate(as_completed(jobs), 1):
                    found[jobs[job]] = job.result()
                    self.progress(step, done, len(self.views))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return found

    def _planned(self) -> Plan:
        import psutil

        cameras = [self.maps.camera(view) for view in self.views]
        # Views of the same cameras are alike.
        largest = {view.pair: index for index, view in enumerate(self.views)}
        load = Load(
            pixels=[camera.width * camera.height for camera in cameras],
            map_bytes=max(self.maps.bytes_of(index) for index in largest.values()),
            is_stereo=self.maps.is_stereo,
            neighbours=self.options.max_neighbours,
        )
        used = float(psutil.Process().memory_info().rss)
        return plan(load, self.options.max_memory, used, self.threads)

    # Fusion.

    def _calibration_summary(self) -> dict[str, float | None]:
        largest = self.maps.largest_errors()
        return {f"{a}-{b}": value for (a, b), value in largest.items()}

    def _noise(self) -> tuple[Noise, bool]:
        """That of the disparities, and whether it is only assumed."""
        self.maps.prepare_errors()
        self.near = neighbours(self.model, self.views, self.options.max_neighbours)
        if self.options.noise_px is not None:
            return _alike(self.options.noise_px), True
        samples = []
        step = max(1, len(self.views) // _NOISE_VIEWS)
        chosen = range(0, len(self.views), step)
        for done, index in enumerate(chosen):
            self.progress("noise", done, len(chosen))
            others = [self.store.get(i) for i in self.near[index][:_NOISE_NEIGHBOURS]]
            samples.append(differences_px(self.store.get(index), others))
        self.progress("noise", len(chosen), len(chosen))
        between, own = (robust_stddev(px) for px in np.concatenate(samples).T)
        if between is None or own is None:
            return _alike(ASSUMED_NOISE_PX), True
        return Noise(own=own, between=between), False

    def _footprint(self) -> float:
        """Of a pixel at the median distance."""
        found = []
        for index in range(0, len(self.views), max(1, len(self.views) // 8)):
            points = self.store.get(index).points
            across = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=-1)
            if np.isfinite(across).any():
                found.append(float(np.nanmedian(across)))
        if not found:
            raise UwsfmError("nothing was matched in any image: is the water clear?")
        return float(np.median(found))

    def _fuse_all(
        self, noise: Noise, voxel: float
    ) -> tuple[dict[str, Any], Cloud, float]:
        """Counts, the cloud, and the voxels' size."""
        scene = self.model.scene
        middle = np.nanmedian(scene.points, axis=0)
        voxels = Voxels(voxel, middle, self.plan.voxel_bytes)
        totals = np.zeros(4, dtype=np.int64)
        ahead = self.plan.fusers
        gains = balancing_gains(
            [self.maps.point_colors(index) for index in range(len(self.views))]
        )
        self.color = lru_cache(ahead + 1)(lambda index: self._balanced(index, gains))
        with ThreadPoolExecutor(ahead) as pool:
            # In order, so that runs repeat to the last digit; a few ahead, since what
            # is finished waits in memory.
            jobs: deque[tuple[int, Future]] = deque()
            for index, rows in self._bands():
                jobs.append((index, pool.submit(self._fuse_one, index, rows, noise)))
                if len(jobs) > ahead:
                    self._add(voxels, totals, *jobs.popleft())
            while jobs:
                self._add(voxels, totals, *jobs.popleft())
        names = ("num_measured", "num_confirmed", "num_contradicted", "num_unchecked")
        self.store.clear()
        cloud = voxels.cloud()
        return dict(zip(names, totals.tolist(), strict=True)), cloud, voxels.size

    def _bands(self) -> Iterator[tuple[int, slice]]:
        """Views and some rows of them, so many that their memory is bounded."""
        for index, view in enumerate(self.views):
            camera = self.maps.camera(view)
            count = max(1, FUSE_PIXELS // camera.width)
            for top in range(0, camera.height, count):
                yield index, slice(top, top + count)

    def _add(
        self, voxels: Voxels, totals: NDArray[np.int64], index: int, job: Future
    ) -> None:
        fused, counts = job.result()
        voxels.add(fused)
        totals += list(asdict(counts).values())
        self.progress("fusion", index + 1, len(self.views))

    def _balanced(self, index: int, gains: Array) -> NDArray[np.uint8]:
        """The image of a view as all of them were exposed."""
        image = self.maps.color(index) * gains[index].astype(np.float32)
        return np.rint(np.clip(image, 0.0, 255.0)).astype(np.uint8)

    def _fuse_one(
        self, index: int, rows: slice, noise: Noise
    ) -> tuple[Fused, FuseCounts]:
        return fuse(
            self.store.get(index),
            [self.store.get(i) for i in self.near[index]],
            self.color(index),
            noise,
            self.rule,
            rows,
        )


def _alike(noise_px: float) -> Noise:
    return Noise(own=noise_px, between=noise_px)


class _Store:
    """Placed depth maps, the last used ones kept."""

    def __init__(self, load: Callable[[int], Placed], max_bytes: float) -> None:
        self._load, self._max_bytes = load, max_bytes
        self._kept: OrderedDict[int, Placed] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, index: int) -> Placed:
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
        found = self._load(index)
        with self._lock:
            self._kept[index] = found
            room = self._max_bytes / (PLACED_BYTES * found.distance.size)
            while len(self._kept) > max(1, room):
                self._kept.popitem(last=False)
        return found

    def clear(self) -> None:
        with self._lock:
            self._kept.clear()


def _percentiles(values: Any) -> dict[str, float]:
    shares = (5, 50, 95)
    found = np.nanpercentile(values, shares).tolist()
    return dict(zip(map(str, shares), found, strict=True))
