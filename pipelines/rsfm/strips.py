"""Strips over a sea floor: what refraction does to a survey, and what removes it.

    python pipelines/rsfm/strips.py -o OUT [--runs 5] [--processes 2]

A stereo rig flies 30 frames along a straight line. The same observations are adjusted
with pinholes (fitted to the ports at the distance of the floor, then held; or
self-calibrated) and with the refractive model, all from the true poses: only the
models differ. Lengths are those of the baseline: points are moved and turned onto
the truth, never scaled. OUT receives strips.csv, strips.md and strips.png.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.optimize import least_squares

import uwsfm
from uwsfm._base.signals import BEGINS_AGAIN
from uwsfm._base.tasks import LOCAL, Workers
from uwsfm.cli.console import ProgressBars
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align
from uwsfm.geometry.rays import finite_rows, triangulate_tracks
from uwsfm.rig.rig import Rig
from uwsfm.simulate import (
    ObservationOptions,
    Relief,
    SimulatedScene,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import known_cam_from_rig, nominal_rig, paper_rig
from uwsfm.simulate.trajectories import rich_motion, straight_strip

sys.path.append(str(Path(__file__).parent.parent / "paper"))

from plots import BLUE, GRAY, ORANGE, TEAL, VIOLET, new_figure, save  # noqa: E402
from tables import Row, markdown, select, write_csv  # noqa: E402

Array = NDArray[np.float64]

NUM_FRAMES = 30
OVERLAP = 0.8
"""Of consecutive images."""
NOISE_PX = 0.3
NUM_POINTS = 3000
RELIEF = 0.05
"""Standard deviation of the floor, by its distance."""

ALTITUDES = (0.5, 1.0, 3.0)
DISTANCES = (0.002, 0.02, 0.06, 0.12)
"""Of the ports. At 2 mm a pinhole is nearly right: refraction should gain little."""
GLASS = 0.01

METHODS = (
    "pinhole, fitted and held",
    "pinhole, self-calibrated",
    "refractive, ports free",
    "refractive, ports from another dive",
    "refractive, ports exact",
)
COLORS = dict(zip(METHODS, (ORANGE, VIOLET, TEAL, BLUE, GRAY), strict=True))
LENS_HELD = {"refine_normals": False, "refine_distances": False}
SELF_CALIBRATED = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
}
MAX_ITERATIONS = 500
"""A self-calibration takes a hundred and more, along a valley in which the fit hardly
gains and the points move far: stopped early, its error would be that of the stop."""


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One survey."""

    altitude: float
    distance: float
    """Of the ports, metres."""
    seed: int = 0

    @property
    def rig(self) -> Rig:
        return paper_rig(distance=self.distance, thickness=GLASS)

    def calibrated_elsewhere(self) -> Rig:
        """The rig as calibrated on a varied dive, from a rough start."""
        dive = simulate_scene(
            self.rig,
            rich_motion(20),
            Relief(stddev=0.2, seed=100 + self.seed),
            ObservationOptions(
                num_points=NUM_POINTS, noise_px=NOISE_PX, seed=100 + self.seed
            ),
        )
        found = uwsfm.calibrate(perturbed(dive.scene), loss="l2").scene
        return self.rig.with_geometry(found.cam_from_rig, found.ports)

    def simulate(self) -> SimulatedScene:
        camera = self.rig.refractive_cameras()[0]
        edges = np.array([[600.0, 0.0], [600.0, 900.0]])
        origins, dirs = camera.ray_from_img(edges)
        reach = (self.altitude - origins[:, 2]) / dirs[:, 2]
        low, high = (origins + reach[:, None] * dirs)[:, 1]
        poses = straight_strip(
            NUM_FRAMES,
            spacing=(1.0 - OVERLAP) * (high - low),
            altitude=self.altitude,
        )
        relief = Relief(
            stddev=RELIEF * self.altitude,
            correlation_length=0.3 * self.altitude,
            seed=self.seed,
        )
        options = ObservationOptions(
            num_points=NUM_POINTS,
            noise_px=NOISE_PX,
            detection_rate=0.8,
            seed=self.seed,
        )
        return simulate_scene(self.rig, poses, relief, options)


