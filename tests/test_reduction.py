"""Dense, banded and sparse reduced systems: one answer, whatever way leads to it."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from uwsfm import CalibrateOptions
from uwsfm.calibration.uncertainty import likelihood
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import NoPort
from uwsfm.simulate import Perturbation, SurveySpec, perturbed, simulate_survey
from uwsfm.solver import threads
from uwsfm.solver.covariance import point_covariances, reduced_covariance
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.levenberg_marquardt import (
    LevenbergMarquardtOptions,
    Priors,
    minimize,
)
from uwsfm.solver.linear import block_cholesky, nested_dissection, reduced_steps, schur
from uwsfm.solver.linear import elimination_tree as trees
from uwsfm.solver.linear import reduced_factor as factors
from uwsfm.solver.linear import reduction as reductions
from uwsfm.solver.linear.block_graph import build_graph
from uwsfm.solver.linear.quasidefinite import symmetric
from uwsfm.solver.linear.reduced_steps import TOLERANCE, StepSolver
from uwsfm.solver.linear.reduction import BANDED, DENSE, SPARSE, analyse
from uwsfm.solver.state import State
from uwsfm.solver.terms import LengthTerm, PositionTerm, centers

SPEC = SurveySpec(num_frames=48, num_points=900, detection_rate=0.5)
KINDS = (DENSE, BANDED, SPARSE)


@pytest.fixture(scope="module")
def survey():
    return simulate_survey(SPEC)


def layout_of(scene, held=(0,), **known):
    columns = CalibrateOptions().border_columns(scene.cameras, np.zeros(2, dtype=bool))
    held_frames = np.zeros(scene.num_frames, dtype=bool)
    held_frames[list(held)] = True
    return build_layout(scene, columns, held_frames, **known)


def known_outside(scene):
    """Two lengths between points, one between frames; positions of some frames."""
    state = State.from_scene(scene)
    where = centers(scene.rig_from_world)

    def lengths(ends, places, first, of_frames):
        ends = np.array(ends)
        between = np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1)
        return LengthTerm(
            ends=ends,
            lengths=1.01 * between,
            variances=np.full(len(ends), 1e-4),
            of_frames=of_frames,
            first=first,
        )

    seen = np.arange(0, scene.num_frames, 5)
    positions = PositionTerm(
        frames=seen,
        positions=where[seen] + 0.01,
        roots=np.tile(10.0 * np.eye(3), (len(seen), 1, 1)),
        lever_arm=np.array([0.1, 0.0, 0.2]),
        sigma_px=0.5,
        loss_scale=None,
        start=state.nav_from_world,
    )
    terms = (
        lengths([(0, 1), (5, 800)], scene.points, 0, False),
        lengths([(3, 40)], where, 2, True),
        positions,
    )
    weights = np.zeros(layout_of(scene).border_col.shape)
    return Priors(reference=state, weights=weights, terms=terms)


def problems(scene):
    """Layouts and priors: plain, with frames held, with everything from outside."""
    yield layout_of(scene), None
    yield layout_of(scene, held=(0, 11, 30)), None
    outside = layout_of(scene, navigation=True, num_lengths=3)
    yield outside, known_outside(scene)


def test_every_way_leads_to_the_same_step(survey, monkeypatch):
    monkeypatch.setattr(nested_dissection, "SMALL", 8)
    scene = perturbed(survey.scene, Perturbation(rotation_stddev_deg=0.1))
    state = State.from_scene(scene)
    for layout, priors in problems(scene):
        eqs = likelihood(layout, state, priors)
        # Relative to the step. The condition is what limits both sides: 1e8 at first.
        for damping, tolerance in ((1e-6, 1e-8), (1e-2, 1e-10)):
            steps = []
            for kind, long in [(kind, 1000) for kind in KINDS] + [(SPARSE, 0)]:
                monkeypatch.setattr(reductions, "LONG", long)
                reduction = analyse(layout, kind)
                system = schur.reduced_system(layout, reduction.graph, eqs, damping)
                matrix = factors.dense_matrix(reduction, system)
                solver = StepSolver(reduction, layout.num_lengths)
                steps.append(solver.step(system))
            scale = np.sqrt(np.abs(np.diag(matrix)))  # each unknown's own unit
            for step in steps[1:]:
                error = np.linalg.norm(scale * (step - steps[0]))
                assert error < tolerance * np.linalg.norm(scale * steps[0])


def error_of(step, reduction, system):
    """Relative, in the norm of the quadratic model."""
    matrix = symmetric(factors.dense_matrix(reduction, system))
    exact = np.linalg.solve(matrix, factors.right_side(system))
    miss = step - exact
    return np.sqrt((miss @ matrix @ miss) / (exact @ matrix @ exact))


@pytest.fixture
def worth_it(monkeypatch):
    """Rough and old factors for surveys that are too small for them."""
    monkeypatch.setattr(reduced_steps, "_most_solutions", lambda *_: 4)


def counted(monkeypatch, factor):
    """Calls of its factorize."""
    calls, factorize = [], factor.factorize
    monkeypatch.setattr(factor, "factorize", lambda b: calls.append(1) or factorize(b))
    return calls


def test_a_rough_factor_serves_the_systems_that_are_near(survey, monkeypatch, worth_it):
    truth = survey.truth
    layout = layout_of(truth)
    turns = np.random.default_rng(0).normal(scale=1e-4, size=(truth.num_frames, 6))
    near = replace(truth, rig_from_world=rigid3.perturb(truth.rig_from_world, turns))
    far = perturbed(truth, Perturbation(rotation_stddev_deg=3.0))
    reduction = analyse(layout, SPARSE)
    rough = counted(monkeypatch, reduction.rough_factor)
    solver, made = StepSolver(reduction, 0), []
    for scene, damping in ((truth, 1e-4), (near, 3e-5), (far, 1e-7), (far, 2e-7)):
        eqs = likelihood(layout, State.from_scene(scene), None)
        system = schur.reduced_system(layout, reduction.graph, eqs, damping)
        step = solver.step(system)
        made.append(len(rough))
        # The estimate is in the norm of the factor, which may differ by some tens of %.
        assert error_of(step, reduction, system) < 2.0 * TOLERANCE
    assert made == [1, 1, 2, 2]
    assert "factor" not in vars(reduction)  # the exact one, whose memory it saves
    system.blocks[:] *= -1.0
    assert solver.step(system) is None


def test_where_seven_digits_do_not_do_more_are_taken(survey, monkeypatch, worth_it):
    """No frame is held: what the damping alone holds is lost to rounding in seven."""
    layout = layout_of(survey.truth, held=())
    reduction = analyse(layout, SPARSE)
    rough = counted(monkeypatch, reduction.rough_factor)
    exact = counted(monkeypatch, reduction.factor)
    start = perturbed(survey.truth, Perturbation(rotation_stddev_deg=0.1))
    eqs = likelihood(layout, State.from_scene(start), None)
    solver = StepSolver(reduction, 0)
    for damping in (1e-11, 1e-11, 1e-10, 1e-3):
        system = schur.reduced_system(layout, reduction.graph, eqs, damping)
        step = solver.step(system)
        assert error_of(step, reduction, system) < 2.0 * TOLERANCE
    assert len(rough) == 1  # not again
    assert len(exact) == 2  # one for the first, another when the damping is far from it


def test_threads_share_a_factor_without_changing_a_digit(survey, monkeypatch):
    monkeypatch.setattr(nested_dissection, "SMALL", 8)
    monkeypatch.setattr(reductions, "LONG", 0)
    for name, value in (
        ("FRONT_FLOPS", 0.0),
        ("MOVE_FLOPS", 0.0),
        ("BRANCH_SHARE", 0.3),
    ):
        monkeypatch.setattr(trees, name, value)  # many fronts, of few frames each
    monkeypatch.setattr(block_cholesky, "STRIP", 12)
    layout = layout_of(survey.truth)
    eqs = likelihood(layout, State.from_scene(survey.truth), None)
    reduction = analyse(layout, SPARSE)
    tree = reduction.tree
    assert len(tree.branches) > 2
    assert len(tree.trunk) > 1
    done = [*(front for branch in tree.branches for front in branch), *tree.trunk]
    assert sorted(done) == list(range(len(tree.fronts)))
    for front in done:  # each after its children
        assert {*tree.fronts[front].children} <= {*done[: done.index(front)]}
    system = schur.reduced_system(layout, reduction.graph, eqs, 1e-6)
    right = np.random.default_rng(0).normal(size=(6 * len(tree.order), 1))
    found = []
    for count in (1, 2):
        monkeypatch.setattr(threads, "_available", lambda count=count: count)
        assert reduction.factor.factorize(system.blocks)
        found.append(reduction.factor.solve_half(right))
    assert np.array_equal(*found)


def test_lengths_get_factors_of_their_own(survey):
    """They make the system indefinite."""
    layout = layout_of(survey.truth, navigation=True, num_lengths=3)
    reduction = analyse(layout, SPARSE)
    assert reduced_steps._most_solutions(reduction, 3) == 0
    costly = replace(reduction, tree=replace(reduction.tree, cost=1e12))
    assert reduced_steps._most_solutions(costly, 3) == 0
    assert reduced_steps._most_solutions(costly, 0) > 0


def test_what_memory_held_before_does_not_matter(survey, monkeypatch):
    take = block_cholesky._Pool.take

    def poisoned(pool, size):
        square = take(pool, size)
        square[:] = np.nan
        return square

    monkeypatch.setattr(block_cholesky._Pool, "take", poisoned)
    layout, priors = next(iter(problems(survey.truth)))
    eqs = likelihood(layout, State.from_scene(survey.truth), priors)
    found = [reduced_covariance(layout, eqs, analyse(layout, k)) for k in KINDS]
    assert all(one.determined for one in found)
    for one in found:  # a fraction of the largest; they are sums of the same numbers
        error = np.abs(one.blocks - found[0].blocks).max()
        assert error < 1e-6 * np.abs(found[0].blocks).max()


def test_every_way_leads_to_the_same_covariance(survey):
    state = State.from_scene(survey.truth)
    for layout, priors in problems(survey.truth):
        eqs = likelihood(layout, state, priors)
        found = [reduced_covariance(layout, eqs, analyse(layout, k)) for k in KINDS]
        # Far apart: no point is seen from both.
        slope = np.zeros(layout.num_frame_cols + layout.num_border_cols)
        slope[[3, 10, -7]] = 1.0, -1.0, 0.5
        points = [point_covariances(layout, eqs, one) for one in found]
        dense = found[0]
        assert all(one.determined for one in found)
        variance = dense.variance_of(slope)
        for one, own in zip(found[1:], points[1:], strict=True):
            assert one.variance_of(slope) == pytest.approx(variance, rel=1e-6)
            for name in ("blocks", "coupling", "whole_border", "navigation", "frames"):
                expected = getattr(dense, name)
                error = np.abs(getattr(one, name) - expected)
                # The condition of the scaled matrix is 1e9, 1e-16 of it.
                assert error.max(initial=0.0) < 1e-6 * np.abs(expected).max(
                    initial=1e-9
                )
            relative = np.abs(own - points[0]).max(axis=(1, 2))
            relative /= np.trace(points[0], axis1=1, axis2=2)
            assert np.nanmax(relative) < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_data_leave_open_is_found_by_every_way(survey, kind):
    """No frame held: the place of the world is open."""
    state = State.from_scene(survey.truth)
    for held, determined in (((), False), ((0,), True)):
        layout = layout_of(survey.truth, held)
        reduction = analyse(layout, kind)
        reduced = reduced_covariance(layout, likelihood(layout, state, None), reduction)
        assert reduced.determined is determined
        assert np.isnan(reduced.border).all() != determined


@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_that_only_a_length_tells_is_found_by_every_way(survey, kind):
    """One camera in air: its frames alone are singular, the length joins them later."""
    scene, _ = survey.truth.select(survey.truth.camera_idx == 0)
    counts = np.bincount(scene.point_idx, minlength=scene.num_points)
    scene, _ = scene.select(counts[scene.point_idx] >= 2)
    in_air = tuple(camera.with_port(NoPort()) for camera in scene.cameras)
    scene = replace(scene, cameras=in_air)
    columns = np.full_like(layout_of(scene).border_col, HELD)
    state = State.from_scene(scene)
    term = LengthTerm(
        ends=np.array([(2, 40)]),
        lengths=np.array([3.0]),
        variances=np.array([1e-6]),
        of_frames=True,
    )
    known = Priors(reference=state, weights=np.zeros(columns.shape), terms=(term,))
    for num_lengths, priors in ((0, None), (1, known)):
        layout = build_layout(scene, columns, num_lengths=num_lengths)
        eqs = likelihood(layout, state, priors)
        reduced = reduced_covariance(layout, eqs, analyse(layout, kind))
        assert reduced.determined == (num_lengths == 1)
    dense = reduced_covariance(layout, eqs, analyse(layout, DENSE))
    slope = np.zeros(layout.num_frame_cols + 1)
    slope[6 * 30 + 3] = 1.0
    variances = [one.variance_of(slope) for one in (reduced, dense)]
    assert variances[0] == pytest.approx(variances[1], rel=1e-6)


def test_sums_do_not_depend_on_the_number_of_threads(survey, monkeypatch):
    layout = layout_of(survey.scene)
    eqs = likelihood(layout, State.from_scene(survey.scene), None)
    graph = build_graph(layout)
    monkeypatch.setattr(schur, "CELLS_PER_THREAD", 10)
    monkeypatch.setattr(schur, "POINTS_AT_ONCE", 100)
    monkeypatch.setattr(threads, "_available", lambda: 3)
    results = []
    for count in (1, 2, 3):
        with threads.limited(count):
            system = schur.reduced_system(layout, graph, eqs, 1e-4)
            step = np.linspace(-1.0, 1.0, layout.num_frame_cols + len(system.border))
            points = schur.substitute_back(layout, graph, eqs, system.inverses, step)
            results.append((*system, points))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_the_structure_decides_and_the_log_tells(caplog):
    caplog.set_level(logging.DEBUG, "uwsfm")
    assert analyse(layout_of(simulate_survey(SPEC, num_frames=12).scene)).kind == DENSE
    survey = SurveySpec(num_frames=400, num_points=4000, detection_rate=0.5)
    scene = simulate_survey(survey).scene
    assert analyse(layout_of(scene)).kind == SPARSE
    # Of the points that a short run of frames sees, nothing closes a loop.
    first, last = np.full((2, scene.num_points), -1)
    first[scene.point_idx[::-1]] = scene.frame_idx[::-1]
    last[scene.point_idx] = scene.frame_idx
    near = (last - first < 6)[scene.point_idx]
    sequence = analyse(layout_of(scene.select(near)[0]))
    assert sequence.kind == BANDED and sequence.width == 5
    told = [record.getMessage() for record in caplog.records]
    assert told[0].startswith("reduced system: dense")
    assert told[1].startswith("reduced system: sparse (399 frames")
    assert told[2].startswith("reduced system: banded") and "band of 5" in told[2]


def test_cuts_order_a_survey_as_well_as_minimum_degree_does():
    spec = SurveySpec(num_frames=700, num_points=7000, detection_rate=0.5)
    graph = build_graph(layout_of(simulate_survey(spec).scene))
    keep = np.arange(graph.num_frames)
    pattern = trees.adjacency(graph, keep)
    costs = {}
    for find_order in (trees.minimum_degree_order, nested_dissection.dissection_order):
        order = find_order(pattern)
        np.testing.assert_array_equal(np.sort(order), keep)
        tree = trees.elimination_tree(graph, keep, pattern, order)
        np.testing.assert_array_equal(np.sort(tree.order), keep)
        costs[find_order] = tree.cost
    cheap, cut = costs.values()
    in_time = trees.elimination_tree(graph, keep, pattern, keep).cost
    # 1.2 and 0.4 here; at 5000 frames 0.8 of what minimum degree costs.
    assert cut < 1.5 * cheap and cut < 0.6 * in_time, (cheap, cut, in_time)


@pytest.mark.slow
def test_a_survey_with_loops_converges_to_the_noise():
    simulated = simulate_survey(
        SurveySpec(num_frames=300, num_points=9000, detection_rate=0.6)
    )
    start = perturbed(
        simulated.scene,
        Perturbation(
            rotation_stddev_deg=0.5, translation_stddev=0.02, point_stddev=0.03
        ),
    )
    layout = layout_of(start)
    assert analyse(layout).kind == SPARSE
    options = LevenbergMarquardtOptions(loss="l2")
    result = minimize(layout, State.from_scene(start), options)
    freedom = 2 * len(layout.xy) - layout.num_unknowns - 3 * start.num_points
    sigma = np.sqrt(np.sum(result.squares) / freedom)
    # The standard deviation of an estimate from 1e5 numbers is 0.2 %.
    assert sigma == pytest.approx(0.5, rel=0.01)
    assert result.num_iterations <= 15
