"""Synthetic dives with known truth: observations, and rendered images."""

from uwsfm.simulate.observations import (
    ObservationOptions,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.perturbations import Perturbation, perturbed
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.surveys import SurveySpec, simulate_survey

__all__ = [
    "ObservationOptions",
    "Perturbation",
    "Relief",
    "SimulatedScene",
    "SurveySpec",
    "perturbed",
    "simulate_scene",
    "simulate_survey",
]
