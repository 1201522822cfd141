"""Dense clouds against exact depths, against pinholes, and on a real board.

    python pipelines/inspection/pipeline.py -o OUT [--tank DATA]

Renders a reef, reconstructs it from the rig one would write down, and compares every
depth with that of the ray that rendered the pixel. DATA is the folder of
pipelines/uril_tank. What is in OUT already is not made again.
"""

import argparse
import resource
import time
from pathlib import Path

import cv2
import numpy as np
import plots
from board import fused_board, single_frames
from pinhole import RectifiedPinholes, aligned, best_pinholes
from reef import Truth, reef_spec, scores

import uwsfm
from uwsfm.cli.console import ProgressBars
from uwsfm.dense.maps import depth_maps
from uwsfm.simulate.sequence import SequenceSpec, near_spec, render_sequence

HERE = Path(__file__).parent
WORDS = (
    "| depths by | within 3 sd % | median / sd | bend % | by radius % | by range % |"
)


def reconstructed(rig: Path, images: Path, out: Path) -> None:
    if not (out / "calibration.npz").exists():
        with ProgressBars() as progress:
            uwsfm.reconstruct(rig, images, out, progress=progress)


def dense(out: Path, images: Path, **options) -> uwsfm.Cloud:
    """The cloud; how long it took and what memory, if every depth map was made."""
    start, before = time.monotonic(), time.process_time()
    # The truth of the dives before is in this process, too.
    options = {"max_memory": 4e9, **options}
    with ProgressBars() as progress:
        result = uwsfm.dense_cloud(out, images, progress=progress, **options)
    summary = result.summary
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"\n{len(summary['depth_maps'])} frames: {time.monotonic() - start:.0f} s, "
        f"{time.process_time() - before:.0f} s of processor time, peak {peak:.2f} GB; "
        f"{len(result.cloud)} points, noise {summary['noise_px']:.3f} px, standard "
        f"deviations {summary['stddev_percentiles']}, "
        f"{summary['num_contradicted']} contradicted\n"
    )
    return result.cloud


def refractive_maps(out: Path, images: Path):
    for view, depth in depth_maps(out, images):
        yield view.frame, depth.ranges, depth.sensitivity


def pinhole_maps(out: Path, images: Path, truth: Truth):
    """Ranges of the pinholes: the true ones and the errors along the sight."""
    model = uwsfm.read_model(out)
    scene, rms = best_pinholes(model.scene)
    residuals = model.scene.residuals()
    own = np.sqrt(np.nanmean(np.sum(residuals**2, axis=1)))
    print(f"RMS: best pinholes {rms:.3f} px, refractive {own:.3f} px")
    depths = scene.points_in_cam()[:, 2]
    near, far = np.percentile(depths[np.isfinite(depths)], [1, 99])
    rectified = RectifiedPinholes(scene, near=0.85 * near, far=1.15 * far)
    found, sensitivities, true = [], [], []
    for frame in range(scene.num_frames):
        pair = (
            cv2.imread(str(images / model.image_name(c, frame)), cv2.IMREAD_GRAYSCALE)
            for c in (0, 1)
        )
        points, sensitivity = rectified.points(*pair)
        found.append(points)
        sensitivities.append(sensitivity)
        true.append(truth.points(frame))
    errors = aligned(found, true, truth.dirs)
    for frame, error in enumerate(errors):
        yield frame, truth.ranges[frame] + error, sensitivities[frame]


def rendered(out: Path, name: str, spec: SequenceSpec) -> None:
    """One rendered dive: the cloud, the table, the pictures."""
    images, result = out / name / "images", out / f"{name}_out"
    if not images.exists():
        with ProgressBars() as progress:
            render_sequence(spec, out / name, progress)
    reconstructed(out / name / "rig.yaml", images, result)
    cloud = dense(result, images)
    truth = Truth.of(spec, out / f"{name}_truth.npz")
    kept = {
        "refractive": list(refractive_maps(result, images)),
        "pinholes": list(pinhole_maps(result, images, truth)),
    }
    seen = truth.ranges[truth.visible]
    near, far = np.percentile(seen, [1, 99])
    print(f"\n{name}: both see {near:.2f} to {far:.2f} m\n\n{WORDS}")
    print("|---|---|---|---|---|---|")
    for kind, maps in kept.items():
        print(scores(truth, iter(maps)).row(kind))
    plots.errors(truth, kept, HERE / f"{name}_errors.png")
    plots.cloud(cloud, HERE / f"{name}_cloud.png")


def tank(out: Path, data: Path) -> None:
    result = out / "tank_out"
    if not (result / "calibration.npz").exists():
        raise SystemExit(f"first: pipelines/uril_tank/pipeline.py, its run as {result}")
    cloud = dense(result, data)
    frames = single_frames(result, data)
    print("\n| frame | board covered % | RMS mm | 0.3 px mm | ratio |")
    print("|---|---|---|---|---|")
    for f in frames:
        ratio = f.rms_mm / f.predicted_mm
        print(
            f"| {f.name} | {100 * f.completeness:.0f} | {f.rms_mm:.2f} | "
            f"{f.predicted_mm:.2f} | {ratio:.2f} |"
        )
    ratios = [f.rms_mm / f.predicted_mm for f in frames]
    board = fused_board(result, data, cloud)
    print(
        f"\nmedian ratio {np.median(ratios):.2f}, largest {max(ratios):.2f}; fused: "
        f"{board.num_points} points, RMS {board.rms_mm:.2f} mm (said "
        f"{board.stddev_mm:.2f}), bend {board.bend_mm:.2f} mm"
    )
    plots.board(board, HERE / "tank_board.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--tank", type=Path)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rendered(options.out, "reef", reef_spec())
    rendered(options.out, "near", near_spec())
    if options.tank is not None:
        tank(options.out, options.tank)


if __name__ == "__main__":
    main()
