"""Variances of what is computed from places, against dense inverses."""

from dataclasses import replace

import numpy as np
import pytest
from dense import dense_system, small_scene
from test_outside import (
    HOUSING_KNOWN,
    bar,
    dive,
    one_camera,
    positions,
    scaled_start,
    tracked,
)

from uwsfm import Lengths, calibrate
from uwsfm.calibration.point_placement import misses, placed
from uwsfm.calibration.propagation import FEATURE, Places, Propagation
from uwsfm.calibration.uncertainty import clusters_of, posterior_covariance
from uwsfm.measuring.quantities import area, distance, height
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion, straight_strip
from uwsfm.solver.covariance import point_covariances
from uwsfm.solver.layout import build_layout

CLICK_PX = 0.7
ROUND = [0, 1, 3, 2]
"""A way around four places whose sides do not cross."""


def distance_slope(points, first, second):
    """(1, M, 3) of the distance between two of the places."""
    along = points[first] - points[second]
    along /= np.linalg.norm(along)
    slope = np.zeros((1, len(points), 3))
    slope[0, first], slope[0, second] = along, -along
    return slope


@pytest.fixture(scope="module")
def solved():
    return calibrate(small_scene(noise_px=0.3).scene, loss="l2")


@pytest.fixture(scope="module")
def clicked(solved):
    """Two points of the scene once more, clicked in all images that saw them."""
    rng = np.random.default_rng(0)
    part, _ = solved.scene.select(np.isin(solved.scene.point_idx, [3, 11]))
    pixels = part.projections()[0] + CLICK_PX * rng.normal(size=part.xy.shape)
    part = replace(part, xy=pixels)
    return replace(part, points=placed(part))


def test_the_optimum_is_opened_where_it_was_left(dive_result):
    """With priors, known lengths and clicked scale bars."""
    calibration = dive_result.result.calibration
    found = Propagation(calibration)
    stored = calibration.covariance
    variance = calibration.summary.sigma_px**2
    border = variance * found._reduced.border
    spread = np.sqrt(np.diag(stored.border))
    # Equal sums in another order, in a matrix of condition 1e7.
    assert np.abs((border - stored.border) / np.outer(spread, spread)).max() < 1e-7
    points = variance * point_covariances(
        found.optimum.layout, found._eqs, found._reduced
    )
    features = points[: calibration.scene.num_points]
    np.testing.assert_allclose(features, stored.points, rtol=1e-6, atol=1e-14)


def one_camera_dive(known=None):
    simulated = dive(one_camera(), rich_motion(8), num_points=150)
    lengths = None if known is None else known(simulated.truth)
    return calibrate(simulated.scene, lengths=lengths)


def known_housing_dive():
    poses = straight_strip(12, spacing=0.08, altitude=0.5)
    return calibrate(dive(one_camera(0.12), poses).scene, **HOUSING_KNOWN)


def tracked_dive(rig):
    simulated = dive(rig, rich_motion(8), num_points=150)
    found, _ = tracked(simulated.truth, np.random.default_rng(0), outliers=0.3)
    return calibrate(scaled_start(simulated.scene), lengths=positions(found))


OPTIMA = {
    "scale held": one_camera_dive,
    "scale by a bar": lambda: one_camera_dive(
        lambda truth: Lengths(between_points=bar(truth))
    ),
    "scale by refraction": known_housing_dive,
    "stereo among positions": lambda: tracked_dive(paper_rig()),
    "one camera among positions": lambda: tracked_dive(one_camera()),
}


@pytest.mark.parametrize("name", OPTIMA)
def test_every_optimum_is_opened_where_it_was_left(name):
    calibration = OPTIMA[name]()
    stored, sigma = calibration.covariance, calibration.summary.sigma_px
    found = Propagation(calibration)
    assert found.determined == stored.determined
    # Weights of priors are taken at what was found, not at what was given: 1e-6.
    for again, before in (
        (found._reduced.border[None], stored.border[None]),
        (found._reduced.frames, stored.frames),
    ):
        spread = np.sqrt(np.einsum("fii->fi", before))
        gap = np.abs(sigma**2 * again - before)
        assert np.all(gap <= 1e-5 * spread[:, :, None] * spread[:, None])
    if stored.scale_stddev is not None:
        again = posterior_covariance(found.optimum).covariance.scale_stddev
        assert again == pytest.approx(stored.scale_stddev, rel=1e-5)


