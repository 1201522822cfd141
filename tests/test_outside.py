"""Calibrations with lengths from outside: scale of one camera, place in navigation."""

from dataclasses import replace

import numpy as np
import pytest
from bounds import LEAST, MOST, assert_near_the_bound

from uwsfm import Distances, InputError, Lengths, Positions, calibrate, verdicts
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.scaling import scaled
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import lawn_mower, rich_motion, straight_strip
from uwsfm.solver.terms import centers

HOUSING_KNOWN = {"refine_normals": False, "refine_distances": False}
NAV_FROM_WORLD = np.concatenate(
    [rigid3.quat_from_rotvec([0.5, -1.0, 2.0]), [120.0, -340.0, 15.0]]
)
ARM = np.array([0.3, -0.2, 0.1])
NAV_STDDEV = 0.02


def one_camera(distance=0.02):
    rig = paper_rig(distance=distance)
    return replace(
        rig,
        cameras=rig.cameras[:1],
        cam_from_rig=rigid3.IDENTITY[None].copy(),
        baseline_m=None,
    )


def dive(rig, poses, seed=0, num_points=400, noise_px=0.5):
    options = ObservationOptions(num_points=num_points, noise_px=noise_px, seed=seed)
    return simulate_scene(rig, poses, Relief(stddev=0.1), options)


def bar(truth, stddev=0.001):
    """The distance of the two points that most frames see."""
    counts = np.bincount(truth.point_idx, minlength=truth.num_points)
    ends = np.argsort(-counts, kind="stable")[:2]
    length = np.linalg.norm(np.subtract(*truth.points[ends]))
    return Distances.from_arrays([ends], [length], [stddev])


def tracked(truth, rng, outliers=0.0, stddev=NAV_STDDEV):
    """Positions (F, 3) of an antenna; a share of them 3.7 m off, all alike."""
    antenna = rigid3.transform(rigid3.inverse(truth.rig_from_world), ARM)
    found = rigid3.transform(NAV_FROM_WORLD, antenna)
    found += stddev * rng.normal(size=found.shape)
    wrong = rng.permutation(len(found))[: int(outliers * len(found))]
    found[wrong] += [3.0, -2.0, 1.0]
    return found, np.sort(wrong)


def positions(found, arm=ARM, stddev=NAV_STDDEV):
    known = Positions.from_arrays(np.arange(len(found)), found, np.full(3, stddev), arm)
    return Lengths(positions=known)


def in_nav(truth):
    """True centres (F, 3) in the frame of the positions."""
    return rigid3.transform(NAV_FROM_WORLD, centers(truth.rig_from_world))


def test_scale_of_one_camera_comes_from_a_bar():
    simulated = dive(one_camera(), rich_motion(12))
    lengths = Lengths(between_points=bar(simulated.truth))
    # Twice too large: the free port distance leaves the scale entirely open.
    result = calibrate(scaled(simulated.scene, 2.0), lengths=lengths)
    found, true = (
        centers(scene.rig_from_world) for scene in (result.scene, simulated.truth)
    )
    scale = align(found, true, np.ones(12), with_scale=True).scale
    stddev = result.covariance.scale_stddev
    assert abs(scale - 1.0) < 3.0 * stddev
    assert_near_the_bound(result.covariance, simulated.truth, 0.5, lengths=lengths)
    assert abs(result.lengths.found_m[0] - result.lengths.given_m[0]) < 0.003


