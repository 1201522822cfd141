"""Every standard deviation that a user gives, followed to the number that it weighs.

All numbers are different, so that none can stand in for another.
"""

from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene

from uwsfm import Distances, Lengths, Positions, Scene
from uwsfm.calibration.absolute_constraints import Outside
from uwsfm.calibration.clicks import with_click_noise
from uwsfm.calibration.point_placement import placed
from uwsfm.geometry import rigid3
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.simulate.rigs import sample_rig
from uwsfm.solver.state import State
from uwsfm.solver.terms import centers

NAMES = [f"{i}.png" for i in range(4)]

LENGTHS = """
version: 1
scale_bars:
  - length_m: 0.61
    stddev_m: 0.0011
    click_stddev_px: 0.7
    ends:
      - [{image: left/0.png, xy: [101, 102]}, {image: right/1.png, xy: [103, 104]}]
      - [{image: left/2.png, xy: [105, 106]}, {image: left/3.png, xy: [107, 108]}]
  - length_m: 0.37
    stddev_m: 0.0023
    ends:
      - [{image: right/0.png, xy: [111, 112]}, {image: right/2.png, xy: [113, 114]}]
      - [{image: left/1.png, xy: [115, 116]}, {image: right/3.png, xy: [117, 118]}]
frame_distances:
  - {frames: [3.png, 1.png], length_m: 0.9, stddev_m: 0.013}
  - {frames: [0.png, 2.png], length_m: 0.7, stddev_m: 0.017}
"""

# The rows of a table come in any order.
POSITIONS = """frame,x,y,z,sx,sy,sz
2.png,1.5,2.5,3.5,0.02,0.05,0.11
0.png,4.5,5.5,6.5,0.03,0.07,0.13
3.png,7.5,8.5,9.5,0.19,0.17,0.23
"""


def test_every_number_of_the_files_reaches_its_array(tmp_path):
    (tmp_path / "lengths.yaml").write_text(LENGTHS)
    (tmp_path / "nav.csv").write_text(POSITIONS)
    known = KnownLengths.read(
        tmp_path / "lengths.yaml", tmp_path / "nav.csv", [0.3, -0.2, 0.1]
    )
    plain = small_scene(4, 60).truth
    scene, lengths = known.placed(sample_rig(), NAMES, plain)

    bars, frames = lengths.between_points, lengths.between_frames
    num_points, num_rows = plain.num_points, plain.num_observations
    assert (bars.ends - num_points).tolist() == [[0, 1], [2, 3]]
    assert bars.lengths_m.tolist() == [0.61, 0.37]
    assert bars.stddevs_m.tolist() == [0.0011, 0.0023]
    assert lengths.click_stddevs_px.tolist() == [0.7, 1.0]  # 1 px unless it is given
    assert (lengths.clicked - num_rows).tolist() == list(range(8))
    rows = np.column_stack([scene.camera_idx, scene.frame_idx, scene.point_idx])
    assert (rows[num_rows:] - [0, 0, num_points]).tolist() == [
        *[[0, 0, 0], [1, 1, 0], [0, 2, 1], [0, 3, 1]],
        *[[1, 0, 2], [1, 2, 2], [0, 1, 3], [1, 3, 3]],
    ]
    clicked = [101, 103, 105, 107, 111, 113, 115, 117]
    assert scene.xy[num_rows:].tolist() == [[x, x + 1] for x in clicked]

    assert frames.ends.tolist() == [[3, 1], [0, 2]]
    assert frames.lengths_m.tolist() == [0.9, 0.7]
    assert frames.stddevs_m.tolist() == [0.013, 0.017]

    positions = lengths.positions
    assert positions.frame_idx.tolist() == [2, 0, 3]
    assert positions.positions.tolist() == [
        [1.5, 2.5, 3.5],
        [4.5, 5.5, 6.5],
        [7.5, 8.5, 9.5],
    ]
    expected = [[0.02, 0.05, 0.11], [0.03, 0.07, 0.13], [0.19, 0.17, 0.23]]
    for block, stddevs in zip(positions.covariances, expected, strict=True):
        np.testing.assert_allclose(block, np.diag(np.square(stddevs)), rtol=1e-14)
    assert positions.lever_arm.tolist() == [0.3, -0.2, 0.1]


SIGMA_PX = 0.4