def outcomes(strip: Strip) -> list[Row]:
    """All methods on one strip."""
    simulated = strip.simulate()
    observed = simulated.scene
    pinholes = replace(
        observed,
        cameras=tuple(fitted_pinhole(c, strip.altitude) for c in observed.cameras),
    )
    nominal = replace(observed, cameras=nominal_rig(strip.rig).refractive_cameras())
    known = strip.calibrated_elsewhere()
    elsewhere = replace(
        observed,
        cameras=known.refractive_cameras(),
        cam_from_rig=known_cam_from_rig(known),
    )
    held = {**LENS_HELD, "refine_cam_from_rig": False}
    starts = (pinholes, pinholes, nominal, elsewhere, observed)
    options = (LENS_HELD, {**LENS_HELD, **SELF_CALIBRATED}, {}, held, held)
    rows = []
    for method, start, wanted in zip(METHODS, starts, options, strict=True):
        result = uwsfm.calibrate(
            start, loss="l2", max_iterations=MAX_ITERATIONS, **wanted
        )
        rows.append(
            {
                "altitude_m": strip.altitude,
                "distance_mm": 1e3 * strip.distance,
                "seed": strip.seed,
                "method": method,
                **measured(result, simulated.truth),
            }
        )
    return rows


def fitted_pinhole(
    camera: uwsfm.RefractiveCamera, depth: float
) -> uwsfm.RefractiveCamera:
    """The OPENCV camera in water that resembles a refractive one best at a depth.

    Its centre is where the water rays nearly meet; the adjustment of the poses takes
    up how far that is from the lens.
    """
    grid = np.stack(
        np.meshgrid(
            np.linspace(0, camera.width, 21), np.linspace(0, camera.height, 17)
        ),
        axis=-1,
    ).reshape(-1, 2)
    origins, dirs = camera.ray_from_img(grid)
    center = triangulate_tracks(origins, dirs, np.zeros(len(grid), np.int64), 1)[0]
    reach = (depth - origins[:, 2]) / dirs[:, 2]
    points = origins + reach[:, None] * dirs - center

    def lens(params: Array) -> uwsfm.RefractiveCamera:
        return uwsfm.RefractiveCamera(
            pycolmap.Camera(
                model="OPENCV",
                width=camera.width,
                height=camera.height,
                params=params.tolist(),
            ),
            uwsfm.NoPort(),
        )

    def errors(params: Array) -> Array:
        return (lens(params).img_from_point(points)[0] - grid).ravel()

    focal = camera.port.n_water * camera.lens[0]
    start = np.array([focal, focal, *camera.lens[2:4], 0.0, 0.0, 0.0, 0.0])
    return lens(least_squares(errors, start, x_scale=[1e3] * 4 + [0.1] * 4).x)


def measured(result: uwsfm.CalibrationResult, truth: uwsfm.Scene) -> Row:
    """Errors after moving and turning all points onto the truth."""
    scene = result.scene
    use = finite_rows(scene.points)
    found, true = scene.points[use], truth.points[use]
    weights = np.ones(len(true))
    moved = align(found, true, weights, with_scale=False)
    error = moved.apply(found) - true
    centers = moved.apply(rigid3.inverse(scene.rig_from_world)[:, 4:])
    gaps = centers - rigid3.inverse(truth.rig_from_world)[:, 4:]
    # A virtual pinhole's centre is not the lens: what is common to all does not count.
    gaps -= gaps.mean(axis=0)
    return {
        "points_rms_mm": 1e3 * _rms(error),
        "centers_rms_mm": 1e3 * _rms(gaps),
        "scale_ppm": 1e6 * (align(found, true, weights, with_scale=True).scale - 1.0),
        "bend": _bend(true, error[:, 2]),
        "rms_px": result.summary.rms_px,
        "iterations": result.summary.num_iterations,
        "converged": int(result.summary.converged),
    }


