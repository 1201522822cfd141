"""Long surveys as observations: lines up and down, cross lines that close the loops."""

from dataclasses import dataclass, replace

import numpy as np

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.simulate.observations import (
    ObservationOptions,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import lawn_mower, level_poses

CROSS_SHARE = 0.05
"""Of the frames that cross lines take."""


@dataclass(frozen=True, kw_only=True)
class SurveySpec:
    """A survey of some size; lengths in metres."""

    num_frames: int
    """Stereo pairs."""
    num_points: int
    detection_rate: float
    """Chance that a visible point is observed: it decides how many observations a
    point has, 8 to 17: a point is in sight of 6 to 10 frames."""
    spacing: float = 0.3
    """Between the frames of a line: four see a point."""
    line_spacing: float = 0.9
    """Between the lines: half of an image is on the next line, too."""
    altitude: float = 2.0
    relief: float = 0.2
    """Standard deviation of the floor's depth."""
    sway_deg: float = 3.0
    """Standard deviation of roll and pitch: no vehicle holds still."""
    heave: float = 0.1
    """Standard deviation of the place, each way."""
    noise_px: float = 0.5
    outlier_ratio: float = 0.0
    seed: int = 0


SURVEYS = {
    "pool": SurveySpec(num_frames=20, num_points=3_300, detection_rate=0.76),
    "reef": SurveySpec(num_frames=500, num_points=100_000, detection_rate=0.59),
    "field": SurveySpec(
        num_frames=5000, num_points=150_000, detection_rate=0.9, spacing=0.25
    ),
}
"""About 30 thousand, 870 thousand and 2.6 million observations."""


def survey_track(spec: SurveySpec) -> Array:
    """Poses (num_frames, 7): lines along y, then cross lines along x.

    Raises:
        InputError: too few frames for two lines and a cross line, a length that is not
            positive, or a negative sway or heave.
    """
    for name in ("spacing", "line_spacing", "altitude"):
        if not 0.0 < getattr(spec, name) < np.inf:
            raise InputError(
                f"{name} must be finite and positive, got {getattr(spec, name)}"
            )
    for name in ("sway_deg", "heave"):
        if not 0.0 <= getattr(spec, name) < np.inf:
            raise InputError(
                f"{name} must be finite and not negative, got {getattr(spec, name)}"
            )
    if spec.num_frames < 12:
        raise InputError(f"a survey needs at least 12 frames, got {spec.num_frames}")
    ratio = spec.line_spacing / spec.spacing
    num_lines = max(2, round(np.sqrt((1.0 - CROSS_SHARE) * spec.num_frames / ratio)))
    per_cross = int(np.ceil(ratio * num_lines))
    num_cross = max(1, round(CROSS_SHARE * spec.num_frames / per_cross))
    on_lines = spec.num_frames - num_cross * per_cross
    per_line = -(-on_lines // num_lines)
    lines = lawn_mower(
        num_lines,
        per_line,
        spacing=spec.spacing,
        line_spacing=spec.line_spacing,
        altitude=spec.altitude,
    )
    along = spec.spacing * (np.arange(per_cross) - 0.5 * (per_cross - 1))
    half = 0.5 * spec.spacing * (per_line - 1)
    tracks = [lines[:on_lines]]
    for cross in range(num_cross):
        y = half * ((2 * cross + 1) / num_cross - 1.0)
        centers = np.column_stack(
            [along, np.full(per_cross, y), np.full(per_cross, -spec.altitude)]
        )
        tracks.append(level_poses(centers, 90.0))
    rng = np.random.default_rng(spec.seed)
    sway = rng.normal(size=(spec.num_frames, 6))
    sway *= np.repeat([np.radians(spec.sway_deg), spec.heave], 3)
    return rigid3.perturb(np.concatenate(tracks), sway)


def simulate_survey(
    survey: str | SurveySpec, rig: Rig | None = None, **changes
) -> SimulatedScene:
    """The observations of a survey, and the truth.

    Args:
        survey: A name in `SURVEYS`, or a specification.
        rig: The true rig; by default that of Sedlazeck & Koch (2011).
        **changes: Fields of `SurveySpec`.

    Raises:
        InputError: no survey of that name.
    """
    if isinstance(survey, str):
        if survey not in SURVEYS:
            raise InputError(f"no survey {survey!r}; there are: {', '.join(SURVEYS)}")
        survey = SURVEYS[survey]
    spec = replace(survey, **changes)
    simulated = simulate_scene(
        rig or paper_rig(),
        survey_track(spec),
        Relief(stddev=spec.relief, seed=spec.seed),
        ObservationOptions(
            num_points=spec.num_points,
            noise_px=spec.noise_px,
            outlier_ratio=spec.outlier_ratio,
            detection_rate=spec.detection_rate,
            seed=spec.seed,
        ),
    )
    return _by_first_frame(simulated)


def _by_first_frame(simulated: SimulatedScene) -> SimulatedScene:
    """Points numbered as frames first see them, as a reconstruction numbers them."""
    truth = simulated.truth
    first = np.full(truth.num_points, truth.num_frames)
    np.minimum.at(first, truth.point_idx, truth.frame_idx)
    order = np.argsort(first, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    point_idx = number[truth.point_idx]
    rows = np.argsort(point_idx, kind="stable")
    scene, truth = (
        replace(
            part,
            points=part.points[order],
            camera_idx=part.camera_idx[rows],
            frame_idx=part.frame_idx[rows],
            point_idx=point_idx[rows],
            xy=part.xy[rows],
        )
        for part in (simulated.scene, truth)
    )
    return SimulatedScene(
        scene=scene, truth=truth, is_outlier=simulated.is_outlier[rows]
    )
