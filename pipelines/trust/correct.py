"""Correct inputs: random rigs and dives. How many are called fitting, and z-scores.

    python pipelines/trust/correct.py -o OUT [--runs 260]

The rig file has exact lenses, straight ports and ruler readings of their distances; the
matches have noise, and 15 % of them are wrong. A run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from dives import WRONG_MATCHES, Dive, dive_of, points_of
from outcomes import FITS, LIMIT, outcome_of

from uwsfm._base.files import replaced_file
from uwsfm.cli.console import ProgressBars
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import DomePort, FlatPort, Port
from uwsfm.rig.rig import Rig, RigCamera, camera_from_colmap
from uwsfm.sfm.simulated import write_features
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import rough_port, tilted_normal
from uwsfm.simulate.trajectories import rich_motion, straight_strip

RUNS = 260
SIZES = ((640, 480), (800, 600), (960, 540), (1200, 900), (1600, 1200))


def correct_dive(seed: int) -> tuple[Dive, dict[str, Any]]:
    """A random rig over a random floor, and what was drawn."""
    rng = np.random.default_rng([20, seed])
    num_cameras = int(rng.choice([1, 2, 2, 2, 3]))
    altitude = float(np.exp(rng.uniform(np.log(0.5), np.log(3.0))))
    ports = str(rng.choice(["flat", "flat", "flat", "domes", "mixed"]))
    strip = bool(rng.random() < 0.3)
    small = bool(rng.random() < 0.3) and not strip
    frames = int(rng.integers(4, 9) if small else rng.integers(9, 17))
    noise_px = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    rig = _random_rig(rng, num_cameras, ports, altitude)
    poses = rich_motion(frames, altitude=altitude, extent=0.4 * altitude)
    if strip:
        lens = rig.cameras[0].camera  # neighbours overlap by 65 to 85 %
        footprint = altitude * lens.height / (1.333 * lens.params[0])
        spacing = footprint * rng.uniform(0.15, 0.35)
        poses = straight_strip(frames, spacing=spacing, altitude=altitude)
    relief = Relief(
        stddev=altitude * rng.uniform(0.03, 0.12),
        correlation_length=0.4 * altitude,
        seed=seed,
    )
    scene = simulate_scene(
        rig,
        poses,
        relief,
        ObservationOptions(
            num_points=int(rng.integers(500, 1200)),
            noise_px=noise_px,
            detection_rate=0.6,
            max_range=3.0 * altitude,
            max_incidence_deg=70.0,
            seed=seed,
        ),
    ).scene
    given = _as_written(rng, rig)
    dive = dive_of(
        given,
        rig,
        scene.rig_from_world,
        lambda path, names: write_features(
            path, scene, names, wrong=WRONG_MATCHES, seed=seed
        ),
    )
    dive = replace(dive, points=points_of(scene, dive.images))
    drawn = {
        "cameras": num_cameras,
        "ports": ports,
        "motion": "strip" if strip else "few frames" if small else "varied",
        "frames": frames,
        "noise_px": noise_px,
        "altitude_m": altitude,
    }
    return dive, drawn


def _random_rig(
    rng: np.random.Generator, num_cameras: int, ports: str, altitude: float
) -> Rig:
    baseline = altitude * rng.uniform(0.08, 0.25)
    poses, items = [rigid3.IDENTITY], []
    width, height = SIZES[rng.integers(len(SIZES))]
    focal = 0.5 * width / np.tan(np.radians(rng.uniform(22.0, 40.0)))
    for c in range(num_cameras):
        dome = ports == "domes" or (ports == "mixed" and c == num_cameras - 1)
        items.append(
            RigCamera(
                name=f"cam{c}",
                images=f"cam{c}",
                camera=_random_lens(rng, width, height, focal),
                port=_random_port(rng, dome=dome),
                refine_normal=not dome,
                refine_distance=not dome,
                refine_center=dome,
            )
        )
        if c:
            turn = np.radians(rng.normal(scale=2.0, size=3))
            quat = rigid3.quat_from_rotvec(turn)
            place = baseline * np.array([[1.0, 0.05, 0.02], [0.1, 0.9, 0.0]][c - 1])
            rotation = np.concatenate([quat, np.zeros(3)])
            poses.append(np.concatenate([quat, -rigid3.rotate(rotation, place)]))
    length = float(np.linalg.norm(poses[1][4:])) if num_cameras > 1 else None
    return Rig(cameras=tuple(items), cam_from_rig=np.stack(poses), baseline_m=length)


def _random_lens(
    rng: np.random.Generator, width: int, height: int, focal: float
) -> pycolmap.Camera:
    focal = focal * rng.uniform(0.98, 1.02)
    center = [0.5 * width + rng.normal(scale=8), 0.5 * height + rng.normal(scale=8)]
    k1, k2 = rng.uniform(-0.15, 0.1), rng.uniform(-0.02, 0.04)
    p1, p2 = rng.normal(scale=3e-4, size=2)
    model = str(rng.choice(["OPENCV", "PINHOLE", "RADIAL"]))
    params = {
        "OPENCV": [focal, focal * rng.uniform(0.998, 1.002), *center, k1, k2, p1, p2],
        "PINHOLE": [focal, focal, *center],
        "RADIAL": [focal, *center, k1, k2],
    }[model]
    return camera_from_colmap(model, width, height, [float(v) for v in params])


def _random_port(rng: np.random.Generator, *, dome: bool) -> Port:
    thickness, index = rng.uniform(0.002, 0.02), rng.choice([1.49, 1.52])
    if dome:
        radius = rng.uniform(0.04, 0.1)
        center: Array = rng.normal(scale=0.06 * radius, size=3)
        x, y, z = center.tolist()
        return DomePort((x, y, z), radius, thickness, float(index), 1.333)
    distance = float(np.exp(rng.uniform(np.log(0.001), np.log(0.15))))
    tilt = 12.0 * rng.uniform() ** 2  # most are mounted well
    normal = tilted_normal(tilt, rng.uniform(-180.0, 180.0))
    return FlatPort(normal, distance, thickness, float(index), 1.333)


def _as_written(rng: np.random.Generator, rig: Rig) -> Rig:
    """Straight or concentric ports; distances as a ruler gives them, 3 mm or 30 %."""
    items = []
    for item in rig.cameras:
        port = rough_port(item.port, distance_scale=1.0)
        if isinstance(port, FlatPort):
            read = port.distance * np.exp(rng.normal(scale=0.3))
            read += rng.normal(scale=0.003)
            port = replace(port, distance=float(max(read, 0.001)))
        items.append(replace(item, port=port))
    return replace(rig, cameras=tuple(items))


HEAD = """\
# Correct inputs

