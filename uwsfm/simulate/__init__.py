"""Synthetic dives with known truth: observations, and rendered images."""

from uwsfm.simulate.observation_file import read_observations, write_observations
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
    "read_observations",
    "simulate_scene",
    "simulate_survey",
    "write_observations",
]