def test_what_a_miss_costs_is_its_square_in_standard_deviations():
    """By hand: sigma^2 / 2 times the sum of squares, each over its own variance."""
    scene = small_scene(4, 25).truth
    state = State.from_scene(scene)
    bars = Distances.from_arrays([[0, 7], [3, 9]], [0.5, 0.8], [0.011, 0.007])
    frames = Distances.from_arrays([[0, 3]], [0.9], [0.05])
    arm = np.array([0.3, -0.2, 0.1])
    antenna = rigid3.transform(rigid3.inverse(scene.rig_from_world), arm)
    misses = np.array(
        [[0.1, 0, 0], [0, -0.2, 0], [0, 0, 0.3], [0.05, 0.06, -0.07]], dtype=float
    )
    stddevs = np.array([[2, 5, 11], [3, 7, 13], [19, 17, 23], [29, 31, 37]]) / 100.0
    known = Positions.from_arrays(np.arange(4), antenna - misses, stddevs, arm)
    outside = Outside(
        scene, Lengths(between_points=bars, between_frames=frames, positions=known)
    )
    outside.robust = False
    # The model lies in the frame of the positions as it is.
    start = np.concatenate([rigid3.IDENTITY[:4], -outside.middle])
    outside.nav_start = start
    state = replace(state, nav_from_world=start)
    terms = outside.terms(np.arange(scene.num_points), np.arange(4), SIGMA_PX)

    def miss(places, item):
        gap = places[item.ends[:, 0]] - places[item.ends[:, 1]]
        return (np.linalg.norm(gap, axis=1) - item.lengths_m) / item.stddevs_m

    expected = [
        miss(scene.points, bars),
        miss(centers(scene.rig_from_world), frames),
        (misses / stddevs).ravel(),
    ]
    for term, ratios in zip(terms, expected, strict=True):
        cost = 0.5 * SIGMA_PX**2 * np.sum(np.square(ratios))
        assert term.cost(state) == pytest.approx(cost, rel=1e-9)
    squares = np.sum(np.square(misses / stddevs), axis=1)
    np.testing.assert_allclose(outside.squares(state), squares, rtol=1e-9)


def with_ends(scene: Scene, views, ends) -> tuple[Scene, Lengths]:
    """A scene with the ends of two bars, seen in the images (camera, frame) given."""
    first = scene.num_points
    rows = np.array([[c, f, first + i] for i, v in enumerate(views) for c, f in v])
    larger = replace(
        scene,
        points=np.vstack([scene.points, ends]),
        camera_idx=np.append(scene.camera_idx, rows[:, 0]),
        frame_idx=np.append(scene.frame_idx, rows[:, 1]),
        point_idx=np.append(scene.point_idx, rows[:, 2]),
        xy=np.vstack([scene.xy, np.zeros((len(rows), 2))]),
    )
    exact, valid = larger.projections()
    assert valid.all()
    clicked = scene.num_observations + np.arange(len(rows))
    length = np.linalg.norm(ends[[0, 2]] - ends[[1, 3]], axis=1)
    bars = Distances.from_arrays(
        [[first, first + 1], [first + 2, first + 3]], length, [0.01, 0.02]
    )
    lengths = Lengths(
        between_points=bars,
        clicked=clicked,
        click_stddevs_px=np.array([0.5, 1.5]),
    )
    xy = np.vstack([scene.xy, exact[clicked]])
    return replace(larger, xy=xy), lengths


def test_noise_of_clicks_is_what_the_length_of_a_bar_scatters_by(rng):
    """Monte-Carlo: ends placed by noisy clicks, at one end in fewer images than at the
    other, so that each counts for itself."""
    plain = small_scene(4, 25).truth
    many = [(c, f) for c in (0, 1) for f in range(4)]
    views = [many, [(0, 0), (0, 1)], [(1, 1), (1, 2)], many[:3]]
    # In the middle of what all images show, half a metre apart.
    middle = plain.points.mean(axis=0)
    away = [[-0.2, 0.1, 0.05], [0.25, 0, -0.1], [0.1, -0.2, 0.1], [-0.1, 0.2, 0]]
    scene, lengths = with_ends(plain, views, middle + np.array(away))
    clicks, _ = scene.select(
        np.isin(np.arange(scene.num_observations), lengths.clicked)
    )
    noise = lengths.click_stddevs_px[[0, 0, 1, 1]][clicks.point_idx][:, None]
    found = []
    for _ in range(400):
        ends = placed(
            replace(clicks, xy=clicks.xy + noise * rng.normal(size=(len(noise), 2)))
        )
        found.append(np.linalg.norm(ends[[0, 2]] - ends[[1, 3]], axis=1))
    scatter = np.std(found, axis=0)
    bars = with_click_noise(lengths, scene).between_points
    of_clicks = np.sqrt(bars.stddevs_m**2 - lengths.between_points.stddevs_m**2)
    # The spread of 400 is known to 1 / sqrt(800) = 3.5 %, here to four of them.
    np.testing.assert_allclose(of_clicks, scatter, rtol=0.14)
