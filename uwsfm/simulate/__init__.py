"""Synthetic dives with known truth: observations, and rendered images."""

from uwsfm.simulate.observations import (
    ObservationOptions,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.perturbations import Perturbation, perturbed
from uwsfm.simulate.relief import Relief

__all__ = [
    "ObservationOptions",
    "Perturbation",
    "Relief",
    "SimulatedScene",
    "perturbed",
    "simulate_scene",
]
