"""The error budget: what one standard deviation of each given number would do.

By linear propagation, see `uwsfm.calibration.given_errors`. The last row is the exact
propagation of their joint covariance, correlations included: no root sum of squares.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from uwsfm.calibration.given_errors import (
    GivenReach,
    given_reach,
    with_given_errors,
)
from uwsfm.calibration.given_items import GivenItem, given_items
from uwsfm.calibration.result import CalibrationResult
from uwsfm.geometry import unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import NUM_PARAMS
from uwsfm.models.ports.port import PlanePort, Port
from uwsfm.residuals import border
from uwsfm.solver.layout import HELD

TOGETHER = "all of these together"


@dataclass(frozen=True, kw_only=True)
class Shift:
    """How the estimates of one camera would move; standard deviations in the last row.
    What is given and held does not count as moving."""

    distance_m: float
    normal: tuple[float, float, float]
    """Change of the port normal; its length is the angle in radians."""
    center_m: tuple[float, float, float]
    """Change of a dome's centre."""
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Turn of cam_from_rig about the axes of the camera, radians."""
    lens: tuple[float, ...] = (0.0,) * NUM_PARAMS
    """Change of refined lens parameters, in the order of `uwsfm.models.lens`."""

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.linalg.norm(self.normal)))

    @property
    def rotation_deg(self) -> float:
        return float(np.degrees(np.linalg.norm(self.rotation)))


@dataclass(frozen=True, kw_only=True)
class BudgetRow:
    """One given number, or one number of all cameras alike, wrong by one deviation."""

    name: str
    amount: str
    """Its standard deviation, with the unit; empty in the last row."""
    assumed: bool
    """The deviation is a default: nobody gave it."""
    prior: bool
    """The number is refined, and this is the deviation of its prior."""
    shifts: tuple[Shift, ...]
    """One per camera."""
    scale: float
    """Relative change of all lengths."""
    share: float
    """Largest shift of a port or of the scale, which tables show, in standard
    deviations in all: what rows are sorted by. Where none of them is estimated: of
    anything."""


def error_budget(
    calibration: CalibrationResult, reach: GivenReach | None = None
) -> tuple[BudgetRow, ...]:
    """What errors of everything that was given would do, the largest first.

    A number that is refined without a prior shifts nothing and has no row.

    Args:
        calibration: its options say what was held, and how well that is known.
        reach: of the same, if there is one already.

    Returns:
        One row per number, and one for all cameras alike; the last row is all of them
        together, with their correlations. NaN if the observations do not determine the
        estimates.
    """
    reach = given_reach(calibration) if reach is None else reach
    sheet = _Sheet(calibration, reach)
    rows = sorted(sheet.rows(), key=lambda row: -np.nan_to_num(row.share, nan=np.inf))
    return (*rows, sheet.together())


def with_budget(
    calibration: CalibrationResult,
) -> tuple[CalibrationResult, tuple[BudgetRow, ...]]:
    """The calibration with its deviations "in all", and its error budget: what a
    pipeline does once, at its end."""
    reach = given_reach(calibration)
    calibration = with_given_errors(calibration, reach)
    return calibration, error_budget(calibration, reach)


ALIKE = ", all cameras alike"
"""The end of a row's name."""


class _Sheet:
    """Steps of the estimates, and what one standard deviation of each is in all."""

    def __init__(self, calibration: CalibrationResult, reach: GivenReach) -> None:
        self.ports = calibration.scene.ports
        self.reach = reach
        covariance = calibration.covariance
        self.refined = covariance.border_cols != HELD
        of_ports = np.zeros_like(self.refined)
        of_ports[:, border.NORMAL.start : border.CENTER.stop] = True
        shown = self.refined & of_ports
        self.shown = shown if shown.any() else self.refined
        self.steps = np.where(self.refined[..., None], reach.border_steps, 0.0)
        columns = covariance.border_cols
        own = np.append(np.diag(covariance.border), 0.0)[columns]
        flat = self.steps.reshape(columns.size, -1)
        more = np.diag(reach.added(flat)).reshape(columns.shape)
        self.stddevs = np.sqrt(np.maximum(own + more, 0.0))
        scale = covariance.scale_stddev
        self.has_scale = scale is not None
        added = reach.added(reach.scale_step[None])[0, 0]
        self.scale_stddev = np.sqrt((scale or 0.0) ** 2 + added)

    def rows(self) -> Iterator[BudgetRow]:
        items = list(given_items(self.reach, self.ports))
        together: dict[str, list[GivenItem]] = {}
        for item in items:
            together.setdefault(item.what, []).append(item)
        for what, members in together.items():
            shared = len(members) > 1 and self._are_one(members)
            if not shared:
                yield from (self._row(f"{what} of {m.camera}", [m]) for m in members)
            if len(members) > 1:
                alike = what if shared else what + ALIKE
                yield self._row(alike, members)

    def _are_one(self, members: list[GivenItem]) -> bool:
        """Whether cameras share a number, as the index of one water."""
        changes = np.array([item.changes for item in members])
        at = [int(np.argmax(np.abs(row))) for row in changes]
        block = self.reach.covariance[np.ix_(at, at)]
        spread = np.sqrt(np.diag(block))
        return bool(np.all(block > 0.999 * np.outer(spread, spread)))

    def _row(self, name: str, items: list[GivenItem]) -> BudgetRow:
        changes = np.sum([item.changes for item in items], axis=0)
        first = items[0]
        step = self.steps @ changes
        scale = float(self.reach.scale_step @ changes)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.abs(step)[self.shown] / self.stddevs[self.shown]
        share = float(np.max(shares, initial=0.0))
        if self.has_scale and self.scale_stddev > 0.0:
            share = max(share, abs(scale) / float(self.scale_stddev))
        pairs = zip(self.ports, step, strict=True)
        return BudgetRow(
            name=name,
            amount=", ".join(dict.fromkeys(item.amount for item in items)),
            assumed=first.assumed and not first.prior,
            prior=first.prior,
            shifts=tuple(_shift(port, row) for port, row in pairs),
            scale=scale,
            share=share,
        )

    def together(self) -> BudgetRow:
        """Standard deviations by the joint covariance of everything that was given."""
        shifts = []
        for port, steps in zip(self.ports, self.steps, strict=True):
            covariance = self.reach.added(steps, priors=True)
            spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            shift = _shift(port, spread)
            if isinstance(port, PlanePort):
                basis = unit_vector.tangent_basis(port.normal)
                turn = covariance[border.NORMAL, border.NORMAL]
                turned = np.sqrt(np.diag(basis @ turn @ basis.T))
                shift = replace(shift, normal=_triple(turned))
            shifts.append(shift)
        variance = self.reach.added(self.reach.scale_step[None], priors=True)
        return BudgetRow(
            name=TOGETHER,
            amount="",
            assumed=False,
            prior=False,
            shifts=tuple(shifts),
            scale=float(np.sqrt(max(variance[0, 0], 0.0))),
            share=np.inf,
        )


def _shift(port: Port, row: Array) -> Shift:
    normal, center, distance = np.zeros(3), np.zeros(3), 0.0
    if isinstance(port, PlanePort):
        normal = unit_vector.tangent_basis(port.normal) @ row[border.NORMAL]
        distance = float(row[border.DISTANCE])
    if port.has("center"):
        center = row[border.CENTER]
    return Shift(
        distance_m=distance,
        normal=_triple(normal),
        center_m=_triple(center),
        rotation=_triple(row[border.ROTATION]),
        lens=tuple(row[border.LENS].tolist()),
    )


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
