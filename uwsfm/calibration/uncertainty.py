"""What is known of the estimates at an optimum: covariances and standard deviations."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.indices import distinct, renumbered
from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.priors import border_priors, with_terms
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import CameraCovariance, Covariance
from uwsfm.calibration.scale import by_unknowns, scale_slope
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import kind_of_row
from uwsfm.residuals import border as border_of
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.clustered import cluster_scores, clustered_covariance
from uwsfm.solver.covariance import (
    ReducedCovariance,
    point_covariances,
    reduced_covariance,
)
from uwsfm.solver.error_models import error_model
from uwsfm.solver.layout import HELD, Layout, build_layout
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    Priors,
    Problem,
    suitable_blas,
)
from uwsfm.solver.linear.reduction import Reduction, analyse
from uwsfm.solver.normal_equations import NormalEquations, empty_normal_equations
from uwsfm.solver.state import State, translation_arm
from uwsfm.solver.terms import centers

# Neighbours err together within a quarter of an image. Fewer, larger clusters would
# number less than the poses they have to tell apart.
TILES = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimum:
    """A least-squares optimum over part of a scene."""

    layout: Layout
    state: State
    """Points numbered as in the layout."""
    used: IndexArray
    """(P',) index of each of these points in the scene."""
    num_points: int
    """Of the scene."""
    columns: IndexArray
    """(C, BORDER_SIZE)"""
    at_zero: NDArray[np.bool_]
    """(C,) distances held at their bound."""
    priors: Priors | None
    sigma_px: float
    image_sizes: IndexArray
    """(C, 2) width, height."""
    degrees_of_freedom: int
    scale_ends: IndexArray
    """(2,) two frames far apart."""
    scale_held: bool
    """Because nothing determines it."""


class Posterior(NamedTuple):
    covariance: Covariance
    navigation: Array
    """(6, 6) of nav_from_world, left tangent; empty if that is not estimated."""


def posterior_covariance(optimum: Optimum) -> Posterior:
    """Covariances from the noise found, and standard deviations that neighbours' shared
    errors cannot beat."""
    reduction = analyse(optimum.layout)
    with suitable_blas(reduction):
        return _posterior_covariance(optimum, reduction)


def border_covariance(optimum: Optimum) -> Array:
    """Covariance (B, B) of rig, ports and lenses, neighbours' shared errors included.

    That of independent errors, with each variance raised to the cluster-robust one
    where that is larger: a full matrix of few clusters has directions of no variance.
    """
    reduction = analyse(optimum.layout)
    with suitable_blas(reduction):
        eqs = likelihood(optimum.layout, optimum.state, optimum.priors)
        reduced = reduced_covariance(optimum.layout, eqs, reduction)
        alone = optimum.sigma_px**2 * reduced.border
        if not reduced.determined:
            return alone
        shared = _shared_errors(optimum, eqs, reduced)
    own = np.diag(alone)
    raised = np.sqrt(np.maximum(np.diag(shared), own) / np.maximum(own, 1e-300))
    return raised[:, None] * alone * raised


def held_length_stddev(optimum: Optimum) -> float:
    """Relative standard deviation of the distance between the two frames that holds an
    open scale, if it were free; infinite if it is open."""
    reduction = analyse(optimum.layout)
    with suitable_blas(reduction):
        eqs = likelihood(optimum.layout, optimum.state, optimum.priors)
        reduced = reduced_covariance(optimum.layout, eqs, reduction)
        if not reduced.determined:
            return np.inf
        stddev = _frame_distance_stddev(
            optimum.layout, optimum.state, reduced, optimum.scale_ends
        )
    return optimum.sigma_px * stddev


def _frame_distance_stddev(
    layout: Layout, state: State, reduced: ReducedCovariance, ends: IndexArray
) -> float:
    """Relative standard deviation of the distance between two frames, unit noise."""
    first, second = centers(state.rig_from_world[ends])
    length = float(np.linalg.norm(first - second))
    if length == 0.0:
        return 0.0
    slope = np.zeros(layout.num_frame_cols + layout.num_border_cols)
    for frame, sign in zip(ends, (1.0, -1.0), strict=True):
        col = int(layout.frame_col[frame])
        if col != HELD:
            away = sign * (second - first) / length
            slope[col + 3 : col + 6] = rigid3.rotate(state.rig_from_world[frame], away)
    return float(np.sqrt(reduced.variance_of(slope))) / length


def _posterior_covariance(optimum: Optimum, reduction: Reduction) -> Posterior:
    layout = optimum.layout
    eqs = likelihood(layout, optimum.state, optimum.priors)
    reduced = reduced_covariance(layout, eqs, reduction)
    variance = optimum.sigma_px**2
    border = variance * reduced.border
    points = np.full((optimum.num_points, 3, 3), np.nan)
    points[optimum.used] = variance * point_covariances(layout, eqs, reduced)
    shared = np.full_like(border, np.nan)
    if reduced.determined:
        shared = _shared_errors(optimum, eqs, reduced)
    cameras = []
    for camera, pose in enumerate(optimum.state.cam_from_rig):
        cols, at_zero = optimum.columns[camera], bool(optimum.at_zero[camera])
        dome = kind_of_row(optimum.state.ports[camera]).has("center")
        alone, together = (
            camera_variances(b, cols, pose, dome) for b in (border, shared)
        )
        # Sampling noise can make the second one smaller: then the first is the truth.
        cameras.append(camera_covariance(np.maximum(alone, together), at_zero))
    scale = None
    if not optimum.scale_held:
        scale = _scale_stddev(optimum, eqs, reduced)
    covariance = Covariance(
        border=border,
        border_cols=optimum.columns,
        frames=variance * reduced.frames,
        points=points,
        cameras=tuple(cameras),
        determined=reduced.determined,
        scale_stddev=scale,
    )
    return Posterior(covariance, variance * reduced.navigation)


def predict_covariance(
    scene: Scene, noise_px: float, *, lengths: Lengths | None = None, **options: Any
) -> Covariance:
    """What observations like these can tell at best: the Cramer-Rao bound.

    Args:
        scene: its values are taken for the truth; only the places of its observations
            matter, not their errors.
        noise_px: standard deviation of every image coordinate, errors independent.
        lengths: that are known beside the baselines.
        **options: fields of `CalibrateOptions`.

    Raises:
        InputError: an unknown option, or observations that cannot be made.
    """
    settings = CalibrateOptions.parsed(options)
    if not 0.0 < noise_px < np.inf:
        raise InputError(f"noise_px must be positive and finite, got {noise_px}")
    pixels, valid = scene.projections()
    if not np.all(valid):
        row = int(np.nonzero(~valid)[0][0])
        raise InputError(
            f"observation {row} cannot be made: its point does not project"
        )
    scene = replace(scene, xy=pixels)
    at_zero = np.zeros(len(scene.cameras), dtype=bool)
    columns = settings.border_columns(scene.cameras, at_zero)
    outside = Outside(scene, lengths or Lengths())
    outside.robust = False
    state = outside.placed(scene)
    layout = build_layout(
        scene,
        columns,
        navigation=outside.navigation,
        num_lengths=outside.num_lengths,
    )
    used, frames = distinct(scene.point_idx), distinct(scene.frame_idx)
    own = border_priors(scene, settings, columns, noise_px)
    priors = with_terms(own, outside.terms(used, frames, noise_px), state)
    eqs = likelihood(layout, state, priors)
    reduced = reduced_covariance(layout, eqs)
    variance = noise_px**2
    scale = None
    if not outside.hold_scale:
        unit_variance = _scale_variance(layout, state, eqs, reduced)[0]
        scale = noise_px * float(np.sqrt(unit_variance))
    border = variance * reduced.border
    return Covariance(
        border=border,
        border_cols=columns,
        frames=variance * reduced.frames,
        points=variance * point_covariances(layout, eqs, reduced),
        cameras=tuple(
            camera_covariance(
                camera_variances(border, cols, pose, port.has("center")), False
            )
            for cols, pose, port in zip(
                columns, scene.cam_from_rig, scene.ports, strict=True
            )
        ),
        determined=reduced.determined,
        scale_stddev=scale,
    )


def _scale_variance(
    layout: Layout, state: State, eqs: NormalEquations, reduced: ReducedCovariance
) -> tuple[float, float, Array]:
    """Variance of the scale, unit noise, see `uwsfm.calibration.scale`; the part of the
    points' own noise; and S^-1 times its derivative (n,)."""
    if reduced.found is None:
        return np.nan, np.nan, np.empty(0)
    slope = scale_slope(state.points, reduced.points)
    right = by_unknowns(layout, eqs, reduced.points, slope)
    solved = reduced.found.times(right[:, None])[:, 0]
    own = float(np.einsum("pi,pij,pj->", slope, reduced.points, slope))
    return float(right @ solved) + own, own, solved


def _scale_stddev(
    optimum: Optimum, eqs: NormalEquations, reduced: ReducedCovariance
) -> float:
    """Of the scale, the larger of two as in `CameraCovariance`; NaN if it is open."""
    layout, state = optimum.layout, optimum.state
    alone, own, solved = _scale_variance(layout, state, eqs, reduced)
    if not np.isfinite(alone):
        return np.nan
    scores = cluster_scores(
        layout,
        state.kernel_state(),
        eqs,
        reduced,
        clusters_of(optimum),
        solved[None],
    )
    share = 2 * len(layout.xy) / optimum.degrees_of_freedom
    together = float(np.sum(scores**2)) * share + optimum.sigma_px**2 * own
    if optimum.priors is not None:
        split = layout.num_frame_cols
        by_frame = solved[:split].reshape(-1, 6, 1)
        prior = prior_covariance(
            layout, state, optimum.priors, by_frame, solved[split:, None]
        )
        together += optimum.sigma_px**2 * float(prior[0, 0])
    return float(np.sqrt(max(optimum.sigma_px**2 * alone, together)))


def likelihood(layout: Layout, state: State, priors: Priors | None) -> NormalEquations:
    """Normal equations of the reprojection error and the priors, squared loss."""
    options = LevenbergMarquardtOptions(loss="l2")
    error = error_model(options.error, layout, state)
    return Problem(layout, error, options, priors).linearize(state)


def _shared_errors(
    optimum: Optimum, eqs: NormalEquations, reduced: ReducedCovariance
) -> Array:
    """Cluster-robust covariance (B, B) of the border, priors included."""
    layout = optimum.layout
    covariance = clustered_covariance(
        layout, optimum.state.kernel_state(), eqs, reduced, clusters_of(optimum)
    )
    # Residuals are smaller than errors by the share of fitted parameters.
    covariance *= 2 * len(layout.xy) / optimum.degrees_of_freedom
    if optimum.priors is not None:
        prior = prior_covariance(
            layout,
            optimum.state,
            optimum.priors,
            reduced.coupling,
            reduced.whole_border,
        )
        covariance += optimum.sigma_px**2 * prior
    return covariance[: layout.num_camera_cols, : layout.num_camera_cols]


def prior_covariance(
    layout: Layout, state: State, priors: Priors, by_frame: Array, by_border: Array
) -> Array:
    """What the errors of the priors do to some numbers (K, K): S^-1 K S^-1, with K what
    they alone add to the reduced matrix.

    A length's own variance is the noise of its column.

    Args:
        layout, state, priors: of the optimum.
        by_frame: (F, 6, K) of the free frames, and
        by_border: (B, K) of the border: columns of S^-1.
    """
    eqs = empty_normal_equations(layout)
    priors.add_to(eqs, state, layout)
    free = np.flatnonzero(layout.frame_col != HELD)
    num_unknown = layout.num_border_cols - layout.num_lengths
    border = eqs.border.copy()
    border[num_unknown:] *= -1.0
    border[num_unknown:, :num_unknown] = border[:num_unknown, num_unknown:] = 0.0
    coupling = eqs.frames_border[free]
    coupling[:, :, num_unknown:] = 0.0
    own = np.einsum(
        "fak,fab,fbm->km", by_frame, eqs.frames[free], by_frame, optimize=True
    )
    across = np.einsum("fak,fab->kb", by_frame, coupling) @ by_border
    return own + across + across.T + by_border.T @ border @ by_border


def clusters_of(optimum: Optimum) -> IndexArray:
    """Cluster (N,) of each sorted observation: its image, and the tile in it."""
    layout = optimum.layout
    frame = np.repeat(layout.cell_frame, np.diff(layout.cell_start))
    place = TILES * layout.xy / optimum.image_sizes[layout.camera]
    column, row = np.clip(place.astype(np.int64), 0, TILES - 1).T
    size = (len(layout.border_col), len(layout.frame_col), TILES, TILES)
    keys = np.ravel_multi_index((layout.camera, frame, row, column), size)
    return renumbered(keys, int(np.prod(size)))[1]


def camera_variances(
    border: Array, cols: IndexArray, cam_from_rig: Array, dome: bool = False
) -> Array:
    """Variances (9,) of one camera from the border's covariance.

    Of the angle of the normal and the port distance, of the rotation angle of
    cam_from_rig, of its translation's x, y, z, and of the dome's centre x, y, z;
    radians and metres, squared. What the kind of port does not have is zero.
    """
    padded = np.zeros((len(border) + 1, len(border) + 1))
    padded[:-1, :-1] = border  # HELD = -1 reads the zeros at the end
    block = padded[np.ix_(cols, cols)]
    arm = translation_arm(cam_from_rig[4:]).reshape(3, 3)
    translation = np.einsum("ka,kl,la->a", arm, block[3:6, 3:6], arm)
    rotation, normal = (
        np.trace(block[part, part]) for part in (border_of.ROTATION, border_of.NORMAL)
    )
    distance = block[border_of.DISTANCE, border_of.DISTANCE]
    center = np.zeros(3)
    if dome:
        center = np.diag(block[border_of.CENTER, border_of.CENTER])
        normal = distance = 0.0
    return np.array([normal, distance, rotation, *translation, *center])


def camera_covariance(variances: Array, at_zero: bool) -> CameraCovariance:
    """Standard deviations of variances (9,) as of `camera_variances`."""
    normal, distance, rotation, x, y, z, *center = np.sqrt(variances).tolist()
    return CameraCovariance(
        normal_stddev_deg=float(np.degrees(normal)),
        distance_stddev_m=distance,
        rotation_stddev_deg=float(np.degrees(rotation)),
        translation_stddev_m=(x, y, z),
        center_stddev_m=(center[0], center[1], center[2]),
        distance_at_zero=at_zero,
    )