`python pipelines/trust/correct.py -o pipelines/trust/results`

{count} random rigs and dives: one to three cameras, ports 1 to 150 mm away and tilted
by up to 12 degrees, domes, both; strips, sets of 4 to 8 frames, varied motion; noise
of 0.1 to 1 px; {wrong:.0%} of the observations are of another point.

**{fits} of {count} ({share:.1%}) are called fitting.** The others: {others}.

"""


def page(rows: list[dict[str, Any]]) -> str:
    """The tables of all runs."""
    fits = sum(row["verdict"] == FITS for row in rows)
    others = Counter(row["verdict"] for row in rows if row["verdict"] != FITS)
    head = HEAD.format(
        count=len(rows),
        wrong=WRONG_MATCHES,
        fits=fits,
        share=fits / len(rows),
        others=", ".join(f"{n} {v}" for v, n in others.items()) or "none",
    )
    return head + _by_kind(rows) + "\n" + _z_table(rows)


def _by_kind(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| inputs | runs | fit | beyond 3 ± and called fitting |",
        "|---|---|---|---|",
    ]
    for key in ("cameras", "ports", "motion"):
        for value in sorted({row[key] for row in rows}, key=str):
            mine = [row for row in rows if row[key] == value]
            fits = [row for row in mine if row["verdict"] == FITS]
            bad = sum(max(row["errors"].values(), default=0) > LIMIT for row in fits)
            lines.append(f"| {key}: {value} | {len(mine)} | {len(fits)} | {bad} |")
    return "\n".join(lines) + "\n"


def _z_table(rows: list[dict[str, Any]]) -> str:
    """Median and tail of the z-scores, by what they are of."""
    kinds: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row["z_scores"].items():
            kind = next(k for k in ("distance", "tilt", "centre", "scale") if k in name)
            kinds.setdefault(kind, []).append(value)
    lines = [
        "Errors over printed standard deviations. Of a normal distribution, the median "
        "size is 0.67, and 0.3 % are beyond 3.",
        "",
        "| of | number | median size | beyond 3 |",
        "|---|---|---|---|",
    ]
    for kind, values in sorted(kinds.items()):
        sizes = np.abs(values)
        beyond = float(np.mean(sizes > LIMIT))
        median = float(np.median(sizes))
        lines.append(f"| {kind} | {len(sizes)} | {median:.2f} | {beyond:.1%} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument(
        "--mapped", action="store_true", help="verify and map each dive: slow"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    stored = options.out / "correct.jsonl"
    lines = stored.read_text().splitlines() if stored.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {row["seed"] for row in rows}
    seeds = [seed for seed in range(options.runs) if seed not in done]
    with ProgressBars() as progress, stored.open("a", encoding="utf-8") as file:
        for number, seed in enumerate(seeds):
            progress("runs", number, len(seeds))
            dive, drawn = correct_dive(seed)
            outcome = outcome_of(dive, mapped=options.mapped, wrong=WRONG_MATCHES)
            row = {"seed": seed, **drawn, **outcome.to_json()}
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    text = page(rows)
    with replaced_file(options.out / "correct.md") as partial:
        partial.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
