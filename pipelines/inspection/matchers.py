"""What the matcher, OpenCV's WLS filter and the refinement leave of disparities.

    python pipelines/inspection/matchers.py OUT

after pipeline.py -o OUT: frames of the rendered reef, true calibration, errors of
disparities in pixels where both cameras see the point.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from reef import Truth, reef_spec

from uwsfm.dense import match
from uwsfm.dense.lookup import sampled
from uwsfm.dense.rectify import Pair, rectifications
from uwsfm.dense.stereo import rectified_images
from uwsfm.geometry import rigid3
from uwsfm.simulate.rigs import known_cam_from_rig

FRAMES, SIDES = (0, 7, 15), ("left", "right")


def wls(left, right, start, count):
    """The filter of cv2.ximgproc with OpenCV's own settings, where start is valid."""
    matcher = cv2.StereoSGBM_create(
        0, count, match.BLOCK, 8 * match.BLOCK**2, 32 * match.BLOCK**2, 1,
        match.PREFILTER_CAP, match.UNIQUENESS_PERCENT, 100, 2,
        cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    back = cv2.ximgproc.createRightMatcher(matcher)
    smoother = cv2.ximgproc.createDisparityWLSFilter(matcher)
    smoother.setLambda(8000.0)
    smoother.setSigmaColor(1.0)
    found = smoother.filter(
        matcher.compute(left, right),
        left,
        disparity_map_right=back.compute(right, left),
    )
    return np.where(np.isfinite(start), found.astype(np.float32) / 16.0, np.nan)


def main() -> None:
    out, spec = Path(sys.argv[1]), reef_spec()
    truth = Truth.of(spec, out / "reef_truth.npz")
    left, right = spec.rig.refractive_cameras()
    pose = known_cam_from_rig(spec.rig)[1]
    errors: dict[str, list[np.ndarray]] = {}
    for frame in FRAMES:
        points = truth.points(frame)
        near, far = np.percentile(points[np.isfinite(points[:, 2]), 2], [0.5, 99.5])
        pair = Pair(left=left, right=right, right_from_left=pose, near=near, far=far)
        (slab,) = rectifications(pair)
        names = (out / f"reef/images/{side}/{frame + 1:04d}.jpg" for side in SIDES)
        raw = (cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names)
        a, b = rectified_images(slab, *raw)
        start = match.match_tiles(a, b, slab.num_disparities, 1e9)
        kinds = {
            "semi-global": start,
            "semi-global, WLS": wls(a, b, start, slab.num_disparities),
            "semi-global, refined": match.refine(a, b, start, np.zeros_like(start))[0],
        }
        uv = slab.rect_from_left_rays(truth.origins, truth.dirs)
        shown, _ = right.img_from_point(rigid3.transform(pose, points))
        true = uv[:, 0] - slab.rect_from_right_img(shown)[:, 0]
        at = (uv - 0.5).astype(np.float32).reshape(*truth.visible[frame].shape, 2)
        seen = truth.visible[frame].ravel()
        for name, disparity in kinds.items():
            error = sampled(disparity, at).ravel() - true
            errors.setdefault(name, []).append(error[seen])
    print("| disparities by | found % | robust sd px | beyond 0.9 px % |")
    print("|---|---|---|---|")
    for name, parts in errors.items():
        error = np.concatenate(parts)
        found = error[np.isfinite(error)]
        spread = 1.4826 * np.median(np.abs(found - np.median(found)))
        print(
            f"| {name} | {100 * len(found) / len(error):.1f} | {spread:.3f} | "
            f"{100 * np.mean(np.abs(found) > 0.9):.1f} |"
        )


if __name__ == "__main__":
    main()
