"""What a dive determines before it is flown: the ± of the ports and of the points.

python pipelines/planning/plan.py [--noise-px 0.3] [--only images,overlap]

Every line is a simulated dive whose geometry alone counts. `uwsfm.predict_covariance`
gives the Cramér-Rao bound, the standard deviations that no program can beat.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

import uwsfm
from uwsfm.geometry import rigid3
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import paper_rig, sample_rig
from uwsfm.simulate.trajectories import lawn_mower, level_poses, rich_motion

PER_IMAGE = 400
"""Observations in an image: a dull sea floor. Twice as many divide every ± by 1.4."""
ALTITUDE_M = 2.0
NOISE_PX = 0.3
Row = tuple[str, np.ndarray, float, dict[str, float]]


def dive(poses: np.ndarray, relief_m: float, port_m: float = 0.02) -> uwsfm.Scene:
    """The paper's rig along ``poses``, with PER_IMAGE observations in a mean image."""
    rig = paper_rig(distance=port_m)
    count = 20 * len(poses)
    for _ in range(3):  # how many points that takes depends on the overlap
        options = ObservationOptions(num_points=count, seed=1)
        scene = simulate_scene(rig, poses, Relief(stddev=relief_m), options).truth
        seen = scene.num_observations / (2 * len(poses))
        count = max(20, round(count * PER_IMAGE / seen))
    return scene


def survey(
    *,
    lines: int = 3,
    per_line: int = 7,
    spacing: float = 0.3,
    altitudes: Sequence[float] = (ALTITUDE_M,),
    across: bool = False,
) -> np.ndarray:
    """Lines there and back, one survey per altitude; ``across``: the last is turned."""
    parts = []
    for altitude in altitudes:
        poses = lawn_mower(
            lines, per_line, spacing=spacing, line_spacing=0.6, altitude=altitude
        )
        parts.append(poses)
    if across:
        parts[-1] = level_poses(rigid3.inverse(parts[-1])[:, 4:], 90.0)
    return np.concatenate(parts)


def images() -> Iterator[Row]:
    for frames in (5, 10, 20, 40, 80):
        yield f"{frames} stereo pairs", rich_motion(frames), 0.2, {}


def overlap() -> Iterator[Row]:
    """Along the line; the width of what an image shows is that of its middle row."""
    seen = footprint_m(ALTITUDE_M)
    for spacing in (0.15, 0.3, 0.6, 0.9):
        share = 1.0 - spacing / seen
        poses = survey(spacing=spacing, altitudes=(1.75, 2.25))
        yield f"{100 * share:.0f} % ({spacing:.2f} m between frames)", poses, 0.1, {}


def altitudes() -> Iterator[Row]:
    for second in (2.0, 2.1, 2.25, 2.5, 3.0):
        name = "2.0 m throughout" if second == 2.0 else f"2.0 and {second} m"
        yield name, survey(altitudes=(2.0, second)), 0.0, {}


def relief() -> Iterator[Row]:
    for height in (0.0, 0.05, 0.1, 0.2, 0.4):
        yield f"± {height:g} m", survey(altitudes=(2.0, 2.0)), height, {}


def manoeuvre() -> Iterator[Row]:
    yield "one straight line", survey(lines=1, per_line=42), 0.1, {}
    yield "lines there and back", survey(altitudes=(2.0, 2.0)), 0.1, {}
    yield (
        "the same, the second time at 90 degrees",
        survey(altitudes=(2.0, 2.0), across=True),
        0.1,
        {},
    )
    yield (
        "the same, the second time 0.5 m higher",
        survey(altitudes=(2.0, 2.5)),
        0.1,
        {},
    )
    yield "turned, tilted, at many altitudes", rich_motion(42), 0.1, {}


def port() -> Iterator[Row]:
    for distance in (0.005, 0.02, 0.06, 0.12):
        poses = survey(altitudes=(2.0, 2.5))
        yield f"{1e3 * distance:.0f} mm", poses, 0.1, {"port_m": distance}


TABLES: dict[str, tuple[str, Callable[[], Iterator[Row]]]] = {
    "images": ("number of images (varied motion, relief ± 0.2 m)", images),
    "overlap": ("overlap along the line (1.75 and 2.25 m, relief ± 0.1 m)", overlap),
    "altitudes": ("altitudes (42 pairs in lines, flat floor)", altitudes),
    "relief": ("relief (42 pairs in lines, all at 2 m)", relief),
    "manoeuvre": ("manoeuvre (42 pairs, relief ± 0.1 m)", manoeuvre),
    "port": ("port distance (42 pairs, 2.0 and 2.5 m, relief ± 0.1 m)", port),
}


def footprint_m(altitude: float) -> float:
    """Length along the track that an image shows at an altitude."""
    left = paper_rig().cameras[0]
    camera = uwsfm.RefractiveCamera(left.camera, left.port)
    origins, dirs = camera.ray_from_img([[600.0, 0.5], [600.0, 899.5]])
    depth = (altitude - origins[:, 2:]) / dirs[:, 2:]
    places = origins + depth * dirs
    return float(abs(places[1, 1] - places[0, 1]))


def predicted(scene: uwsfm.Scene, noise_px: float) -> tuple[float, float, float]:
    """± of tilt (degrees), port distance and points (mm), the worse of two cameras."""
    covariance = uwsfm.predict_covariance(scene, noise_px)
    tilt = max(camera.normal_stddev_deg for camera in covariance.cameras)
    distance = max(camera.distance_stddev_m for camera in covariance.cameras)
    places = np.trace(covariance.points, axis1=1, axis2=2)
    return tilt, 1e3 * distance, 1e3 * float(np.sqrt(np.nanmedian(places)))


def print_given(noise_px: float) -> None:
    """The error budget of one good dive, with the sample's rig and its lenses."""
    poses = survey(altitudes=(2.0, 2.5))
    options = ObservationOptions(num_points=2000, seed=1)
    truth = simulate_scene(sample_rig(), poses, Relief(stddev=0.1), options).truth
    noise = np.random.default_rng(1).normal(0.0, noise_px, truth.xy.shape)
    noisy = replace(truth, xy=truth.xy + noise)
    _, budget = uwsfm.with_budget(uwsfm.calibrate(noisy))
    print("\n| if this is wrong | by | tilt, deg | port distance, mm | lengths, % |")
    print("|---|---|---|---|---|")
    for row in budget:
        one = " of camera" in row.name
        if one and not row.name.startswith("baseline"):
            continue  # the row of both cameras alike is there, too
        tilt = max(shift.tilt_deg for shift in row.shifts)
        distance = 1e3 * max((shift.distance_m for shift in row.shifts), key=abs)
        print(
            f"| {row.name} | {row.amount} | {tilt:.2f} | {distance:+.1f} "
            f"| {100.0 * row.scale:+.2f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--noise-px", type=float, default=NOISE_PX)
    everything = ",".join([*TABLES, "given"])
    parser.add_argument("--only", default=everything, help="tables, by comma")
    options = parser.parse_args()
    for name in options.only.split(","):
        if name == "given":
            print_given(options.noise_px)
            continue
        title, rows = TABLES[name]
        print(f"\n| {title} | tilt, ± deg | port distance, ± mm | points, ± mm |")
        print("|---|---|---|---|")
        for label, poses, relief_m, more in rows():
            tilt, distance, points = predicted(
                dive(poses, relief_m, **more), options.noise_px
            )
            print(f"| {label} | {tilt:.3f} | {distance:.2g} | {points:.2g} |")


if __name__ == "__main__":
    main()
