"""The parts that a covariance is made of, each against a number that is known without
the code: turned by hand, counted, or by the dense inverse."""

from types import SimpleNamespace

import numpy as np
import pytest
from dense import dense_system, skew, small_scene
from test_outside import ARM, NAV_STDDEV, dive, tracked

from uwsfm import CalibrateOptions, Lengths, Positions, calibrate
from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.propagation import Propagation
from uwsfm.calibration.relinearized import reopened
from uwsfm.calibration.uncertainty import likelihood, prior_covariance
from uwsfm.geometry import rigid3
from uwsfm.measuring.measure import _Known
from uwsfm.residuals import border
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.covariance import reduced_covariance
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.levenberg_marquardt import Priors
from uwsfm.solver.state import State

STDDEVS = np.array([0.02, 0.03, 0.05])
"""Of positions, along the axes of their own frame."""


def among_positions(scene, places, covariances):
    known = Positions.from_arrays(np.arange(len(places)), places, covariances, ARM)
    return calibrate(scene, loss="l2", lengths=Lengths(positions=known))


def test_everything_turns_with_the_frame_of_the_positions(rng):
    """The same positions in a turned frame: places, misses and covariances turn too."""
    simulated = dive(paper_rig(), rich_motion(8), num_points=120)
    places, _ = tracked(simulated.truth, rng)
    covariance = np.diag(STDDEVS**2)
    turn = rigid3.rotmat_from_quat(rigid3.quat_from_rotvec([0.4, -1.1, 0.7]))
    first = among_positions(simulated.scene, places, np.tile(covariance, (8, 1, 1)))
    second = among_positions(
        simulated.scene,
        places @ turn.T + [3.0, -2.0, 1.0],
        np.tile(turn @ covariance @ turn.T, (8, 1, 1)),
    )

    def assert_turned(found, expected, part):
        # Two solves from other starts: a thousandth of a standard deviation.
        np.testing.assert_allclose(
            found, expected, atol=1e-3 * np.abs(expected).max(), err_msg=part
        )

    points = first.covariance.points
    assert_turned(second.covariance.points, turn @ points @ turn.T, "points")
    # The place is that of the middle, axis by axis, which is another point now.
    turned = places @ turn.T
    between = np.median(turned, axis=0) - turn @ np.median(places, axis=0)
    both = np.kron(np.eye(2), turn)
    both[3:] -= skew(between) @ np.eye(6)[:3] @ both
    pose = first.positions.covariance
    assert_turned(second.positions.covariance, both @ pose @ both.T, "place")
    misses = first.positions.misses_m
    assert_turned(second.positions.misses_m, misses @ turn.T, "misses")
    moved = first.scene.points @ turn.T + [3.0, -2.0, 1.0]
    assert_turned(second.scene.points, moved, "scene")
    assert second.covariance.scale_stddev == pytest.approx(
        first.covariance.scale_stddev, rel=1e-3
    )


def test_positions_that_scatter_weigh_as_if_their_scatter_had_been_given(rng):
    """Three times as noisy as they say: found, and all that follows is that of
    positions whose deviations were right."""
    simulated = dive(paper_rig(), rich_motion(12), num_points=120)
    places, _ = tracked(simulated.truth, rng, stddev=3.0 * NAV_STDDEV)
    given = np.tile(NAV_STDDEV**2 * np.eye(3), (12, 1, 1))
    result = among_positions(simulated.scene, places, given)
    scatter = result.positions.scatter
    # 36 numbers less six: a deviation of them is known to 13 %.
    assert scatter == pytest.approx(3.0, rel=0.4)
    honest = among_positions(simulated.scene, places, scatter**2 * given)
    assert honest.positions.scatter == 1.0
    np.testing.assert_allclose(
        result.entered.positions.covariances, scatter**2 * given, rtol=1e-12
    )
    # A new scatter of less than 2 % more ends the rounds: 4 % of a variance.
    for name in ("points", "border"):
        found, expected = (getattr(one.covariance, name) for one in (result, honest))
        assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max(), name
    expected = honest.positions.covariance
    gap = np.abs(result.positions.covariance - expected)
    assert gap.max() < 0.05 * np.abs(expected).max()
    # What is measured in the result later knows of it, too: opened again, as stored.
    again, other = (Propagation(one) for one in (result, honest))
    ends = np.array([3, 40])
    slope = np.zeros((1, 2, 3))
    slope[0, :, 2] = 1.0, 0.5  # a height among the positions, not a distance
    variance, expected = (
        one.covariance(one.of_points(ends), slope).item() for one in (again, other)
    )
    assert variance == pytest.approx(expected, rel=0.05)


def test_degrees_of_freedom_are_counted():
    """By hand: two per observation, less six per frame but one, the rig and ports, and
    three per point."""
    scene = small_scene(5, 40, noise_px=0.3).scene
    result = calibrate(scene, loss="l2", refine_water_index=True)
    # The second camera: rotation 3, direction 2; normals 2 x 2, distances 2, the index.
    num_unknowns = 6 * 4 + 5 + 4 + 2 + 1 + 3 * scene.num_points
    freedom = 2 * scene.num_observations - num_unknowns
    squares = np.sum(result.scene.residuals() ** 2)
    assert result.summary.sigma_px**2 == pytest.approx(squares / freedom, rel=1e-9)
    assert reopened(result).degrees_of_freedom == freedom


