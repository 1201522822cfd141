"""What a port costs: unprojection, projection and its Jacobian, per point.

    python pipelines/bench/ports.py

Nanoseconds on one thread, the best of several passes over 100,000 points, and as
ratios to the flat port in the same run.
"""

import time
from collections.abc import Callable

import numpy as np
import pycolmap

import uwsfm
from uwsfm.models import projection

NUM_POINTS = 100_000
PASSES = 7
PORTS: dict[str, uwsfm.FlatPort | uwsfm.DomePort | uwsfm.NoPort] = {
    "flat": uwsfm.FlatPort((0.0348995, 0.0, 0.9993908), 0.02, 0.005),
    "dome, 34 mm off": uwsfm.DomePort((0.01, 0.01, 0.03), 0.06, 0.01),
    "dome, 3 mm off": uwsfm.DomePort((0.001, 0.001, 0.003), 0.06, 0.01),
    "dome, concentric": uwsfm.DomePort((0.0, 0.0, 0.0), 0.06, 0.01),
    "none": uwsfm.NoPort(),
}
STAGES = ("unproject", "project", "project with Jacobian")


def nanoseconds(call: Callable[[], None]) -> float:
    """Per point, compilation left out."""
    call()
    best = np.inf
    for _ in range(PASSES):
        clock = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - clock)
    return float(1e9 * best / NUM_POINTS)


def measure(port: uwsfm.FlatPort | uwsfm.DomePort | uwsfm.NoPort) -> list[float]:
    """One number per stage."""
    lens = pycolmap.Camera(
        model="PINHOLE", width=1200, height=900, params=[1000, 1000, 600, 450]
    )
    camera, row = uwsfm.RefractiveCamera(lens, port), port.row
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, 0], [1200, 900], (NUM_POINTS, 2))
    origins, dirs = camera.ray_from_img(xy)
    points = origins + rng.uniform(0.5, 3.0, (NUM_POINTS, 1)) * dirs
    rays, pixels = np.empty((NUM_POINTS, 6)), np.empty((NUM_POINTS, 2))
    jac = np.empty((NUM_POINTS, 2, projection.JAC_SIZE))
    status = np.empty(NUM_POINTS, dtype=np.uint8)
    calls = (
        lambda: projection.unproject_batch(xy, camera.lens, row, rays, status),
        lambda: projection.project_batch(points, camera.lens, row, pixels, status),
        lambda: projection.project_with_jac_batch(
            points, camera.lens, row, pixels, jac, status
        ),
    )
    return [nanoseconds(call) for call in calls]


def main() -> None:
    found = {name: measure(port) for name, port in PORTS.items()}
    print("| port | " + " | ".join(STAGES) + " |")
    print("|---|" + "---|" * len(STAGES))
    for name, times in found.items():
        cells = [
            f"{value:.0f} ns ({value / flat:.2f})"
            for value, flat in zip(times, found["flat"], strict=True)
        ]
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
