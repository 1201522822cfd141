"""What errors of the given numbers would do to the estimates, without solving again.

The gradient g(x, p) vanishes at the optimum, so a given number p that is off by dp
moves the estimate x by dx = -H_xx^-1 H_xp dp: one linearisation answers for all.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from uwsfm._indices import distinct
from uwsfm.calibration.lengths import Lengths
from uwsfm.calibration.outside import Outside
from uwsfm.calibration.priors import border_priors, with_terms
from uwsfm.calibration.problem import CalibrateOptions, CalibrationResult
from uwsfm.calibration.uncertainty import likelihood
from uwsfm.geometry import unit_vector
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.port import DomePort, FlatPort, NoPort
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver import schur
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.levenberg_marquardt import suitable_blas
from uwsfm.solver.quasidefinite import symmetric
from uwsfm.solver.reduced_factor import coupling_columns, inverse
from uwsfm.solver.reduction import analyse

FOCAL, CX, CY = border.FIRST_LENS, border.FIRST_LENS + 2, border.FIRST_LENS + 3


@dataclass(frozen=True, kw_only=True)
class Shift:
    """How the estimates of one camera would move."""

    distance_m: float
    normal: tuple[float, float, float]
    """Change of the port normal; its length is the angle in radians."""
    center_m: tuple[float, float, float]
    """Change of a dome's centre."""

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.linalg.norm(self.normal)))


@dataclass(frozen=True, kw_only=True)
class BudgetRow:
    """One given number, wrong by so much in all cameras alike."""

    name: str
    shifts: tuple[Shift, ...]
    """One per camera."""


def error_budget(result: CalibrationResult) -> tuple[BudgetRow, ...]:
    """Shifts of all ports for a standard set of errors, by linear propagation.

    A number that is refined without a prior shifts nothing; with one, its prior is what
    is taken to be wrong. The last row is the root of the sum of squares of the others:
    lengths of shifts, whose signs are lost.

    Args:
        result: of a calibration; its options say what was held.

    Returns:
        One row per error; NaN if the observations do not determine the estimates.
    """
    scene, settings = result.scene.select(result.inliers)[0], result.options
    changes = _standard_changes(scene)
    at_zero = np.array(
        [isinstance(port, FlatPort) and port.distance == 0.0 for port in scene.ports]
    )
    columns = settings.border_columns(scene.cameras, at_zero)
    moved = _propagate(scene, settings, columns, np.stack(list(changes.values())))
    rows = [
        BudgetRow(name=name, shifts=_shifts(scene, step))
        for name, step in zip(changes, moved, strict=True)
    ]
    total = tuple(
        Shift(
            distance_m=float(np.sqrt(sum(r.shifts[c].distance_m ** 2 for r in rows))),
            normal=_root_sum([r.shifts[c].normal for r in rows]),
            center_m=_root_sum([r.shifts[c].center_m for r in rows]),
        )
        for c in range(len(scene.cameras))
    )
    return (*rows, BudgetRow(name="all of these together", shifts=total))


def _root_sum(vectors: list[tuple[float, float, float]]) -> tuple[float, float, float]:
    return _triple(np.sqrt(np.sum(np.square(vectors), axis=0)))


def _standard_changes(scene: Scene) -> dict[str, Array]:
    """Errors worth knowing about, as steps of the border (C, BORDER_SIZE)."""
    lenses = np.array([camera.lens for camera in scene.cameras])
    nothing = np.zeros((len(scene.cameras), border.BORDER_SIZE))

    def change(slots: Any, amount: Any) -> Array:
        step = nothing.copy()
        step[:, slots] = amount
        return step

    lengths = np.linalg.norm(scene.cam_from_rig[:, 4:], axis=1)
    domes = [isinstance(port, DomePort) for port in scene.ports]
    water = [not isinstance(port, NoPort) for port in scene.ports]
    changes = {
        "focal length +0.1 %": change([FOCAL, FOCAL + 1], 1e-3 * lenses[:, :2]),
        "principal point +1 px in x": change(CX, 1.0),
        "principal point +1 px in y": change(CY, 1.0),
        "water index +0.01": change(border.WATER_INDEX, 0.01 * np.array(water)),
        "glass index +0.01": change(border.GLASS_INDEX, 0.01 * np.array(water)),
        "glass thickness +2 mm": change(border.THICKNESS, 2e-3 * np.array(water)),
    }
    if any(domes):
        changes["dome radius +1 mm"] = change(border.RADIUS, 1e-3 * np.array(domes))
    if np.any(lengths > 0.0):
        changes["baseline +1 %"] = change(border.LENGTH, 0.01 * lengths)
    return changes


