"""Figure 8: the same ports from disjoint sets of images."""

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import f as f_distribution
from single_pair import HELD
from tables import Row, column, select

import uwsfm
from uwsfm.cli.console import ProgressBars
from uwsfm.errors import UwsfmError
from uwsfm.jobs.reconstruct import WORK, ReconstructResult
from uwsfm.models.ports.port import FlatPort
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.rig_checks.stereo_scene import same_frame_scene, without_wrong_matches
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.sequence import SequenceSpec, render_sequence, reseeded
from uwsfm.simulate.trajectories import rich_motion

PAPER_TRIALS_DEG = {
    "left": ((6.872, 0.725), (8.785, 0.573), (5.003, 0.810)),
    "right": ((170.450, 0.810), (163.589, 0.512), (171.251, 0.959)),
}
"""Azimuth and tilt as printed in the paper's figure 8."""
NUM_TANK_SETS = 3
NUM_RENDERED_SETS, RENDERED_SET_SIZE = 4, 8


def spec() -> SequenceSpec:
    """The sample's rig at three quarters of its size, over a longer dive."""
    count = NUM_RENDERED_SETS * RENDERED_SET_SIZE
    poses = rich_motion(count, altitude=1.05, extent=0.4)
    # Sets of neighbours would each lie in a ring of the spiral.
    order = np.random.default_rng(0).permutation(count)
    rig = sample_rig(image_scale=0.75)
    return reseeded(SequenceSpec(rig=rig, rig_from_world=poses[order]), 7)


def trials(work: Path, tank: Path | None) -> list[Row]:
    """Every set's ports with their predicted standard deviations, per camera.

    Args:
        work: Keeps images and features for the next time.
        tank: Folder of the real rig's images; None leaves them out.
    """
    rows = paper_rows()
    with ProgressBars() as progress:
        if tank is not None:
            rig = tank_rig(tank, work)
            rows += _of_sets("tank", tank, rig, NUM_TANK_SETS, work, progress)
        images = work / "rendered_dive"
        if not images.exists():
            render_sequence(spec(), images, progress)
        rig = nominal_rig(spec().rig)
        images = images / "images"
        rows += _of_sets("rendered", images, rig, NUM_RENDERED_SETS, work, progress)
    return rows


def tank_rig(tank: Path, work: Path) -> Rig:
    """The recommended variant of the tank study: covered lens, rig held."""
    sys.path.append(str(Path(__file__).parent.parent / "uril_tank"))
    from tank_rig import write_rig

    work.mkdir(parents=True, exist_ok=True)
    write_rig(tank, work / "tank.yaml", whole_image=False, free_rig=False)
    return uwsfm.load_rig(work / "tank.yaml")


def _of_sets(
    name: str, images: Path, rig: Rig, num_sets: int, work: Path, progress
) -> list[Row]:
    """Reconstruct disjoint, interleaved sets of a folder's frames, each by itself."""
    frames = find_frames(images, rig).names
    rows = []
    for number in range(num_sets):
        chosen = frames[number::num_sets]
        folder = work / f"{name}_set{number + 1}"
        for camera in rig.cameras:
            part = folder / "images" / camera.images
            part.mkdir(parents=True, exist_ok=True)
            for frame in chosen:
                if not (part / frame).exists():
                    # With its time: the front end would start again on a newer file.
                    shutil.copy2(images / camera.images / frame, part / frame)
        result = uwsfm.reconstruct(
            rig, folder / "images", folder / "out", mapper="pinhole", progress=progress
        )
        missing = result.summary["unregistered_frames"]
        if missing:
            raise UwsfmError(f"{folder}: frames {', '.join(missing)} do not register")
        rows += _joint_rows(name, number + 1, result)
        rows += _stereo_rows(name, number + 1, rig, folder)
    return rows


def _joint_rows(data: str, number: int, result: ReconstructResult) -> list[Row]:
    """Everything from everything, as `uwsfm reconstruct` does."""
    return [
        _row(
            data,
            "all parameters",
            number,
            camera["name"],
            port,
            pairs=result.summary["num_registered_frames"],
            normal_stddev_deg=camera["normal_stddev_deg"],
            distance_stddev_mm=1e3 * (camera["distance_stddev_m"] or np.nan),
        )
        for camera, port in zip(
            result.summary["cameras"], result.model.scene.ports, strict=True
        )
    ]