def test_clicks_are_placed_where_they_fit_best(clicked):
    """The gradient vanishes: a step either way does not fit better."""
    best = np.sum(misses(clicked) ** 2)
    for axis in range(3):
        for shift in (-1e-5, 1e-5):
            moved = clicked.points + shift * np.eye(3)[axis]
            assert np.sum(misses(replace(clicked, points=moved)) ** 2) > best


def test_rays_from_one_side_place_nothing(solved):
    first = np.flatnonzero(solved.scene.point_idx == 3)[0]
    scene, _ = solved.scene.select(np.arange(solved.scene.num_observations) == first)
    twice = replace(
        scene,
        camera_idx=np.repeat(scene.camera_idx, 2),
        frame_idx=np.repeat(scene.frame_idx, 2),
        point_idx=np.repeat(scene.point_idx, 2),
        xy=np.repeat(scene.xy, 2, axis=0),
    )
    assert np.isnan(placed(twice)).all()


def test_variances_are_those_of_the_dense_normal_matrix(solved, clicked):
    """Points of the model, clicked places, and both at once."""
    propagation = Propagation(solved)
    scene, optimum = solved.scene, propagation.optimum
    jac, _ = dense_system(scene, optimum.layout)
    norms = np.linalg.norm(jac, axis=0)
    scaled = jac / norms
    dense = np.linalg.inv(scaled.T @ scaled) / np.outer(norms, norms)
    dense *= optimum.sigma_px**2

    layout = build_layout(clicked, optimum.columns)
    layout = layout._replace(frame_col=optimum.layout.frame_col)
    by_click, _ = dense_system(clicked, layout)
    size = layout.num_frame_cols + layout.num_border_cols
    by_place = by_click[:, size:]
    normal = by_place.T @ by_place
    pull = -np.linalg.solve(normal, by_place.T @ by_click[:, :size])
    own = CLICK_PX**2 * np.linalg.inv(normal)

    known = np.array([5, 17])
    places = Places.joined(
        [
            propagation.of_points(known),
            propagation.of_rays(clicked, np.full(2, CLICK_PX)),
        ]
    )
    columns = size + (3 * known[:, None] + np.arange(3)).ravel()
    onto = np.zeros((12, len(dense)))
    onto[np.arange(6), columns] = 1.0
    onto[6:, :size] = pull
    expected = onto @ dense @ onto.T
    expected[6:, 6:] += own
    for pair in ((0, 1), (2, 3), (0, 3)):
        slope = distance_slope(places.points, *pair)
        flat = slope.reshape(1, -1)
        found = propagation.covariance(places, slope)[0, 0]
        # The scaled normal matrix has condition 1e7 here: 1e-16 of it.
        assert found == pytest.approx((flat @ expected @ flat.T).item(), rel=1e-8)


def test_the_frame_that_is_held_does_not_matter(solved, clicked):
    """Distances are free of the gauge; places are not."""
    propagation = Propagation(solved)
    places = propagation.of_rays(clicked, np.full(2, CLICK_PX))
    slope = distance_slope(places.points, 0, 1)
    place = np.zeros((1, 2, 3))
    place[0, 0, 0] = 1.0
    expected = [propagation.covariance(places, s).item() for s in (slope, place)]

    last = solved.scene.num_frames - 1
    order = np.roll(np.arange(last + 1), 1)  # the last frame comes first, and is held
    back = np.argsort(order)

    def renumbered(scene):
        poses, frames = scene.rig_from_world[order], back[scene.frame_idx]
        return replace(scene, rig_from_world=poses, frame_idx=frames)

    propagation = Propagation(replace(solved, scene=renumbered(solved.scene)))
    places = propagation.of_rays(renumbered(clicked), np.full(2, CLICK_PX))
    found = [propagation.covariance(places, s).item() for s in (slope, place)]
    assert found[0] == pytest.approx(expected[0], rel=1e-8)
    assert abs(found[1] / expected[1] - 1.0) > 0.05


