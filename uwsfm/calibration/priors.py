"""What the user knows beforehand, as rows of the border."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.assumed import assumed_accuracy
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import PARAMETERS
from uwsfm.calibration.problem import CalibrateOptions, exact_error
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.levenberg_marquardt import Priors, Term
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.state import State

_FX, _FY = border.FIRST_LENS, border.FIRST_LENS + 1


def border_priors(
    scene: Scene, settings: CalibrateOptions, columns: IndexArray, sigma_px: float
) -> Priors | None:
    """Priors around a scene's values, weighed against observations of this noise.

    Args:
        scene: its values are what is known.
        settings: how well.
        columns: (C, BORDER_SIZE); what is held needs no prior.
        sigma_px: noise of one image coordinate.

    Returns:
        None if nothing refined has a prior.
    """
    reference = State.from_scene(scene)
    stddevs = prior_stddevs(scene, settings, columns)
    weights = np.where(columns != HELD, (sigma_px / stddevs) ** 2, 0.0)
    terms = _correlated(reference, settings, columns, sigma_px)
    if not weights.any() and not terms:
        return None
    return Priors(reference=reference, weights=weights, terms=terms)


def prior_stddevs(
    scene: Scene, settings: CalibrateOptions, columns: IndexArray
) -> Array:
    """Standard deviations (C, BORDER_SIZE) of priors, in the units of the border's
    steps; infinite where nothing is known.

    Args:
        scene: its values are what is known.
        settings: how well.
        columns: (C, BORDER_SIZE) of what is refined.

    Raises:
        InputError: what is refined is exact, as the accuracy of the rig has it.
    """
    stddevs = np.full(columns.shape, np.inf)
    stddevs[:, border.LENGTH] = settings.baseline_stddev_m or np.inf
    lenses = np.array([camera.lens for camera in scene.cameras])
    for parameter in PARAMETERS:
        if parameter.prior is None or parameter.accuracy is None:
            continue
        has = np.array([parameter.of(port) for port in scene.ports])
        known = settings.prior(parameter)
        if known is not None:
            per = parameter.accuracy.per * np.ones((len(has), parameter.size))
            if parameter.accuracy.relative:
                first = parameter.first - border.FIRST_LENS
                per = lenses[:, first : first + parameter.size]
            rows = np.arange(parameter.first, parameter.first + parameter.size)
            stddevs[np.ix_(has, rows)] = known * per[has]
        elif parameter.has_prior_by_accuracy:
            refined = has & (columns[:, parameter.first] != HELD)
            if refined.any():
                _take_accuracy(scene, settings, parameter, refined, stddevs)
    _, waters = np.unique(columns[:, border.WATER_INDEX], return_index=True)
    one = np.zeros(len(columns), dtype=bool)
    one[waters] = True
    stddevs[~one, border.WATER_INDEX] = np.inf  # one water, known once
    shared = columns[:, _FX] == columns[:, _FY]
    stddevs[shared, _FY] = np.inf  # one focal length, known once
    return stddevs


def _take_accuracy(
    scene: Scene,
    settings: CalibrateOptions,
    parameter: Parameter,
    refined: NDArray[np.bool_],
    stddevs: Array,
) -> None:
    """Make the accuracy of a parameter the prior of the cameras that refine it."""
    accuracy = settings.given or assumed_accuracy(scene)
    own = accuracy.stddevs[:, parameter.first]
    for c in np.flatnonzero(refined):
        if not own[c] > 0.0:
            where = accuracy.names[c] if accuracy.names else f"camera {c}"
            raise InputError(exact_error(parameter, where))
        stddevs[c, parameter.slots] = own[c]


@dataclass(frozen=True, kw_only=True, eq=False)
class LensPrior:
    """The lenses as given, with the covariance of all their refined parameters."""

    reference: State
    slots: IndexArray
    """(K, 2) camera and slot."""
    information: Array
    """(K, K) noise in px, squared, times the inverse covariance."""

    def cost(self, state: State) -> float:
        miss = self._miss(state)
        return 0.5 * float(miss @ self.information @ miss)

    def add_to(self, eqs: NormalEquations, state: State, layout: Layout) -> None:
        columns = layout.border_col[tuple(self.slots.T)]
        eqs.border[np.ix_(columns, columns)] += self.information
        eqs.border_grad[columns] += self.information @ self._miss(state)

    def _miss(self, state: State) -> Array:
        camera, slot = self.slots.T
        lens = slot - border.FIRST_LENS
        return state.lenses[camera, lens] - self.reference.lenses[camera, lens]


def _correlated(
    reference: State, settings: CalibrateOptions, columns: IndexArray, sigma_px: float
) -> tuple[LensPrior, ...]:
    """The prior of all refined lens parameters, if the rig file asks for it."""
    accuracy = settings.given
    if accuracy is None or not accuracy.correlated_prior:
        return ()
    mask = (columns != HELD) & (accuracy.stddevs > 0.0)
    mask[:, : border.FIRST_LENS] = False
    mask[columns[:, _FX] == columns[:, _FY], _FY] = False
    slots = np.argwhere(mask)
    if not len(slots):
        return ()
    covariance = accuracy.block(slots)
    spread = np.sqrt(np.diag(covariance))
    scaled = np.linalg.inv(covariance / np.outer(spread, spread))
    information = sigma_px**2 * scaled / np.outer(spread, spread)
    return (LensPrior(reference=reference, slots=slots, information=information),)


def lens_priors(priors: Priors) -> list[LensPrior]:
    """Those with a covariance."""
    return [term for term in priors.terms if isinstance(term, LensPrior)]


def with_terms(
    own: Priors | None, terms: tuple[Term, ...], reference: State
) -> Priors | None:
    """Priors of the border, if any, and terms, if any."""
    if not terms:
        return own
    if own is None:
        nothing = np.zeros((len(reference.ports), border.BORDER_SIZE))
        return Priors(reference=reference, weights=nothing, terms=terms)
    return replace(own, terms=(*own.terms, *terms))
