"""Ways to a pose of a trial: this program, COLMAP, pinholes, the bound.

Errors are those of the real camera: rotation in degrees, and the position in
millimetres (absolute) or the direction of motion in degrees (relative).
"""

from collections.abc import Callable

import numpy as np
import pycolmap
from pose_trials import FOCAL_PX, N_WATER, SIZE, AbsoluteTrial, RelativeTrial

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.sfm.poses.absolute_pose import checked, estimate_rig_pose
from uwsfm.sfm.poses.kernel_rows import near_rays, rig_rows
from uwsfm.sfm.poses.relative_pose import RelativePoseOptions, estimate_relative_pose
from uwsfm.sfm.poses.relative_pose_kernel import pair_equations
from uwsfm.sfm.poses.rig_pose_kernel import covariance_from_hessian, normal_equations
from uwsfm.sfm.rig_checks.pinhole_fit import fit_virtual_pinhole
from uwsfm.solver.losses import LOSS_CODES

NUM_DRAWS = 20
MAX_ERROR_PX = 12.0
"""Of COLMAP's absolute poses: the default of its mapper."""
IDENTITY = rigid3.IDENTITY[None]
LENGTH_KNOWN = 1e12
DISTANCE_FACTOR = 1.2


# ---- Absolute poses ------------------------------------------------------------------


def absolute_ours(trial: AbsoluteTrial) -> Array | None:
    index = np.zeros(len(trial.xy), dtype=np.int64)
    found = estimate_rig_pose([trial.camera], IDENTITY, index, trial.xy, trial.points)
    return None if found is None else found.rig_from_world


def absolute_colmap(trial: AbsoluteTrial) -> Array | None:
    """COLMAP's generalized absolute pose: a pinhole per match, on its water ray."""
    origins, dirs = trial.camera.ray_from_img(trial.xy)
    usable = np.isfinite(dirs).all(axis=1)
    xy, points = trial.xy[usable], trial.points[usable]
    focal = N_WATER * FOCAL_PX
    shifts = xy - focal * dirs[usable, :2] / dirs[usable, 2:]
    cameras = [
        pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=int(SIZE[0]),
            height=int(SIZE[1]),
            params=[focal, *shift],
        )
        for shift in shifts
    ]
    placed = [pycolmap.Rigid3d(pycolmap.Rotation3d(), -o) for o in origins[usable]]
    ransac = pycolmap.RANSACOptions(max_error=MAX_ERROR_PX, random_seed=0)
    answer = pycolmap.estimate_and_refine_generalized_absolute_pose(
        xy, points, list(range(len(xy))), placed, cameras, ransac
    )
    return None if answer is None else np.array(answer["rig_from_world"].params)


def absolute_pinhole(trial: AbsoluteTrial) -> Array | None:
    """The best pinhole for the true median depth, and COLMAP's P3P with refinement."""
    pinhole = fit_virtual_pinhole(trial.camera, trial.depths)
    xy = pinhole.img_from_real_img(trial.camera, trial.xy)
    usable = np.isfinite(xy).all(axis=1)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = MAX_ERROR_PX
    options.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(
        xy[usable], trial.points[usable], pinhole.camera(), options
    )
    if answer is None:
        return None
    virtual_from_world = np.array(answer["cam_from_world"].params)
    return rigid3.compose(rigid3.inverse(pinhole.virtual_from_cam), virtual_from_world)


def absolute_errors(pose: Array, trial: AbsoluteTrial) -> tuple[float, float]:
    """Rotation in degrees, position of the camera in millimetres."""
    delta = rigid3.compose(pose, rigid3.inverse(trial.cam_from_world))
    centres = [rigid3.inverse(p)[4:] for p in (pose, trial.cam_from_world)]
    turn = float(np.degrees(rigid3.rotation_angle(delta)))
    return turn, float(1e3 * np.linalg.norm(centres[0] - centres[1]))