def given_back(jac, residuals, clusters, optimum):
    """What each cluster's part in the pose of its frame took from its residuals, by
    dense projections: the pose moves without the cluster, and the points follow."""
    layout = optimum.layout
    size = jac.shape[1] - 3 * len(layout.point_start) + 3
    poses, points = jac[:, : layout.num_frame_cols], jac[:, size:]
    free = poses - points @ np.linalg.lstsq(points, poses, rcond=None)[0]
    frame = np.repeat(layout.cell_frame, np.diff(layout.cell_start))
    back = np.zeros(len(residuals))
    for cluster in range(clusters.max() + 1):
        rows = np.flatnonzero(clusters == cluster)
        col = layout.frame_col[frame[rows[0] // 2]]
        if col < 0:
            continue
        own = free[:, col : col + 6]
        rest = own.T @ own - own[rows].T @ own[rows]
        back[rows] = own[rows] @ np.linalg.solve(rest, own[rows].T @ residuals[rows])
    return back


def test_errors_that_clusters_share_are_summed_as_they_reach_the_number(solved):
    """Against sums over the dense matrix, cluster after cluster."""
    propagation = Propagation(solved)
    optimum = propagation.optimum
    known = np.array([5, 17])
    places = propagation.of_points(known)
    assert np.all(places.in_model != FEATURE)
    slope = distance_slope(places.points, 0, 1)
    jac, residuals = dense_system(solved.scene, optimum.layout)
    size = jac.shape[1] - 3 * solved.scene.num_points
    gradient = np.zeros(jac.shape[1])
    columns = size + (3 * known[:, None] + np.arange(3)).ravel()
    gradient[columns] = slope.ravel()
    reach = np.linalg.lstsq(jac.T @ jac, gradient, rcond=1e-14)[0]
    clusters = np.repeat(clusters_of(optimum), 2)
    by_row = (jac @ reach) * (residuals + given_back(jac, residuals, clusters, optimum))
    sums = np.bincount(clusters, by_row)
    expected = sums @ sums * len(by_row) / optimum.degrees_of_freedom
    found = propagation.clustered_covariance(places, slope).item()
    assert found == pytest.approx(expected, rel=1e-5)


def test_what_is_open_has_no_variance(solved, clicked):
    """With glass of no thickness and a free baseline nothing tells the scale."""
    thin = tuple(
        camera.with_port(replace(camera.port, thickness=0.0))
        for camera in solved.scene.cameras
    )
    scene = replace(solved.scene, cameras=thin)
    at_zero = np.zeros(2, dtype=bool)
    options = replace(solved.options, baseline_stddev_m=1e6)
    columns = options.border_columns(thin, at_zero)
    covariance = replace(solved.covariance, border_cols=columns)
    # 1e6 m is no knowledge, next to a baseline of 0.2 m.
    opened = replace(solved, scene=scene, options=options, covariance=covariance)
    propagation = Propagation(opened)
    places = propagation.of_points(np.array([5, 17]))
    slope = distance_slope(places.points, 0, 1)
    assert not propagation.determined
    assert np.isnan(propagation.covariance(places, slope)).all()
    assert np.isnan(propagation.clustered_covariance(places, slope)).all()


@pytest.mark.slow
def test_measurements_scatter_as_predicted():
    """200 dives with noise of their own in features and clicks: what comes out scatters
    by its standard deviation, about the truth."""
    rng = np.random.default_rng(0)
    truth = small_scene(6, 80).truth
    part, chosen = truth.select(np.isin(truth.point_idx, [3, 11, 20, 31]))
    found, promised = [], []
    for _ in range(200):
        noisy = truth.xy + 0.3 * rng.normal(size=truth.xy.shape)
        result = calibrate(replace(truth, xy=noisy), loss="l2")
        cameras = {
            name: getattr(result.scene, name)
            for name in ("cameras", "cam_from_rig", "rig_from_world")
        }
        pixels = part.xy + CLICK_PX * rng.normal(size=part.xy.shape)
        clicked = replace(part, xy=pixels, **cameras)
        clicked = replace(clicked, points=placed(clicked))
        propagation = Propagation(result)
        places = Places.joined(
            [
                propagation.of_rays(clicked, np.full(4, CLICK_PX)),
                propagation.of_points(np.array([5, 17])),
            ]
        )
        values = [distance(places.points[:2]), distance(places.points[4:])]
        values += [area(places.points[ROUND]), height(places.points[[4, 0, 1, 2]])]
        slopes = np.zeros((4, 6, 3))
        slopes[0, :2], slopes[1, 4:] = values[0].slope, values[1].slope
        slopes[2, ROUND], slopes[3, [4, 0, 1, 2]] = values[2].slope, values[3].slope
        found.append([item.value for item in values])
        promised.append(np.sqrt(np.diag(propagation.covariance(places, slopes))))
    true = np.vstack([truth.points[chosen], truth.points[[5, 17]]])
    expected = [distance(true[:2]), distance(true[4:])]
    expected += [area(true[ROUND]), height(true[[4, 0, 1, 2]])]
    off = np.array(found) - [item.value for item in expected]
    ratio = np.sqrt(np.mean((off / np.array(promised)) ** 2, axis=0))
    # 200 draws tell a standard deviation to 5 %: three of that.
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