def test_scale_scatters_by_its_standard_deviation():
    """20 dives: the scale's error over its standard deviation, and the prediction."""
    errors, reported = [], []
    for seed in range(20):
        simulated = dive(one_camera(), rich_motion(8), seed, num_points=150)
        truth, rng = simulated.truth, np.random.default_rng(seed)
        exact = bar(truth)
        measured = exact.lengths_m + exact.stddevs_m * rng.normal(size=1)
        lengths = Lengths(between_points=replace(exact, lengths_m=measured))
        result = calibrate(simulated.scene, loss="l2", lengths=lengths)
        ends = [result.scene, truth]
        spans = []
        for scene in ends:
            origins = centers(scene.rig_from_world)
            spans.append(np.linalg.norm(origins[:, None] - origins, axis=-1).max())
        errors.append(spans[0] / spans[1] - 1.0)
        reported.append(result.covariance.scale_stddev)
    scores = np.square(np.divide(errors, reported))
    # chi-square of 20: its mean is 1 with a standard deviation of 0.32.
    assert 0.3 < scores.mean() < 2.0


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_known_housing_tells_the_scale_by_refraction(factor):
    """A port at 12 cm, over ground at 0.5 m: whatever scale the start has."""
    poses = straight_strip(12, spacing=0.08, altitude=0.5)
    simulated = dive(one_camera(0.12), poses)
    result = calibrate(scaled(simulated.scene, factor), **HOUSING_KNOWN)
    found, true = (
        centers(scene.rig_from_world) for scene in (result.scene, simulated.truth)
    )
    scale = align(found, true, np.ones(12), with_scale=True).scale
    stddev = result.covariance.scale_stddev
    assert abs(scale - 1.0) < 3.0 * stddev
    # A length that is known to 100 m leaves the scale to refraction, as it is here.
    useless = Distances.from_arrays([[0, 11]], [0.88], [100.0])
    assert_near_the_bound(
        result.covariance,
        simulated.truth,
        0.5,
        lengths=Lengths(between_frames=useless),
        **HOUSING_KNOWN,
    )
    assert any("from refraction alone" in s for s in verdicts(result, ["left"]))


def test_scale_by_refraction_is_that_of_the_port():
    """What the sentence says: a port held at 90 % of its distance, lengths at 90 %."""
    poses = straight_strip(12, spacing=0.08, altitude=0.5)
    scene = dive(one_camera(0.12), poses).scene
    (camera,) = scene.cameras
    nearer = replace(camera.port, distance=0.9 * 0.12, thickness=0.9 * 0.005)
    wrong = replace(scene, cameras=(camera.with_port(nearer),))
    spans = []
    for start in (scene, wrong):
        origins = centers(calibrate(start, **HOUSING_KNOWN).scene.rig_from_world)
        spans.append(np.linalg.norm(origins[0] - origins[-1]))
    # Port and scene are one figure: both solutions are the same, but for tolerance.
    assert spans[1] / spans[0] == pytest.approx(0.9, abs=0.01)


def test_a_tilt_that_was_not_given_is_in_the_scales_deviation_in_all():
    """The port is tilted by 2 degrees and held straight; the images fit all the same.

    Lengths are 3.5 % too long; from the images alone, every observation for itself,
    they would be known to 0.8 %.
    """
    poses = rich_motion(12, altitude=0.6, extent=0.25)
    simulated = dive(one_camera(0.12), poses, noise_px=0.2)
    (camera,) = simulated.scene.cameras
    straight = camera.with_port(replace(camera.port, normal=(0.0, 0.0, 1.0)))
    result = calibrate(replace(simulated.scene, cameras=(straight,)), **HOUSING_KNOWN)
    found, true = (
        centers(scene.rig_from_world) for scene in (result.scene, simulated.truth)
    )
    scale = align(true, found, np.ones(12), with_scale=True).scale
    # Nothing was said of the port's tilt: 2 degrees are assumed.
    result, budget = with_budget(result)
    assert abs(scale - 1.0) < 3.0 * result.covariance.in_all.scale_stddev
    tilt = max(abs(row.scale) for row in budget if "port tilt" in row.name)
    assert tilt > 0.01
    told = verdicts(result, ["left"], budget)
    assert any("holds what the rig file says of the port" in t for t in told)


