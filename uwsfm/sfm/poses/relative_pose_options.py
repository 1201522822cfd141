"""How a relative pose is searched and adjusted."""

from __future__ import annotations

from dataclasses import dataclass

from uwsfm.errors import InputError


@dataclass(frozen=True, kw_only=True)
class RelativePoseOptions:
    """How a relative pose is searched and adjusted."""

    max_error_px: float = 6.0
    """Gap of the water rays above which a match is an outlier. The final adjustment
    cuts at `cut_stddevs` of the noise that it finds, so this may be generous."""
    max_central_error_px: float = 12.0
    """The same for the central cameras that hypotheses come from, for which a scene is
    far away."""
    confidence: float = 0.9999
    min_trials: int = 200
    max_trials: int = 20000
    min_num_inliers: int = 12
    """Five always fit."""
    cut_stddevs: float = 3.5
    """Matches with larger gaps do not pull at the pose; 0.05 % of normal ones."""
    length_m: float | None = None
    """Length of the motion, if known from elsewhere."""
    length_stddev: float = 0.0
    """Of the logarithm of ``length_m``, that is relative; 0 holds the length."""
    scene_distance_m: float = 2.0
    """What the median distance of the scene from the first view is taken for, where
    neither ``length_m`` nor refraction nor the rig says more."""
    scene_distance_factor: float = 3.0
    """How well that is known: a factor of so much is one standard deviation."""
    max_iterations: int = 50
    seed: int = 0

    def __post_init__(self) -> None:
        positive = (self.max_error_px, self.max_central_error_px, self.cut_stddevs)
        if not min(positive) > 0.0 or not self.scene_distance_m > 0.0:
            raise InputError(
                "errors, cut_stddevs and scene_distance_m must be positive"
            )
        if not self.scene_distance_factor > 1.0:
            raise InputError("scene_distance_factor must be above 1")
        if not 0.0 < self.confidence < 1.0:
            raise InputError(f"confidence must be in (0, 1), got {self.confidence}")
        if self.min_num_inliers < 6 or not 0 < self.min_trials <= self.max_trials:
            raise InputError("a relative pose takes 6 inliers, and one trial, at least")
        if self.length_m is not None and not self.length_m > 0.0:
            raise InputError(f"length_m must be positive, got {self.length_m}")
        if not self.length_stddev >= 0.0:
            raise InputError("length_stddev must not be negative")
