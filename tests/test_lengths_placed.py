"""lengths.yaml and positions.csv: every number goes where its name says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hand_made_result import small_model

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.inputs.known_lengths import KnownLengths, image_index
from uwsfm.inputs.lengths_file import load_lengths, load_positions


@pytest.fixture(scope="module")
def model():
    return small_model()


# ---- By the names of images ---------------------------------------------------------


def lengths_file(folder, **content):
    path = folder / "lengths.yaml"
    path.write_text(yaml.safe_dump({"version": 1, **content}))
    return path


def end(*clicks):
    return [{"image": name, "xy": list(xy)} for name, xy in clicks]


BARS = [
    {
        "length_m": 0.51,
        "stddev_m": 0.0011,
        "click_stddev_px": 2.5,
        "ends": [
            end(("left/0000.jpg", (1.0, 2.0)), ("right/0001.jpg", (3.0, 4.0))),
            end(("left/0002.jpg", (5.0, 6.0)), ("left/0001.jpg", (7.0, 8.0))),
        ],
    },
    {
        "length_m": 0.62,
        "stddev_m": 0.0022,
        "ends": [
            end(("right/0002.jpg", (9.0, 10.0)), ("right/0000.jpg", (11.0, 12.0))),
            end(("left/0000.jpg", (13.0, 14.0)), ("right/0000.jpg", (15.0, 16.0))),
        ],
    },
]


def test_ends_of_bars_are_points_of_their_own_at_the_end(model, tmp_path):
    given = KnownLengths.read(lengths_file(tmp_path, scale_bars=BARS), None, None)
    given.check_names(model.rig, model.frame_names)
    scene, lengths = given.placed(model.rig, model.frame_names, model.scene)
    before = model.scene
    points, observations = before.num_points, before.num_observations
    assert scene.num_points == points + 4
    assert np.all(np.isnan(scene.points[points:]))
    np.testing.assert_array_equal(scene.points[:points], before.points)
    np.testing.assert_array_equal(scene.xy[:observations], before.xy)
    new = slice(observations, None)
    assert scene.xy[new].ravel().tolist() == list(range(1, 17))
    assert scene.camera_idx[new].tolist() == [0, 1, 0, 0, 1, 1, 0, 1]
    assert scene.frame_idx[new].tolist() == [0, 1, 2, 1, 2, 0, 0, 0]
    expected = points + np.array([0, 0, 1, 1, 2, 2, 3, 3])
    assert scene.point_idx[new].tolist() == expected.tolist()
    known = lengths.between_points
    assert known.ends.tolist() == [[points, points + 1], [points + 2, points + 3]]
    assert known.lengths_m.tolist() == [0.51, 0.62]
    assert known.stddevs_m.tolist() == [0.0011, 0.0022]
    assert lengths.click_stddevs_px.tolist() == [2.5, 1.0]
    assert lengths.clicked.tolist() == list(range(observations, observations + 8))


def test_distances_and_positions_go_to_the_frames_of_their_names(model, tmp_path):
    centers = rigid3.inverse(model.scene.rig_from_world)[:, 4:]
    true = float(np.linalg.norm(centers[2] - centers[0]))
    path = lengths_file(
        tmp_path,
        frame_distances=[
            {"frames": ["0002.jpg", "0000.jpg"], "length_m": true, "stddev_m": 0.03}
        ],
    )
    nav = tmp_path / "nav.csv"
    nav.write_text(
        "frame,x,y,z,sx,sy,sz\n"
        "0002.jpg,1,2,3,0.1,0.2,0.3\n"
        "0000.jpg,4,5,6,0.4,0.5,0.6\n"
        "0001.jpg,7,8,9,0.7,0.8,0.9\n"
    )
    given = KnownLengths.read(path, nav, [0.1, -0.2, 0.3])
    assert given.given and not KnownLengths.read(None, None, None).given
    scene, lengths = given.placed(model.rig, model.frame_names, model.scene)
    assert scene is model.scene
    between = lengths.between_frames
    assert between.ends.tolist() == [[2, 0]]
    assert between.lengths_m.tolist() == [true]
    assert between.stddevs_m.tolist() == [0.03]
    known = lengths.positions
    assert known.frame_idx.tolist() == [2, 0, 1]
    assert known.positions.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    deviations = [np.sqrt(np.diag(block)).tolist() for block in known.covariances]
    np.testing.assert_allclose(
        deviations, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]
    )
    assert known.lever_arm.tolist() == [0.1, -0.2, 0.3] and known.source == str(nav)
    nothing = KnownLengths.read(None, None, None)
    assert nothing.placed(model.rig, model.frame_names, scene) == (scene, None)
    two = ("0002.jpg", "else.jpg", "0001.jpg")
    with pytest.raises(InputError, match="2 positions belong to frames of the model"):
        replace(given, file=None).placed(model.rig, two, scene)
    with pytest.raises(
        InputError, match=r"frame_distances\[0\]: frame '0000.jpg' is not"
    ):
        replace(given, table=None).placed(model.rig, two, scene)


@pytest.mark.parametrize(
    ("factor", "refused"),
    [(4.5, False), (5.5, True), (1 / 4.5, False), (1 / 5.5, True)],
)
def test_a_distance_is_in_another_unit_beyond_five_times(
    model, tmp_path, factor, refused
):
    centers = rigid3.inverse(model.scene.rig_from_world)[:, 4:]
    true = float(np.linalg.norm(centers[1] - centers[0]))
    item = {"frames": ["0000.jpg", "0001.jpg"], "stddev_m": 0.1}
    item["length_m"] = factor * true
    given = KnownLengths.read(
        lengths_file(tmp_path, frame_distances=[item]), None, None
    )
    if refused:
        with pytest.raises(InputError, match=f"these frames are {true:.3g} m apart"):
            given.placed(model.rig, model.frame_names, model.scene)
        # Without a baseline there is no metre to compare with.
        alone = replace(
            model.rig,
            cameras=model.rig.cameras[:1],
            cam_from_rig=model.rig.cam_from_rig[:1],
            baseline_m=None,
        )
        given.placed(alone, model.frame_names, model.scene)
    else:
        given.placed(model.rig, model.frame_names, model.scene)


def test_names_and_pixels_that_no_image_has_are_named(model, tmp_path):
    def check(**content):
        given = KnownLengths.read(lengths_file(tmp_path, **content), None, None)
        given.check_names(model.rig, model.frame_names)

    far = [{"frames": ["0000.jpg", "9.jpg"], "length_m": 1.0, "stddev_m": 0.1}]
    with pytest.raises(
        InputError, match=r"frame_distances\[0\].frames: '9.jpg' is not"
    ):
        check(frame_distances=far)
    for click, words in (
        (("up/0000.jpg", (1.0, 2.0)), "'up/0000.jpg' is not among the images, whose"),
        (("right/0000.jpg", (800.5, 2.0)), r"xy \(800.5, 2\) is outside of right/0000"),
        (("right/0000.jpg", (1.0, 600.5)), "which has 800x600 pixels"),
        (("right/0000.jpg", (-0.5, 2.0)), r"xy \(-0.5, 2\) is outside"),
        (("right/0000.jpg", (1.0, -0.5)), r"xy \(1, -0.5\) is outside"),
    ):
        bar = {**BARS[1], "ends": [BARS[1]["ends"][0], end(BARS_FIRST, click)]}
        with pytest.raises(InputError, match=words) as error:
            check(scale_bars=[BARS[0], bar])
        assert "scale_bars[1].ends[1]" in str(error.value)
    # The corners of the image are in it.
    corner = end(("left/0000.jpg", (0.0, 0.0)), ("right/0000.jpg", (800.0, 600.0)))
    check(scale_bars=[{**BARS[1], "ends": [corner, corner]}])
    once = end(("left/0000.jpg", (1.0, 2.0)), ("left/0000.jpg", (3.0, 4.0)))
    bar = {**BARS[1], "ends": [BARS[1]["ends"][0], once]}
    given = KnownLengths.read(lengths_file(tmp_path, scale_bars=[bar]), None, None)
    with pytest.raises(InputError, match=r"ends\[1\]: it takes two different .* are 1"):
        given.placed(model.rig, model.frame_names, model.scene)
    nav = tmp_path / "nav.csv"
    rows = "".join(f"{name},{k},2,3,1,1,1\n" for k, name in enumerate("abc"))
    nav.write_text("frame,x,y,z,sx,sy,sz\n" + rows)
    table = KnownLengths.read(None, nav, None)
    with pytest.raises(InputError, match=r"frame 'a' is not .* \(nor are 2 more\)"):
        table.check_names(model.rig, model.frame_names)
    table.check_names(model.rig, tuple("abc"))
    with pytest.raises(InputError, match=r"frame 'b' is not .* \(nor are 1 more\)"):
        table.check_names(model.rig, ("a",))
    with pytest.raises(InputError, match="whose names are like 'a'$"):
        table.check_names(model.rig, ("a", "b"))


BARS_FIRST = ("left/0000.jpg", (1.0, 2.0))


def test_images_are_named_by_folder_and_frame(model):
    assert image_index(model.rig, ("a.png", "b.png")) == {
        "left/a.png": (0, 0),
        "left/b.png": (0, 1),
        "right/a.png": (1, 0),
        "right/b.png": (1, 1),
    }


@pytest.mark.parametrize(
    ("arm", "words"),
    [
        ([1.0, 2.0], "must be three numbers"),
        ([1.0, math.inf, 2.0], "must be three numbers"),
        ([1.0, 2.0, -33.0], "the antenna is not 33 m away"),
        ([1.0, 2.0, -27.0], None),
    ],
)
def test_a_lever_arm_is_three_numbers_of_some_metres(tmp_path, arm, words):
    nav = tmp_path / "nav.csv"
    rows = "".join(f"{k},{k},2,3,1,1,1\n" for k in range(3))
    nav.write_text("frame,x,y,z,sx,sy,sz\n" + rows)
    if words is None:
        assert KnownLengths.read(None, nav, arm).lever_arm.tolist() == arm
        assert KnownLengths.read(None, nav, [1, 2, 3]).lever_arm.dtype == float
        with pytest.raises(InputError, match="has no effect without positions"):
            KnownLengths.read(None, None, arm)
    else:
        with pytest.raises(InputError, match=words):
            KnownLengths.read(None, nav, arm)


# ---- Files --------------------------------------------------------------------------


def test_a_file_of_lengths_is_read_with_its_defaults(tmp_path):
    found = load_lengths(lengths_file(tmp_path, scale_bars=BARS))
    first, second = found.scale_bars
    assert (first.length_m, first.stddev_m, first.click_stddev_px) == (
        0.51,
        0.0011,
        2.5,
    )
    assert second.click_stddev_px == 1.0 and found.frame_distances == ()
    assert first.ends[1][0].image == "left/0002.jpg" and first.ends[1][0].xy == (5, 6)
    for content, words in (
        ({"scale_bars": []}, "neither scale_bars nor frame_distances are in it"),
        (
            {"frame_distances": [{"frames": ["a", "a"], "length_m": 1, "stddev_m": 1}]},
            r"frame_distances\[0\].frames: one and the same frame",
        ),
    ):
        with pytest.raises(InputError, match=words):
            load_lengths(lengths_file(tmp_path, **content))


def nav(folder, rows, header="frame,x,y,z,sx,sy,sz"):
    path = folder / "nav.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_a_table_of_positions_is_read_column_by_column(tmp_path):
    rows = ["a,1,2,3,0.1,0.2,0.3", "", " b ,4,5,6,0.4,0.5,0.6", "c,7,8,9,0.7,0.8,0.9"]
    found = load_positions(nav(tmp_path, rows))
    assert found.frames == ("a", "b", "c")
    assert found.positions.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert found.stddevs.tolist() == [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["a,1,2,3,1,1,1", "b,1,2,4,1,1,1"], "2 positions are too few"),
        (["a,1,2,3,1,1,1", "a,1,2,3,1,1,1"], "row 3: frame 'a' is given twice"),
        (["a,1,2,3,1,1"], "row 2: 6 columns instead of 7"),
        (["a,1,2,x,1,1,1"], "row 2: z: 'x' is not a number"),
        (["a,1,nan,3,1,1,1"], "row 2: y: nan is not finite"),
        (["a,1,2,3,1,0,1"], "row 2: sy: 0 m must be positive"),
        (["a,1,2,3,1,1,1100000"], r"row 2: sz: 1.1e\+06 m must be positive, and at"),
    ],
)
def test_wrong_rows_are_named_with_their_column(tmp_path, rows, words):
    with pytest.raises(InputError, match=words):
        load_positions(nav(tmp_path, rows))


@pytest.mark.parametrize(
    ("step", "at", "height", "words"),
    [
        # Two centimetres in x and y, where degrees may be.
        (0.009, (12.3, 51.5), 5.0, "x and y change by 18 mm only over 3 positions"),
        (0.011, (12.3, 51.5), 5.0, None),
        (0.009, (0.3, 0.5), 5.0, None),
        (0.009, (380.0, 0.5), 5.0, None),
        (0.009, (12.3, 0.5), 5.0, "if 12.3090 and 0.5000 are degrees of longitude"),
        (0.009, (0.3, 0.5), 0.009, "lie within 20 mm of each other"),
        (0.011, (0.3, 0.5), 0.009, None),
        (9.0, (11000.0, 0.5), 5.0, "coordinates up to 11018 m are not of a local"),
        (9.0, (9900.0, 0.5), 5.0, None),
    ],
)
def test_degrees_and_millimetres_are_no_positions(tmp_path, step, at, height, words):
    rows = [f"{k},{at[0] + k * step},{at[1]},{k * height},1,1,1" for k in range(3)]
    path = nav(tmp_path, rows)
    if words is None:
        assert len(load_positions(path).frames) == 3
    else:
        with pytest.raises(InputError, match=words):
            load_positions(path)


def test_units_are_looked_for_in_all_positions_and_in_no_deviation(tmp_path):
    near = [f"{k},{0.001 * k},0,0,1,1,20000" for k in range(3)]
    assert len(load_positions(nav(tmp_path, [*near, "far,10,0,0,1,1,1"])).frames) == 4


def test_another_header_is_refused_with_the_right_one(tmp_path):
    with pytest.raises(InputError, match="the column 'lat' is in degrees"):
        load_positions(nav(tmp_path, [], "frame,lat,lon,z,sx,sy,sz"))
    with pytest.raises(InputError, match="or frame,depth,sdepth .* got 'a,b'"):
        load_positions(nav(tmp_path, [], "a,b"))
    rows = [f"{k},{k},2,3,1,1,1" for k in range(3)]
    assert (
        len(load_positions(nav(tmp_path, rows, " Frame ,X,y,z,sx,sy,SZ")).frames) == 3
    )


DEPTHS = "frame,depth,sdepth"


def test_depths_are_heights_below_the_surface(model, tmp_path):
    """Positive downwards; the rest of the place is not known."""
    rows = ["0001.jpg,12.5,0.1", "0000.jpg,-0.25,0.2", "0002.jpg,3,0.3"]
    path = nav(tmp_path, rows, DEPTHS)
    found = load_positions(path)
    assert found.depths_only and found.source == str(path)
    assert found.frames == ("0001.jpg", "0000.jpg", "0002.jpg")
    assert found.positions.tolist() == [[0, 0, -12.5], [0, 0, 0.25], [0, 0, -3.0]]
    assert found.stddevs.tolist() == [[1e3, 1e3, s] for s in (0.1, 0.2, 0.3)]
    given = KnownLengths.read(None, path, [0.1, 0.2, 0.3])
    _, lengths = given.placed(model.rig, model.frame_names, model.scene)
    known = lengths.positions
    assert known.measured.tolist() == [False, False, True]
    assert known.frame_idx.tolist() == [1, 0, 2]
    assert known.positions[:, 2].tolist() == [-12.5, 0.25, -3.0]
    deviations = [np.sqrt(np.diag(block)).tolist() for block in known.covariances]
    np.testing.assert_allclose(deviations, found.stddevs)
    whole = load_positions(nav(tmp_path, [f"{k},{k},2,3,1,1,1" for k in range(3)]))
    assert not whole.depths_only


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["a,5,1", "b,5.009,1", "c,5.018,1"], "lie within 20 mm of each other"),
        (["a,5,1", "b,5.011,1", "c,5.022,1"], None),
        (["a,9,1", "b,10,1", "c,11000,1"], "coordinates up to 11000 m are not of a"),
        (["a,9,1", "b,10,1", "c,9900,1"], None),
        (["a,9,1", "b,10,0", "c,11,1"], "row 3: sdepth: 0 m must be positive"),
        (["a,9,1", "b,10,1000001", "c,11,1"], "row 3: sdepth: 1e"),
        (["a,9,1", "b,10,1000000", "c,11,1"], None),
        (["a,9,1", "b,10,1,1", "c,11,1"], "row 3: 4 columns instead of 3"),
        (["a,9,1", "b,x,1", "c,11,1"], "row 3: depth: 'x' is not a number"),
        (["a,9,1", "b,inf,1", "c,11,1"], "row 3: depth: inf is not finite"),
        (["a,9,1", "b,10,1"], "2 positions are too few"),
    ],
)
def test_depths_are_checked_as_positions_are(tmp_path, rows, words):
    path = nav(tmp_path, rows, DEPTHS)
    if words is None:
        assert load_positions(path).depths_only
    else:
        with pytest.raises(InputError, match=words):
            load_positions(path)


@pytest.mark.parametrize(
    ("x", "y", "degrees"),
    [
        (1.0, 0.0, False),  # a dive straight down, a metre from the origin
        (0.0, -1.0, False),
        (1.01, 0.0, True),
        (0.0, -1.01, True),
        (-12.3, 0.5, True),
        (0.5, -12.3, True),
        (360.0, 51.5, True),
        (-360.0, 51.5, True),
        (360.01, 51.5, False),
        (51.5, 360.01, False),
    ],
)
def test_degrees_are_more_than_one_and_up_to_a_full_turn(tmp_path, x, y, degrees):
    path = nav(tmp_path, [f"{k},{x},{y},{5 * k},1,1,1" for k in range(3)])
    if degrees:
        words = f"if {x:.4f} and {y:.4f} are degrees of longitude and latitude"
        with pytest.raises(InputError, match=words):
            load_positions(path)
    else:
        assert len(load_positions(path).frames) == 3


@pytest.mark.parametrize("changes", ["x", "y"])
def test_positions_that_move_along_one_axis_are_metres(tmp_path, changes):
    rows = [
        f"{k},{12 + 0.021 * k if changes == 'x' else 12},"
        f"{51 + 0.021 * k if changes == 'y' else 51},3,1,1,1"
        for k in range(3)
    ]
    assert load_positions(nav(tmp_path, rows)).positions[2, 2] == 3.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ends": BARS[0]["ends"] + BARS[1]["ends"][:1]}, "ends: needs 2 values, got"),
        ({"ends": BARS[0]["ends"][:1]}, "ends: needs 2 values, got 1"),
        ({"ends": [BARS[0]["ends"][0][:1], BARS[0]["ends"][1]]}, r"ends\[0\]"),
        ({"length_m": 1.1e6}, "length_m"),
        ({"length_m": 0.0}, "length_m"),
        ({"stddev_m": 0.0}, "stddev_m"),
        ({"click_stddev_px": 0.0}, "click_stddev_px"),
        ({"length_m": 0.9e6}, None),
    ],
)
def test_a_bar_has_two_ends_of_two_clicks_and_a_length(tmp_path, change, words):
    path = lengths_file(tmp_path, scale_bars=[BARS[1], {**BARS[0], **change}])
    if words is None:
        assert load_lengths(path).scale_bars[1].length_m == 9e5
    else:
        with pytest.raises(InputError, match=rf"scale_bars\[1\]\.{words}"):
            load_lengths(path)


@pytest.mark.parametrize("frames", [["a"], ["a", "b", "c"], []])
def test_a_distance_is_between_two_frames(tmp_path, frames):
    pair = {"frames": frames, "length_m": 1.0, "stddev_m": 0.1}
    words = rf"frame_distances\[0\].frames: needs 2 values, got {len(frames)}"
    with pytest.raises(InputError, match=words):
        load_lengths(lengths_file(tmp_path, frame_distances=[pair]))
    with pytest.raises(InputError, match="neither scale_bars nor frame_distances are"):
        load_lengths(lengths_file(tmp_path))