def absolute_bound(
    trial: AbsoluteTrial, noise_px: float, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Errors drawn from the Cramer-Rao bound: right matches alone, no search."""
    index = np.zeros(len(trial.xy), dtype=np.int64)
    matches, rig = checked([trial.camera], IDENTITY, index, trial.xy, trial.points)
    hessian, grad = np.empty((6, 6)), np.empty(6)
    row = rigid3.matrix_rows(trial.cam_from_world)
    loss = LOSS_CODES["l2"]
    normal_equations(row, matches, trial.right, rig, loss, 1.0, hessian, grad)
    covariance = covariance_from_hessian(hessian, noise_px)
    draws = rng.multivariate_normal(np.zeros(6), covariance, NUM_DRAWS)
    poses = rigid3.perturb(trial.cam_from_world, draws)
    return [absolute_errors(pose, trial) for pose in poses]


# ---- Relative poses ------------------------------------------------------------------


def relative_ours(trial: RelativeTrial) -> Array | None:
    camera = trial.camera
    found = estimate_relative_pose(camera, camera, trial.xy_a, trial.xy_b)
    return None if found is None else found.b_from_a


def relative_told(trial: RelativeTrial) -> Array | None:
    """The same, told the true median distance as the pinhole is."""
    camera = trial.camera
    options = RelativePoseOptions(
        scene_distance_m=trial.depths[1], scene_distance_factor=DISTANCE_FACTOR
    )
    found = estimate_relative_pose(camera, camera, trial.xy_a, trial.xy_b, options)
    return None if found is None else found.b_from_a


def relative_pinhole(trial: RelativeTrial) -> Array | None:
    """The best pinhole for the true median depth, COLMAP's RANSAC and refinement."""
    pinhole = fit_virtual_pinhole(trial.camera, trial.depths)
    xy_a, xy_b = (
        pinhole.img_from_real_img(trial.camera, xy) for xy in (trial.xy_a, trial.xy_b)
    )
    usable = np.isfinite(xy_a).all(axis=1) & np.isfinite(xy_b).all(axis=1)
    xy_a, xy_b = xy_a[usable], xy_b[usable]
    camera = pinhole.camera()
    ransac = pycolmap.RANSACOptions(max_error=4.0, random_seed=0)
    answer = pycolmap.estimate_relative_pose(camera, xy_a, camera, xy_b, ransac)
    if answer is None:
        return None
    refined = pycolmap.refine_relative_pose(
        answer["cam2_from_cam1"], camera, xy_a, camera, xy_b, answer["inlier_mask"]
    )
    moved = (refined or answer)["cam2_from_cam1"]
    # Its length is lost: that of the truth, which gives the pinhole all it can use.
    pose = np.array(moved.params)
    pose[4:] *= np.linalg.norm(trial.b_from_a[4:]) / np.linalg.norm(pose[4:])
    to_virtual = pinhole.virtual_from_cam
    return rigid3.compose(rigid3.inverse(to_virtual), rigid3.compose(pose, to_virtual))


def relative_errors(pose: Array, trial: RelativeTrial) -> tuple[float, float]:
    """Rotation, and direction of the translation, in degrees."""
    delta = rigid3.compose(pose, rigid3.inverse(trial.b_from_a))
    a, b = pose[4:], trial.b_from_a[4:]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    return float(np.degrees(rigid3.rotation_angle(delta))), float(np.degrees(angle))


def relative_bound(
    trial: RelativeTrial, noise_px: float, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Errors drawn from the Cramer-Rao bound, had the length of the motion been known.

    Right matches alone, no search.
    """
    cameras = [trial.camera]
    rows: list[Array] = []
    index = np.zeros(len(trial.xy_a), dtype=np.int64)
    for xy in (trial.xy_a, trial.xy_b):
        rows += [index, xy, near_rays(cameras, index, xy)[0]]
    hessian, grad = np.empty((6, 6)), np.empty(6)
    pose = rigid3.matrix_rows(trial.b_from_a)
    robust = (LOSS_CODES["l2"], 1.0)
    prior = (0.0, LENGTH_KNOWN)
    rig, _ = rig_rows(cameras, IDENTITY)
    pair_equations(pose, tuple(rows), trial.right, rig, robust, prior, hessian, grad)
    covariance = covariance_from_hessian(hessian, noise_px)
    draws = rng.multivariate_normal(np.zeros(6), covariance, NUM_DRAWS)
    poses = rigid3.perturb(trial.b_from_a, draws)
    return [relative_errors(pose, trial) for pose in poses]


Absolute = Callable[[AbsoluteTrial], Array | None]
Relative = Callable[[RelativeTrial], Array | None]

ABSOLUTE: dict[str, Absolute] = {
    "uwsfm": absolute_ours,
    "COLMAP, pinhole per match": absolute_colmap,
    "best-fit pinhole": absolute_pinhole,
}
RELATIVE: dict[str, Relative] = {
    "uwsfm": relative_ours,
    "uwsfm, distance told": relative_told,
    "best-fit pinhole": relative_pinhole,
}
