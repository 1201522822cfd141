"""Measurements beside what is true: do they err as their standard deviations say?

    python pipelines/uril_tank/pipeline.py DATA -o OUT        # writes OUT/run
    python pipelines/inspection/measuring.py --tank DATA/tank_corners.npz OUT/run
    uwsfm dense OUT/run
    python pipelines/inspection/measuring.py --tank ... OUT/run --one-image
    uwsfm demo -o DEMO
    python pipelines/inspection/measuring.py --sample DEMO

The tank's board was texture to the reconstruction, like any other. Its corners, found
in the left and in the right image, are clicks here, and its squares scale bars.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import uwsfm
from uwsfm.geometry import rigid3
from uwsfm.jobs.demo import sample_dir
from uwsfm.measuring.measure import MeasureResult
from uwsfm.results.folder import Result

SQUARE_M = 0.0254
STEPS = (1, 2, 3, 5)
"""Squares that a bar is long, along the lines of the board."""
NUM_PLACES = 120
CLICK_PX = 0.3


def tank_bars(
    result: Result, corners_path: Path, click_px: float, sides: int = 2
) -> dict:
    """measurements.yaml: bars of several lengths on every board in view.

    Args:
        result: of the tank.
        corners_path: tank_corners.npz.
        click_px: noise of the corners.
        sides: 1 for clicks in the left image alone.
    """
    data = np.load(corners_path)
    columns, lines = (int(number) for number in data["board_inner"])
    bars = []
    for pair, left, right in zip(data["id"], data["L"], data["R"], strict=True):
        name = f"{pair:02}.png"
        if name not in result.model.frame_names:
            continue
        places = np.stack([left, right], axis=-2) + 0.5  # OpenCV -> COLMAP
        grid = places.reshape(lines, columns, 2, 2)
        for step in STEPS:
            # Bars that share no corner, one after the other along the first lines.
            for line in range(0, lines, 2):
                for first in range(0, columns - step, step + 1):
                    ends = [grid[line, first], grid[line, first + step]]
                    bars.append(
                        {
                            "name": str(step),
                            "length_m": step * SQUARE_M,
                            "ends": [clicks_of(name, end)[:sides] for end in ends],
                        }
                    )
    return {"version": 1, "click_stddev_px": click_px, "scale_bars": bars}


def clicks_of(name: str, pixels: np.ndarray) -> list[dict]:
    """One place in the left and in the right image of a pair."""
    return [
        {"image": f"{side}/{name}", "xy": xy.tolist()}
        for side, xy in zip(("left", "right"), pixels, strict=True)
    ]


def click_noise(found: MeasureResult) -> float:
    """Standard deviation of a coordinate, from how the clicks of two images miss."""
    miss = [spot.miss_px for item in found.measurements for spot in item.spots]
    # Of a normal error the median of its size is 0.6745 standard deviations.
    return float(np.median([m for m in miss if m is not None])) / 0.6745


def table(found: MeasureResult, factor: float) -> list[str]:
    """One line per length: what is promised, and what comes, at a common scale."""
    lines = []
    names = dict.fromkeys(item.task.name for item in found.measurements)
    for name in names:
        items = [item for item in found.measurements if item.task.name == name]
        value = np.array([item.value for item in items])
        known = np.array([item.task.length_m for item in items])
        off = factor * value - known
        stddevs = [
            np.array([getattr(item, kind) for item in items])
            for kind in ("stddev_alone", "stddev")
        ]
        ratios = [rms(off / stddev) for stddev in stddevs]
        within = np.mean(np.abs(off) <= 2.0 * stddevs[1])
        numbers = [np.mean(known), np.mean(value - known), *map(rms, (off, *stddevs))]
        lines.append(
            f"| {name} | {len(items)} | "
            + " | ".join(f"{1e3 * number:.2f}" for number in numbers)
            + f" | {ratios[0]:.2f}, {ratios[1]:.2f} | {100 * within:.0f} % |"
        )
    return lines


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def sample_bars(result: Result) -> dict:
    """Bars between places of the model that are clicked where the truth has them.

    A place is put where the model saw a point, and projected by the true cameras and
    poses: its pixels are right, but for the noise of a click.
    """
    truth = json.loads((sample_dir() / "truth.json").read_text())
    scene = result.model.scene
    names = result.model.frame_names
    true = replace(
        scene,
        cameras=tuple(
            camera.with_port(true_port(entry))
            for camera, entry in zip(scene.cameras, truth["cameras"], strict=True)
        ),
        cam_from_rig=np.array([c["cam_from_rig"] for c in truth["cameras"]]),
        rig_from_world=np.array([truth["rig_from_world"][name] for name in names]),
    )
    # The true world is another one: move the places there by the first frame.
    move = rigid3.compose(
        rigid3.inverse(true.rig_from_world[0]), scene.rig_from_world[0]
    )
    true = replace(true, points=rigid3.transform(move, scene.points))
    rng = np.random.default_rng(0)
    often = np.argsort(-np.bincount(scene.point_idx), kind="stable")
    chosen = rng.permutation(often[: 4 * NUM_PLACES])[:NUM_PLACES]
    pixels, _ = true.projections()
    bars = []
    for first, second in chosen.reshape(-1, 2):
        length = float(np.linalg.norm(true.points[first] - true.points[second]))
        ends = [some_clicks(result, pixels, p, rng) for p in (first, second)]
        name = "below 0.2 m" if length < 0.2 else "0.2 m and more"
        bars.append({"name": name, "length_m": length, "ends": ends})
    bars.sort(key=lambda bar: bar["length_m"])
    return {"version": 1, "click_stddev_px": CLICK_PX, "scale_bars": bars}


def some_clicks(result: Result, pixels: np.ndarray, point: int, rng) -> list[dict]:
    """Three images that saw a point."""
    scene = result.model.scene
    rows = rng.permutation(np.flatnonzero(scene.point_idx == point))[:3]
    return [
        {
            "image": result.model.image_name(
                int(scene.camera_idx[i]), int(scene.frame_idx[i])
            ),
            "xy": (pixels[i] + CLICK_PX * rng.normal(size=2)).tolist(),
        }
        for i in rows
    ]


def true_port(entry: dict) -> uwsfm.FlatPort:
    return uwsfm.FlatPort(
        tuple(entry["normal"]),
        entry["distance_m"],
        entry["thickness_m"],
        entry["glass_index"],
        entry["water_index"],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--tank", type=Path, help="tank_corners.npz")
    what.add_argument("--sample", action="store_true", help="the result is the demo's")
    parser.add_argument("result", type=Path)
    parser.add_argument(
        "--one-image",
        action="store_true",
        help="clicks in the left image alone, at the depth of RESULT/dense/cloud.ply",
    )
    options = parser.parse_args()
    if options.sample and options.one_image:
        parser.error("--one-image goes with --tank")
    result = uwsfm.open_result(options.result)
    if options.sample:
        found = uwsfm.measure(result, sample_bars(result))
        noise = CLICK_PX
    else:
        # First with any noise, to see what it is.
        noise = click_noise(uwsfm.measure(result, tank_bars(result, options.tank, 1.0)))
        sides = 1 if options.one_image else 2
        found = uwsfm.measure(result, tank_bars(result, options.tank, noise, sides))
    bars = found.scale_bars
    assert bars is not None
    print(
        f"\nclicks: {noise:.2f} px; known / measured {bars['known_over_measured']:.5f} "
        f"± {bars['stddev']:.5f}\n"
    )
    print(
        "| bar | count | known mm | mean off | RMS off, at that scale | std. dev. "
        "alone | reported | RMS of off / std. dev. | within 2 |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    # The sample's scale is true; the tank's is that of a baseline measured in air.
    scale = 1.0 if options.sample else bars["known_over_measured"]
    print(*table(found, scale), sep="\n")


if __name__ == "__main__":
    main()
