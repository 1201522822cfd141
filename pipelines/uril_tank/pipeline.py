"""Target-free housing calibration on a real stereo rig in a tank, against pinholes.

    python pipelines/uril_tank/pipeline.py DATA -o OUT

DATA is the folder with left/, right/, in_air_calibration.json, in_air_corners.npz and
tank_corners.npz; the last one is only used to check the results.
"""

import argparse
from pathlib import Path

import numpy as np
import self_calibrated
from board import BoardChecks, check_boards, pinhole_rays
from budget import budget_table, recalibration
from tank_rig import write_rig

import uwsfm
from uwsfm.cli.console import ProgressBars
from uwsfm.jobs.reconstruct import WORK


def run_refractive(data: Path, out: Path, **how: bool):
    """Reconstruct with one choice of what is trusted; features are found once."""
    rig_file = out / "rig.yaml"
    write_rig(data, rig_file, **how)
    with ProgressBars() as progress:
        result = uwsfm.reconstruct(rig_file, data, out / "run", progress=progress)
    left, right = result.model.scene.cameras
    checks = check_boards(
        data / "tank_corners.npz",
        left.ray_from_img,
        right.ray_from_img,
        result.model.scene.cam_from_rig[1],
    )
    return result, checks


def housing_line(summary: dict) -> str:
    parts = []
    for camera in summary["cameras"]:
        x, y, _ = np.degrees(np.arcsin(camera["normal"]))
        stddev = camera["distance_stddev_m"]
        known = "at its bound" if stddev is None else f"±{1e3 * stddev:.1f}"
        parts.append(f"({x:+.2f}, {y:+.2f}) {1e3 * camera['distance_m']:.1f} {known}")
    return " | ".join(parts)


def board_line(name: str, checks: BoardChecks, error: float | None) -> str:
    error_text = "-" if error is None else f"{error:.3f}"
    return (
        f"| {name} | {checks.square_mean:.2f} | {checks.square_stddev:.3f} | "
        f"{checks.planarity:.3f} | {checks.gap:.3f} | {error_text} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    data, out = options.data, options.out
    out.mkdir(parents=True, exist_ok=True)
    variants = {
        "whole image, rig refined": {"whole_image": True, "free_rig": True},
        "whole image, rig held": {"whole_image": True, "free_rig": False},
        "covered lens, rig refined": {"whole_image": False, "free_rig": True},
        "covered lens, rig held": {"whole_image": False, "free_rig": False},
    }
    boards, housings = [], []
    for name, how in variants.items():
        result, checks = run_refractive(data, out, **how)
        summary = result.summary
        error = summary["reprojection_mean_px"]
        boards.append(board_line(f"refractive, {name}", checks, error))
        housings.append(f"| {name} | {housing_line(summary)} |")
    # `result` is now that of the last variant, the one to be recommended.
    rig = result.model.rig
    in_air = check_boards(
        data / "tank_corners.npz",
        *(pinhole_rays(camera.camera) for camera in rig.cameras),
        uwsfm.load_rig(out / "rig.yaml").cam_from_rig[1],
    )
    boards.insert(0, board_line("pinhole, as calibrated in air", in_air, None))
    pinhole = self_calibrated.run(data, out / "run" / WORK, out / "pinhole", rig)
    checks = check_boards(
        data / "tank_corners.npz",
        *(pinhole_rays(camera) for camera in pinhole.cameras),
        pinhole.right_from_left,
    )
    boards.insert(1, board_line("COLMAP, self-calibrated", checks, pinhole.mean_error))

    print(
        f"\nregistered: {summary['num_registered_frames']} of {summary['num_frames']}"
    )
    print("\n| model | square mm | its sd | planarity | ray gap (mm) | error px |")
    print("|---|---|---|---|---|---|", *boards, sep="\n")
    print("\n| refractive | left: tilt x, y (deg) distance (mm) | right: the same |")
    print("|---|---|---|", *housings, sep="\n")
    print(
        "\nOn observations that both models keep "
        f"({pinhole.num_common(result.model)}): refractive "
        f"{pinhole.common_error(result.model):.3f} px, "
        f"self-calibrated {pinhole.common_own_error(result.model):.3f} px\n"
    )
    print(budget_table(result.calibration))
    print(f"\n{recalibration(data)}")


if __name__ == "__main__":
    main()