def _stereo_rows(data: str, number: int, rig: Rig, folder: Path) -> list[Row]:
    """Normals alone from matches within the pairs, as in the paper's figure 8."""
    frames = find_frames(folder / "images", rig)
    scene = same_frame_scene(rig, frames, folder / "out" / WORK / "database.db")
    first = uwsfm.calibrate(scene, **HELD)
    # Now that the normals are known, a wrong match shows.
    result = uwsfm.calibrate(without_wrong_matches(first.scene), **HELD)
    return [
        _row(
            data,
            "normals only",
            number,
            camera.name,
            port,
            pairs=len(frames.names),
            normal_stddev_deg=known.normal_stddev_deg,
        )
        for camera, port, known in zip(
            rig.cameras, result.scene.ports, result.covariance.cameras, strict=True
        )
    ]


def paper_rows() -> list[Row]:
    rows = []
    for camera, rows_deg in PAPER_TRIALS_DEG.items():
        for number, (azimuth, tilt) in enumerate(rows_deg, start=1):
            phi, theta = np.radians([azimuth, tilt])
            x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
            port = FlatPort((float(x), float(y), float(np.cos(theta))))
            rows.append(_row("paper", "normals only", number, camera, port))
    return rows


def _row(
    data: str,
    method: str,
    number: int,
    camera: str,
    port: FlatPort,
    *,
    pairs: int | None = None,
    normal_stddev_deg: float | None = None,
    distance_stddev_mm: float | None = None,
) -> Row:
    x, y, z = port.normal
    found = distance_stddev_mm is not None
    return {
        "data": data,
        "method": method,
        "set": number,
        "pairs": pairs,
        "camera": camera,
        "phi_deg": float(np.degrees(np.arctan2(y, x))),
        "theta_deg": float(np.degrees(np.arctan2(np.hypot(x, y), z))),
        "normal_x_deg": float(np.degrees(np.arcsin(x))),
        "normal_y_deg": float(np.degrees(np.arcsin(y))),
        # An angle's RMS has two components.
        "component_stddev_deg": None
        if normal_stddev_deg is None
        else normal_stddev_deg / np.sqrt(2.0),
        "distance_mm": 1e3 * port.distance if found else None,
        "distance_stddev_mm": distance_stddev_mm,
    }


def spreads(rows: Sequence[Row]) -> list[Row]:
    """Mean and standard deviation over the sets, beside what was predicted."""
    found = []
    for key in dict.fromkeys((r["data"], r["method"], r["camera"]) for r in rows):
        mine = select(rows, data=key[0], method=key[1], camera=key[2])
        line: Row = dict(zip(("data", "method", "camera"), key, strict=True))
        line["sets"] = len(mine)
        for name in ("theta", "phi", "normal_x", "normal_y"):
            values = np.array(column(mine, f"{name}_deg"))
            if name == "phi":  # an angle of 359 degrees is near one of 1
                values = values[0] + (values - values[0] + 180.0) % 360.0 - 180.0
            line[f"{name}_mean_deg"] = float(np.mean(values))
            line[f"{name}_sd_deg"] = float(np.std(values, ddof=1))
        line["component_predicted_deg"] = _rms_or_none(mine, "component_stddev_deg")
        distances = column(mine, "distance_mm")
        known = distances[0] is not None
        line["distance_mean_mm"] = float(np.mean(distances)) if known else None
        line["distance_sd_mm"] = float(np.std(distances, ddof=1)) if known else None
        line["distance_predicted_mm"] = _rms_or_none(mine, "distance_stddev_mm")
        found.append(line)
    return found


def _rms_or_none(rows: Sequence[Row], name: str) -> float | None:
    values = column(rows, name)
    if values[0] is None:
        return None
    return float(np.sqrt(np.nanmean(np.square(np.array(values, dtype=float)))))


def chance_of_ratio(first: float, count: int, second: float, other: int) -> float:
    """Chance of a ratio of two variances as large, the larger one above, if both are
    equal: of standard deviations of so many numbers."""
    ratio, freedom = (first / second) ** 2, (count - 1, other - 1)
    if ratio < 1.0:
        ratio, freedom = 1.0 / ratio, freedom[::-1]
    return float(f_distribution.sf(ratio, *freedom))
