"""What the user knows beforehand, as rows of the border."""

from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import FOCAL
from uwsfm.models.ports.port import rows_with
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.levenberg_marquardt import Priors, Term
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.state import State

_FX, _FY, _CX, _CY = range(border.FIRST_LENS, border.FIRST_LENS + 4)
_DISTORTION = slice(_CY + 1, border.BORDER_SIZE)


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
    stddevs = np.full(columns.shape, np.inf)
    stddevs[:, border.LENGTH] = settings.baseline_stddev_m or np.inf
    plane, dome = (rows_with(reference.ports, n) for n in ("normal", "center"))
    stddevs[plane, border.DISTANCE] = settings.distance_stddev_m or np.inf
    # The prior is on the angle's two components; its RMS angle is sqrt(2) of one.
    tilt = np.radians(settings.normal_stddev_deg or np.inf) / np.sqrt(2.0)
    stddevs[plane, border.NORMAL] = tilt
    stddevs[dome, border.CENTER] = settings.center_stddev_m or np.inf
    _, waters = np.unique(columns[:, border.WATER_INDEX], return_index=True)
    stddevs[waters, border.WATER_INDEX] = settings.water_index_stddev or np.inf
    relative = settings.focal_stddev or np.inf
    stddevs[:, [_FX, _FY]] = relative * reference.lenses[:, FOCAL]
    stddevs[:, [_CX, _CY]] = settings.principal_point_stddev_px or np.inf
    stddevs[:, _DISTORTION] = settings.distortion_stddev or np.inf
    shared = columns[:, _FX] == columns[:, _FY]
    stddevs[shared, _FY] = np.inf  # one focal length, known once
    weights = np.where(columns != HELD, (sigma_px / stddevs) ** 2, 0.0)
    terms = _correlated(reference, settings, columns, sigma_px)
    if not weights.any() and not terms:
        return None
    return Priors(reference=reference, weights=weights, terms=terms)


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
