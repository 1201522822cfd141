"""The least-squares problem of a calibration again, at its optimum."""

from dataclasses import replace

import numpy as np

from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.priors import border_priors, with_terms
from uwsfm.calibration.result import CalibrationResult
from uwsfm.calibration.solves import MIN_SIGMA_PX
from uwsfm.calibration.uncertainty import Optimum
from uwsfm.geometry import rigid3
from uwsfm.scene import Scene
from uwsfm.solver.layout import build_layout
from uwsfm.solver.state import State


def reopened(calibration: CalibrationResult) -> Optimum:
    """The optimum that a calibration ended at, with all that entered its last solve.

    Points are numbered as in the calibration's scene; the ends of its ``bars`` follow.
    Priors are weighed as around the values found, which differ from those given by
    less than matters for a weight.
    """
    scene, covariance = calibration.scene, calibration.covariance
    keep, bars = calibration.inliers, calibration.bars
    if bars is not None:
        scene = _joined(scene, bars)
        keep = np.append(keep, np.ones(bars.num_observations, dtype=bool))
    part, used = scene.select(keep)
    sigma = calibration.summary.sigma_px
    outside = Outside(scene, calibration.entered or Lengths())
    outside.robust, outside.hold_scale = False, covariance.scale_stddev is None
    state = outside.placed(scene)
    if outside.navigation:  # the scene is in the frame of the positions
        there = np.append(rigid3.IDENTITY[:4], -outside.middle)
        outside.nav_start = there
        state = replace(state, nav_from_world=there)
    layout = build_layout(
        part,
        covariance.border_cols,
        navigation=outside.navigation,
        num_lengths=outside.num_lengths,
    )
    own = border_priors(scene, calibration.options, covariance.border_cols, sigma)
    frames = np.unique(part.frame_idx)
    terms = outside.terms(used, frames, max(sigma, MIN_SIGMA_PX))
    return Optimum(
        layout=layout,
        state=replace(state, points=part.points),
        used=used,
        num_points=scene.num_points,
        columns=covariance.border_cols,
        at_zero=np.array([c.distance_at_zero for c in covariance.cameras]),
        priors=with_terms(own, terms, State.from_scene(scene)),
        sigma_px=sigma,
        image_sizes=np.array([(c.width, c.height) for c in scene.cameras]),
        degrees_of_freedom=_degrees_of_freedom(part, layout.num_unknowns),
        scale_ends=outside.ends,
        scale_held=outside.hold_scale,
    )


def _joined(scene: Scene, more: Scene) -> Scene:
    """A scene with the points and observations of another one at its end."""
    return replace(
        scene,
        points=np.vstack([scene.points, more.points]),
        camera_idx=np.append(scene.camera_idx, more.camera_idx),
        frame_idx=np.append(scene.frame_idx, more.frame_idx),
        point_idx=np.append(scene.point_idx, scene.num_points + more.point_idx),
        xy=np.vstack([scene.xy, more.xy]),
    )


def _degrees_of_freedom(part: Scene, num_unknowns: int) -> int:
    valid = np.isfinite(part.residuals()).all(axis=1)
    return 2 * int(np.count_nonzero(valid)) - num_unknowns - 3 * part.num_points