def _bend(points: Array, depth_error: Array) -> float:
    """Sagitta of the sea floor by the length of the strip, positive for a bowl."""
    x, y = points[:, 0], points[:, 1] - points[:, 1].mean()
    table = np.column_stack([np.ones_like(x), x, y, y * y])
    curvature = np.linalg.lstsq(table, depth_error, rcond=None)[0][3]
    return float(-curvature * 0.25 * np.ptp(y))


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def summarized(rows: list[Row]) -> list[Row]:
    """Over the runs of each case: RMS, and mean and scatter of the bend."""
    lines = []
    for altitude, distance, method in product(ALTITUDES, DISTANCES, METHODS):
        runs = select(
            rows, altitude_m=altitude, distance_mm=1e3 * distance, method=method
        )
        if not runs:
            continue
        bends = np.array([run["bend"] for run in runs])
        lines.append(
            {
                "altitude_m": altitude,
                "distance_mm": 1e3 * distance,
                "method": method,
                **{
                    name: float(np.sqrt(np.mean(np.square([r[name] for r in runs]))))
                    for name in ("points_rms_mm", "centers_rms_mm", "scale_ppm")
                },
                "bend_mean": float(bends.mean()),
                "bend_error": float(bends.std(ddof=1) / np.sqrt(len(bends)))
                if len(bends) > 1
                else None,
                "rms_px": float(np.mean([run["rms_px"] for run in runs])),
                "iterations": float(np.median([run["iterations"] for run in runs])),
                "converged": sum(run["converged"] for run in runs),
            }
        )
    return lines


TABLE = {
    "altitude_m": ("altitude, m", "g"),
    "distance_mm": ("port, mm", "g"),
    "method": ("model", ""),
    "points_rms_mm": ("points, mm", ".2f"),
    "centers_rms_mm": ("centres, mm", ".2f"),
    "scale_ppm": ("scale, ppm", ".0f"),
    "bend_mean": ("bend", "+.1e"),
    "bend_error": ("± (of the mean)", ".0e"),
    "rms_px": ("residual, px", ".3f"),
    "iterations": ("iterations", ".0f"),
    "converged": ("converged", "d"),
}


HEAD = """\
# Strips over a sea floor

`python pipelines/rsfm/strips.py -o pipelines/rsfm/results --runs {runs}`

RMS over {runs} strips per case, residual their mean, iterations their median.

"""


def draw(lines: list[Row], path: Path) -> None:
    """Error of the points and bend of the floor against the distance of the ports."""
    figure = new_figure(8.0, 4.6)
    grid = figure.subplots(2, len(ALTITUDES), sharex=True, sharey="row")
    for column, altitude in enumerate(ALTITUDES):
        for method in METHODS:
            mine = select(lines, altitude_m=altitude, method=method)
            x = [line["distance_mm"] for line in mine]
            for row, name, scale in ((0, "points_rms_mm", 1.0), (1, "bend_mean", 1.0)):
                values = [scale * abs(line[name]) for line in mine]
                grid[row, column].plot(x, values, "o-", ms=3, color=COLORS[method])
        grid[0, column].set_title(f"{altitude:g} m above the floor")
        grid[1, column].set_xlabel("port distance, mm")
    for axes in grid.ravel():
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks([2, 20, 60, 120], ["2", "20", "60", "120"])
        axes.minorticks_off()
    grid[0, 0].set_ylabel("points, mm RMS")
    grid[1, 0].set_ylabel("|bend|, sagitta / length")
    handles = [grid[0, 0].lines[i] for i in range(len(METHODS))]
    figure.legend(handles, METHODS, loc="outside lower center", ncols=3)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=5, help="dives per case")
    parser.add_argument("--processes", type=int, default=2, help="of this machine")
    parser.add_argument("--scheduler", default=LOCAL, help="of Dask: tcp://HOST:PORT")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    strips = [
        Strip(altitude=altitude, distance=distance, seed=seed)
        for altitude, distance in product(ALTITUDES, DISTANCES)
        for seed in range(options.runs)
    ]
    with (
        Workers(options.scheduler, options.out, options.processes) as workers,
        ProgressBars(BEGINS_AGAIN) as progress,
    ):
        tasks = [(strip,) for strip in strips]
        rows = sum(workers.run(outcomes, tasks, "strips", progress), [])
    write_csv(rows, options.out / "strips.csv")
    lines = summarized(rows)
    text = markdown(lines, TABLE)
    head = HEAD.format(runs=options.runs)
    (options.out / "strips.md").write_text(f"{head}{text}\n", encoding="utf-8")
    draw(lines, options.out / "strips.png")
    print(text)


if __name__ == "__main__":
    main()