def _propagate(
    scene: Scene, settings: CalibrateOptions, columns: IndexArray, changes: Array
) -> Array:
    """Steps (E, C, BORDER_SIZE) of the border for changes (E, C, BORDER_SIZE)."""
    given = (columns == HELD) & np.any(changes != 0.0, axis=0)
    num_free = int(columns.max(initial=-1)) + 1
    extended = columns.copy()
    extended[given] = num_free + np.arange(np.count_nonzero(given))
    outside = Outside(scene, Lengths())  # of one camera, a length is taken for known
    layout = build_layout(scene, extended, num_lengths=outside.num_lengths)
    state = outside.placed(scene)
    sigma = _sigma(scene, layout.num_frame_cols + num_free)
    own = border_priors(scene, settings, columns, sigma)
    used, frames = distinct(scene.point_idx), distinct(scene.frame_idx)
    priors = with_terms(own, outside.terms(used, frames, sigma), state)
    reduction, offset = analyse(layout), layout.num_frame_cols
    with suitable_blas(reduction):
        eqs = likelihood(layout, state, priors)
        whole = schur.reduced_system(layout, reduction.graph, eqs, 0.0)
        border = symmetric(whole.border)
        # The order of the border is that of the columns: the given ones come last, but
        # for the lengths.
        kept = np.r_[:num_free, layout.num_camera_cols : layout.num_border_cols]
        moved = np.arange(num_free, layout.num_camera_cols)
        part = whole._replace(
            coupling=np.ascontiguousarray(whole.coupling[:, kept]),
            border=border[np.ix_(kept, kept)],
            right_border=whole.right_border[kept],
        )
        found = inverse(reduction, part, layout.num_lengths)
        if found is None:
            return np.full(changes.shape, np.nan)
        coupling = coupling_columns(whole)[:, moved]
        right = -np.concatenate([coupling, border[np.ix_(kept, moved)]])
        right = right @ changes[:, given].T  # (n, E)
        if priors is not None:
            known = (priors.weights > 0.0) & (columns != HELD)
            pulled = changes[:, known] * priors.weights[known]
            np.add.at(right, offset + columns[known], pulled.T)
        border_steps = found.times(right)[offset : offset + num_free].T
    padded = np.concatenate([border_steps, np.zeros((len(changes), 1))], axis=1)
    return padded[:, columns]  # HELD = -1 reads the zeros at the end


def _sigma(scene: Scene, num_unknowns: int) -> float:
    """Noise of one coordinate at an optimum, px."""
    squares = np.nansum(scene.residuals() ** 2)
    count = 2 * scene.num_observations - num_unknowns - 3 * scene.num_points
    return max(float(np.sqrt(squares / max(count, 1))), 1e-9)


def _shifts(scene: Scene, step: Array) -> tuple[Shift, ...]:
    shifts = []
    for port, row in zip(scene.ports, step, strict=True):
        turn, center, distance = np.zeros(3), np.zeros(3), 0.0
        if isinstance(port, FlatPort):
            turn = unit_vector.tangent_basis(port.normal) @ row[border.NORMAL]
            distance = float(row[border.DISTANCE])
        elif isinstance(port, DomePort):
            center = row[border.CENTER]
        shifts.append(
            Shift(distance_m=distance, normal=_triple(turn), center_m=_triple(center))
        )
    return tuple(shifts)


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