def test_what_priors_err_by_is_the_rest_of_the_dense_inverse():
    """With J the images and K the priors, H = J^T J + K: if the images' errors make
    H^-1 J^T J H^-1, the priors' make H^-1 K H^-1, and both are H^-1."""
    scene = small_scene(4, 25).truth
    options = CalibrateOptions(
        baseline_stddev_m=0.002,
        distance_stddev_m=0.003,
        normal_stddev_deg=0.5,
        refine_water_index=True,
        water_index_stddev=0.001,
    )
    columns = options.border_columns(scene.cameras, np.zeros(2, dtype=bool))
    layout = build_layout(scene, columns)
    state = State.from_scene(scene)
    priors: Priors = border_priors(scene, options, columns, 0.4)
    eqs = likelihood(layout, state, priors)
    reduced = reduced_covariance(layout, eqs)
    found = prior_covariance(
        layout, state, priors, reduced.coupling, reduced.whole_border
    )

    jac, _ = dense_system(scene, layout)
    weights = np.zeros(jac.shape[1])
    offset = layout.num_frame_cols
    # Noise over deviation, squared; a tilt's is shared by its two components.
    per_slot = {
        border.LENGTH: (0.4 / 0.002) ** 2,
        border.DISTANCE: (0.4 / 0.003) ** 2,
        6: 2.0 * (0.4 / np.radians(0.5)) ** 2,
        7: 2.0 * (0.4 / np.radians(0.5)) ** 2,
        border.WATER_INDEX: (0.4 / 0.001) ** 2,
    }
    for row in columns:
        for slot, weight in per_slot.items():
            if row[slot] != HELD:
                weights[offset + row[slot]] = weight
    whole = jac.T @ jac + np.diag(weights)
    scale = 1.0 / np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole * np.outer(scale, scale)) * np.outer(scale, scale)
    inside = slice(offset, offset + layout.num_border_cols)
    expected = (inverse * weights) @ inverse
    spread = np.sqrt(np.diag(inverse)[inside])
    # In standard deviations, of a matrix of condition 1e7.
    gap = np.abs(found - expected[inside, inside]) / np.outer(spread, spread)
    assert gap.max() < 1e-6
    assert (np.diag(found) / spread**2).max() > 0.5  # one is known by its prior


def test_a_baseline_known_to_two_per_cent_is_in_every_length():
    """Nothing else gives the scale: the deviation of a length is two per cent of it,
    whether or not neighbours may err together."""
    scene = small_scene(6, 80, noise_px=0.05).scene
    result = calibrate(scene, loss="l2", baseline_stddev_m=0.02 * 0.2)
    propagation = Propagation(result)
    ends = np.array([5, 17])
    places = propagation.of_points(ends)
    along = places.points[0] - places.points[1]
    length = np.linalg.norm(along)
    slope = np.stack([along, -along])[None] / length
    for variance in (
        propagation.covariance(places, slope),
        propagation.clustered_covariance(places, slope),
    ):
        # Noise of 0.05 px at 2 m is a tenth of a millimetre, next to millimetres; the
        # thickness of the glass, which is known, tells the scale to some ten per cent.
        assert np.sqrt(variance.item()) == pytest.approx(0.02 * length, rel=0.1)


def by_hand(values, lengths, own, in_all, shared):
    """Weighted factor and deviation, in sums written out."""
    weights = [v / (s**2 + o**2) for v, s, o in zip(values, in_all, own, strict=True)]
    total = sum(w * v for w, v in zip(weights, values, strict=True))
    weights = [w / total for w in weights]
    factor = sum(w * x for w, x in zip(weights, lengths, strict=True))
    variance = sum(
        weights[i] * weights[j] * shared[i][j]
        for i in range(len(values))
        for j in range(len(values))
    )
    variance += sum((w * o) ** 2 for w, o in zip(weights, own, strict=True))
    return factor, variance**0.5


@pytest.mark.parametrize("correlation", [0.9, 0.0, -0.9])
def test_bars_that_err_together_are_no_independent_checks(dive_result, correlation):
    """Two bars and, between them, a distance that is none."""
    values, lengths = [0.5, 0.8], [0.505, 0.79]
    own, stddevs = [0.001, 0.0015], [0.002, 0.003]
    cross = correlation * stddevs[0] * stddevs[1]
    alone = np.diag([stddevs[0] ** 2, 7.0, stddevs[1] ** 2])
    alone[0, 2] = alone[2, 0] = cross
    given = np.diag([1e-6, 5.0, 4e-6])
    given[0, 2] = given[2, 0] = 2e-6
    in_all = [(s**2 + g) ** 0.5 for s, g in zip(stddevs, (1e-6, 4e-6), strict=True)]

    def item(kind, value=None, stddev=None, length=None, own=None):
        task = SimpleNamespace(kind=kind, length_m=length, stddev_m=own)
        return SimpleNamespace(task=task, value=value, stddev_in_all=stddev)

    bars = [
        item("scale bar", *row)
        for row in zip(values, in_all, lengths, own, strict=True)
    ]
    items = [bars[0], item("distance", 3.0, 2.6), bars[1]]
    known = _Known(
        result=SimpleNamespace(calibration=dive_result.result.calibration),
        propagation=None,
        places=None,
        spots=(),
        both=(alone, 0.5 * alone),
        given=given,
    )
    found = known.scale_bars(items)
    block = np.ix_([0, 2], [0, 2])
    shared = (alone + given)[block]
    factor, stddev = by_hand(values, lengths, own, in_all, shared)
    assert found["num_bars"] == 2
    assert found["known_over_measured"] == pytest.approx(factor, rel=1e-12)
    assert found["stddev"] == pytest.approx(stddev, rel=1e-12)
    assert found["ratio"] == pytest.approx((factor - 1.0) / stddev, rel=1e-9)
