"""One camera in the sea, its lens never calibrated and its window unknown.

    python pipelines/coral_tg5/pipeline.py DATA -o OUT

DATA holds the photographs (see README.md beside this file). The lens starts from the
focal length of the camera's data sheet, the window from what such cameras have; both
are refined within what is known of them. COLMAP, self-calibrated with OPENCV from the
same features, stands beside.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import yaml

import uwsfm
from uwsfm.cli.console import ProgressBars, console
from uwsfm.cli.tables import housing_table, result_table
from uwsfm.jobs.reconstruct import WORK

FOCAL_PX = 867.0
"""25 mm, reduced to 35 mm film, on 1200 x 900 pixels."""
WINDOW: dict[str, Any] = {
    "type": "flat",
    "normal": [0.0, 0.0, 1.0],
    "distance_m": 0.005,
    "thickness_m": 0.002,
    "glass_index": 1.52,
    # One camera and no length: its distance would scale with everything else.
    "refine": ["normal"],
}
KNOWN = {
    "focal_stddev": 0.03,
    "principal_point_stddev_px": 15.0,
    "distortion_stddev": 0.05,
    "normal_stddev_deg": 1.0,
}
"""How well: a zoom lens at its wide end, a window square to it by construction."""
REFINE = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
}
SCENE_DISTANCE_M = 0.6


def write_rig(data: Path, path: Path) -> None:
    params = [FOCAL_PX, FOCAL_PX, 600.0, 450.0, 0.0, 0.0, 0.0, 0.0]
    camera = {
        "name": "TG-5",
        "images": data.name,
        "intrinsics": {
            "model": "OPENCV",
            "width_px": 1200,
            "height_px": 900,
            "params": params,
        },
        "port": WINDOW,
    }
    rig = {"version": 1, "water": {"refractive_index": 1.34}, "cameras": [camera]}
    path.write_text(yaml.safe_dump(rig, sort_keys=False), encoding="utf-8")


def self_calibrated(data: Path, out: Path) -> pycolmap.Reconstruction:
    """Stock COLMAP on the features and matches of the workspace."""
    database = out / WORK / "database.db"
    copy = out / "colmap.db"
    copy.write_bytes(database.read_bytes())
    with pycolmap.Database.open(copy) as opened:
        camera = opened.read_all_cameras()[0]
        camera.model = pycolmap.CameraModelId.OPENCV
        focal = 1.333 * FOCAL_PX
        camera.params = [focal, focal, 600.0, 450.0, 0.0, 0.0, 0.0, 0.0]
        opened.update_camera(camera)
    pycolmap.geometric_verification(copy)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)
    options.extract_colors = False
    models = pycolmap.incremental_mapping(copy, data.parent, out / "colmap", options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--mapper", default="refractive")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    data, out = options.data.resolve(), options.out
    out.mkdir(parents=True, exist_ok=True)
    write_rig(data, out / "rig.yaml")
    with ProgressBars() as progress:
        result = uwsfm.reconstruct(
            out / "rig.yaml",
            data.parent,
            out / "result",
            mapper=options.mapper,
            scene_distance_m=SCENE_DISTANCE_M,
            progress=progress,
            **REFINE,
            **KNOWN,
        )
    console.print(result_table(result.summary))
    console.print(housing_table(result.summary))
    for entry in result.summary["refined"]:
        stddev = entry["stddev"]
        known = "not determined" if stddev is None else f"± {stddev:.3g}"
        print(f"{entry['name']}: {entry['value']:.5g} {known}")
    for warning in result.summary["warnings"]:
        print("note:", warning)
    print(
        f"refractive: {result.summary['num_registered_frames']} images, "
        f"{result.summary['num_points']} points, "
        f"{result.summary['reprojection_mean_px']:.3f} px"
    )
    model = self_calibrated(data, out / "result")
    print(
        f"COLMAP, self-calibrated: {model.num_reg_images()} images, "
        f"{model.num_points3D()} points, {model.compute_mean_reprojection_error():.3f} "
        f"px, {np.round(next(iter(model.cameras.values())).params, 3).tolist()}"
    )


if __name__ == "__main__":
    main()
