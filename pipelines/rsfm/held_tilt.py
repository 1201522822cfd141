"""One camera whose port is held straight, and is tilted: what becomes of the scale?

    python pipelines/rsfm/held_tilt.py -o OUT [--runs 8]

The scale of one camera behind a port that is known and held comes from refraction
alone. Here the port that is held as straight is tilted by 2 degrees, in a random
direction, on three motions. The error of the scale is compared with its standard
deviation: that from the images, which takes the port for exact, and that in all, with
the default for a held normal (2 degrees, assumed).
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import uwsfm
from uwsfm.calibration.given_errors import given_reach, in_all
from uwsfm.geometry.alignment import align
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import paper_rig, tilted_normal
from uwsfm.simulate.trajectories import (
    rich_motion,
    rig_from_world_looking_at,
    straight_strip,
)

NUM_FRAMES, ALTITUDE, SPACING = 30, 1.0, 0.2
TILT_DEG, NOISE_PX, NUM_POINTS = 2.0, 0.3, 5000
DISTANCES_M = (0.02, 0.06)
SWAY_DEG, HEAVE = 8.0, 0.05
"""Amplitude of roll and pitch, and of the altitude as a share of it."""
HELD = {"refine_normals": False, "refine_distances": False}


def swaying_strip() -> Array:
    """A strip whose camera rolls and pitches about the vertical, as a diver's does."""
    k = np.arange(NUM_FRAMES)
    y = SPACING * (k - 0.5 * (NUM_FRAMES - 1))
    height = ALTITUDE * (1.0 + HEAVE * np.sin(1.3 * k))
    centers = np.column_stack([0.0 * y, y, -height])
    lean = np.tan(np.radians(SWAY_DEG))
    targets = centers + np.column_stack(
        [lean * np.sin(0.9 * k), lean * np.cos(0.7 * k), np.ones(NUM_FRAMES)]
    )
    return rig_from_world_looking_at(centers, targets, 5.0 * np.sin(0.5 * k))


MOTIONS = {
    "level strip": lambda: straight_strip(
        NUM_FRAMES, spacing=SPACING, altitude=ALTITUDE
    ),
    "swaying strip": swaying_strip,
    "varied dive": lambda: rich_motion(NUM_FRAMES, altitude=ALTITUDE, extent=0.4),
}


def errors(
    poses: Array, distance: float, seed: int
) -> tuple[float, float, float] | None:
    """Relative error of the scale, and its deviations; None: it is not determined."""
    rng = np.random.default_rng(seed)
    normal = tilted_normal(TILT_DEG, float(rng.uniform(0.0, 360.0)))
    camera = paper_rig(distance=distance, thickness=0.01).cameras[0]
    rig = uwsfm.Rig(
        cameras=(replace(camera, port=replace(camera.port, normal=normal)),),
        cam_from_rig=None,
        baseline_m=None,
    )
    simulated = simulate_scene(
        rig,
        poses,
        Relief(stddev=0.08, correlation_length=0.3, seed=seed),
        ObservationOptions(num_points=NUM_POINTS, noise_px=NOISE_PX, seed=seed),
    )
    straight = replace(simulated.truth.ports[0], normal=(0.0, 0.0, 1.0))
    scene = simulated.scene
    scene = replace(scene, cameras=(scene.cameras[0].with_port(straight),))
    result = uwsfm.calibrate(scene, **HELD)
    own = result.covariance.scale_stddev
    if own is None:
        return None
    good = finite_rows(result.scene.points)
    moved = align(
        simulated.truth.points[good],
        result.scene.points[good],
        np.ones(int(good.sum())),
        with_scale=True,
    )
    total = in_all(result, given_reach(result)).scale_stddev
    return moved.scale - 1.0, own, float(total or np.nan)


def _cells(found: list[tuple[float, float, float] | None]) -> list[str]:
    rows = np.array([one for one in found if one is not None]).reshape(-1, 3)
    count = f"{len(rows)} of {len(found)}"
    if not len(rows):
        return [count, *5 * ["-"]]
    error, own, total = np.abs(rows.T)
    return [
        count,
        f"{100 * np.sqrt(np.mean(error**2)):.2g}",
        f"{100 * np.median(own):.2g}",
        f"{np.median(error / own):.1f}, {np.max(error / own):.1f}",
        f"{100 * np.median(total):.2g}",
        f"{np.median(error / total):.1f}, {np.max(error / total):.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=8, help="of each motion")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    lines = [
        "| port at, mm | motion | scale determined in | error, % (RMS) | ± from the "
        "images, % | error over it: median, largest | ± in all, % | error over it: "
        "median, largest |",
        "|---" * 8 + "|",
    ]
    for distance in DISTANCES_M:
        for name, motion in MOTIONS.items():
            ways = [errors(motion(), distance, seed) for seed in range(options.runs)]
            cells = [f"{1e3 * distance:.0f}", name, *_cells(ways)]
            lines.append(f"| {' | '.join(cells)} |")
    text = "\n".join(lines) + "\n"
    (options.out / "held_tilt.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