def test_free_housing_leaves_the_scale_open():
    simulated = dive(one_camera(), rich_motion(12))
    start = scaled(simulated.scene, 2.0)
    result = calibrate(start)
    assert result.covariance.scale_stddev is None and result.covariance.determined
    ends = [np.ptp(centers(s.rig_from_world), axis=0) for s in (start, result.scene)]
    np.testing.assert_allclose(*ends, rtol=0.05)  # the start's scale was kept
    assert predict_covariance(simulated.truth, 0.5).scale_stddev is None
    known = Lengths(between_points=bar(simulated.truth))
    predicted = predict_covariance(simulated.truth, 0.5, lengths=known)
    assert predicted.determined
    # The images tell lengths against each other, the bar one of them: both add up.
    exact = replace(known.between_points, stddevs_m=np.array([1e-7]))
    of_images = predict_covariance(
        simulated.truth, 0.5, lengths=Lengths(between_points=exact)
    )
    of_bar = known.between_points.stddevs_m[0] / known.between_points.lengths_m[0]
    expected = np.hypot(of_images.scale_stddev, of_bar)
    assert predicted.scale_stddev == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("rig", [paper_rig(), one_camera()], ids=["stereo", "mono"])
def test_positions_place_the_model_whatever_a_third_of_them_say(rig, rng):
    simulated = dive(rig, lawn_mower(3, 8, spacing=0.3, line_spacing=0.6))
    truth = simulated.truth
    found, wrong = tracked(truth, rng, outliers=0.3)
    result = calibrate(scaled_start(simulated.scene), lengths=positions(found))
    fit = result.positions
    np.testing.assert_array_equal(np.flatnonzero(~fit.inliers), wrong)
    assert fit.scatter == 1.0 and result.summary.converged
    reached = centers(result.scene.rig_from_world)
    miss = align(reached, in_nav(truth), np.ones(len(found)), with_scale=False)
    # How the model has to be moved onto the truth, about the middle of the track.
    middle = np.median(found, axis=0)
    shift = miss.apply(middle[None])[0] - middle
    turn = rigid3.rotvec_from_quat(miss.y_from_x[:4])
    # The lever arm puts the antenna's middle, not the rig's, where the positions are:
    # the turn moves one against the other by less than a standard deviation.
    error = np.concatenate([turn, shift])
    assert error @ np.linalg.solve(fit.covariance, error) < 22.5  # 0.1 % of chi2_6
    # 24 positions less the third that is wrong tell where their mean is. The middle is
    # their median, a metre or less beside it, which the turn moves.
    along = np.sqrt(np.diag(fit.covariance)[3:])
    best = NAV_STDDEV / np.sqrt(len(found) - len(wrong))
    assert np.all((0.95 * best < along) & (along < 2.5 * best))
    inliers = np.flatnonzero(fit.inliers)
    used = Positions.from_arrays(inliers, found[inliers], np.full(3, NAV_STDDEV), ARM)
    bound = predict_covariance(truth, 0.5, lengths=Lengths(positions=used))
    assert LEAST < result.covariance.scale_stddev / bound.scale_stddev < MOST


def scaled_start(scene):
    """A start as one camera has it, or stereo: that knows its scale."""
    return scaled(scene, 1.7) if len(scene.cameras) == 1 else scene


def test_a_wrong_lever_arm_shows(rng):
    simulated = dive(paper_rig(), rich_motion(20))
    found, _ = tracked(simulated.truth, rng)
    result = calibrate(simulated.scene, lengths=positions(found, arm=-ARM))
    fit = result.positions
    assert fit.scatter > 5.0
    (told,) = (s for s in verdicts(result, ["left", "right"]) if "miss the model" in s)
    assert "times their standard deviations" in told and "lever arm" in told
    misses = np.linalg.norm(fit.misses_m, axis=1)
    assert 0.1 < np.median(misses) < 2.0 * np.linalg.norm(ARM)


MIRRORED = {"x and y swapped": [1, 0, 2], "z of the wrong sign": [1.0, 1.0, -1.0]}


@pytest.mark.parametrize("rig", [paper_rig(), one_camera()], ids=["stereo", "mono"])
@pytest.mark.parametrize("mistake", MIRRORED)
@pytest.mark.parametrize("frames", [[0, 2, 4, 5, 7, 9], list(range(10))])
def test_mirrored_axes_are_no_outliers(rig, mistake, frames, rng):
    simulated = dive(rig, rich_motion(10), num_points=100)
    scene = scaled_start(simulated.scene)
    found, _ = tracked(simulated.truth, rng)
    how = MIRRORED[mistake]
    wrong = found[:, how] if isinstance(how[0], int) else found * how
    for places in (found, wrong):
        known = Positions.from_arrays(
            frames, places[frames], np.full(3, NAV_STDDEV), ARM, "nav.csv"
        )
        lengths = Lengths(positions=known)
        if places is found:
            assert calibrate(scene, lengths=lengths).positions.num_outliers == 0
        else:
            with pytest.raises(InputError, match="nav.csv: the axes of the positions"):
                calibrate(scene, lengths=lengths)


def test_of_four_positions_mirrored_axes_and_a_wrong_one_are_both_named(rng):
    """Three fit any frame: nothing tells the two apart."""
    simulated = dive(paper_rig(), rich_motion(10), num_points=100)
    found = tracked(simulated.truth, rng)[0][:4] * [1.0, 1.0, -1.0]
    result = calibrate(simulated.scene, lengths=positions(found))
    told = verdicts(result, ["left", "right"])[0]
    assert told.startswith("1 of 4 positions contradict") and "mirrored axes" in told


def test_a_straight_track_leaves_the_turn_about_it_open(rng):
    simulated = dive(paper_rig(), straight_strip(15, spacing=0.2))
    found, _ = tracked(simulated.truth, rng)
    result = calibrate(simulated.scene, lengths=positions(found))
    turn, axis = result.positions.turn
    track = found[-1] - found[0]
    assert np.degrees(turn) > 20.0
    told = [s for s in verdicts(result, ["left", "right"]) if "the turn of" in s]
    assert len(told) == 1 and "not determined" in told[0]
    assert abs(axis @ track) > 0.99 * np.linalg.norm(track)
    # Along the track all is well determined.
    along = track / np.linalg.norm(track)
    error = (centers(result.scene.rig_from_world) - in_nav(simulated.truth)) @ along
    # The antenna is off the axis of the turn; what the turn moves is across the track.
    assert abs(error.mean()) < 3.0 * NAV_STDDEV


def test_lengths_that_fit_nothing_are_refused(rng):
    simulated = dive(paper_rig(), rich_motion(8), num_points=100)
    scene = simulated.scene
    found, _ = tracked(simulated.truth, rng)
    with pytest.raises(
        InputError, match="positions: the positions are .* times as far apart"
    ):
        calibrate(scene, lengths=positions(1e-3 * found, stddev=1e-5))
    few = Positions.from_arrays([0, 1, 1], found[:3], np.full(3, 0.1))
    with pytest.raises(InputError, match="at least 3 different frames"):
        calibrate(scene, lengths=Lengths(positions=few))
    far = Distances.from_arrays([[0, 100]], [1.0], [0.1])
    with pytest.raises(InputError, match=r"between_points\.ends is out of range"):
        calibrate(scene, lengths=Lengths(between_points=far))
    with pytest.raises(InputError, match="need the joint strategy"):
        calibrate(scene, lengths=positions(found), strategy="nested")
    scattered = positions(found + rng.normal(size=found.shape), stddev=1e-4)
    assert calibrate(scene, lengths=scattered).positions.scatter > 100.0


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (([[0, 0]], [1.0], [0.1]), r"ends\[0\] are one and the same"),
        (([[0, 1]], [-1.0], [0.1]), r"lengths_m\[0\] must be positive"),
        (([[0, 1]], [1.0], [0.0]), r"stddevs_m\[0\] must be positive"),
        (([[0.5, 1]], [1.0], [0.1]), "ends must be integers"),
    ],
)
def test_impossible_distances_are_refused(arrays, words):
    with pytest.raises(InputError, match=words):
        Distances.from_arrays(*arrays)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (([0], [[0.0, np.nan, 0.0]], [1, 1, 1]), r"positions\[0\] is not finite"),
        (([0], [[0.0, 0.0, 0.0]], [1, 0, 1]), r"covariances\[0\] is not positive"),
        (([0, 1], [[0.0, 0.0, 0.0]], [1, 1, 1]), "positions.shape"),
        (([0], [[0.0, 0.0, 0.0]], [1, 1, 1], [0, 0]), "lever_arm must be three"),
    ],
)
def test_impossible_positions_are_refused(arrays, words):
    with pytest.raises(InputError, match=words):
        Positions.from_arrays(*arrays)
