"""Picks and measurements.yaml: every form, and what is refused in one sentence."""

import pytest
import yaml

from uwsfm import InputError
from uwsfm.measuring.measurements_file import load_measurements
from uwsfm.measuring.picks import PixelPick, PointPick, WorldPick, parsed_pick


def test_picks_are_read_in_all_their_forms():
    assert parsed_pick("1234") == parsed_pick(1234) == PointPick(1234)
    assert parsed_pick("0.5,-1, 2e-1") == parsed_pick([0.5, -1, 0.2])
    assert parsed_pick([0.5, -1, 0.2]) == WorldPick((0.5, -1.0, 0.2))
    found = parsed_pick("left/01.png:412.5,300.0 + right/a+1.png: 380,311.9")
    assert isinstance(found, PixelPick)
    assert [click.image for click in found.clicks] == ["left/01.png", "right/a+1.png"]
    assert found == parsed_pick(
        [
            {"image": "left/01.png", "xy": [412.5, 300.0]},
            {"image": "right/a+1.png", "xy": [380.0, 311.9]},
        ]
    )


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("left/01.png", "is no pick: write a point id"),
        ("1,2", "is no pick"),
        ("-3", "is no pick"),
        ("left/01.png:1,2+", "is no pick"),
        ([1, 2], "is no pick"),
        ([1, 2, float("nan")], "is no pick"),
        (True, "is no pick"),
        ([], "is no pick"),
        ([{"image": "a.png"}], "xy: this key is missing"),
        ([{"image": "a.png", "xy": [1, 2, 3]}], "xy: needs 2 values, got 3"),
        ("a.png:1,2+a.png:1,3", "a.png is clicked twice"),
        ("", "^'' is no pick"),
        ("  ", "^'' is no pick"),
        ("1,2", "^'1,2' is no pick"),
        ("1,2,3,4", "^'1,2,3,4' is no pick"),
        ("1,2,x", "^'1,2,x' is no pick"),
        ("1.5", "^'1.5' is no pick"),
        ("a.png:1,2 b.png:3,4", "is no pick: .*; in YAML between quotes"),
        ([1, 2, "3"], r"^\[1, 2, '3'\] is no pick: .*; in YAML between quotes"),
        ([1, 2, None], "is no pick"),
        ([1, 2, True], "is no pick"),
        ([1, 2, 3, 4], "is no pick"),
        ([1, 2, float("inf")], "is no pick"),
        ([{"image": "a.png", "xy": [1, 2]}, 3], "is no pick"),
        (1.5, "^1.5 is no pick"),
        (None, "^None is no pick"),
    ],
)
def test_what_is_no_pick_is_told(value, words):
    with pytest.raises(ValueError, match=words) as error:
        parsed_pick(value)
    assert "\n" not in str(error.value)


def test_a_pick_is_called_by_its_numbers():
    """x before y, and how many clicks there are besides the first."""
    assert str(PointPick(1234)) == "point 1234"
    assert str(WorldPick((0.12345, -40.0, 1.85))) == "(0.1235, -40, 1.85)"
    texts = ("left/01.png:412.5,30", "right/01.png:380,311.9", "left/02.png:1,2")
    labels = ("", " +1", " +2")
    for count, more in enumerate(labels, 1):
        found = parsed_pick("+".join(texts[:count]))
        assert str(found) == f"left/01.png (412.5, 30){more}"
        assert len(found.clicks) == count and found.clicks[0].xy == (412.5, 30.0)


def test_a_pick_that_was_read_is_itself():
    for text in ("12", "1,2,3", "a.png:1,2"):
        found = parsed_pick(text)
        assert parsed_pick(found) is found
    numbers = parsed_pick(" -1.5 , +2., .25e1 ")
    assert numbers == WorldPick((-1.5, 2.0, 2.5))
    assert parsed_pick((1, 2, 3)) == WorldPick((1.0, 2.0, 3.0))


FILE = """
version: 1
click_stddev_px: 0.5
distances:
  - {name: width, ends: [12, "left/01.png:4.5,3+right/01.png:4,3"]}
  - {ends: [12, 13], click_stddev_px: 2.0}
polylines:
  - {through: [1, 2, [0.1, 0.2, 0.3]]}
areas:
  - {corners: [1, 2, 3]}
heights:
  - {of: 7, above: [1, 2, 3]}
angles:
  - {at: 7, between: [1, 2]}
scale_bars:
  - length_m: 0.5
    stddev_m: 0.0005
    ends:
      - [{image: left/01.png, xy: [412.5, 300.0]}, {image: left/02.png, xy: [3, 4]}]
      - 5
"""


def test_a_file_is_read(tmp_path):
    path = tmp_path / "measurements.yaml"
    path.write_text(FILE)
    tasks = load_measurements(path)
    kinds = ["distance"] * 2 + ["polyline", "area", "height", "angle", "scale bar"]
    assert [task.kind for task in tasks] == kinds
    assert [task.name for task in tasks[:2]] == ["width", "distance 2"]
    assert [task.click_stddev_px for task in tasks[:3]] == [0.5, 2.0, 0.5]
    assert tasks[4].picks[0] == PointPick(7) and tasks[4].keys[:2] == ("of", "above[0]")
    assert (tasks[-1].length_m, tasks[-1].stddev_m) == (0.5, 0.0005)
    assert load_measurements(yaml.safe_load(FILE))[0].picks == tasks[0].picks


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "there is nothing to measure"),
        ({"distance": []}, "distance: unknown key, did you mean distances"),
        ({"distances": [{"ends": [1]}]}, r"distances\[0\].ends: needs 2 values, got 1"),
        ({"distances": [{"from": 1}]}, "from: unknown key; the keys here are name"),
        ({"areas": [{"corners": [1, 2]}]}, "corners: needs 3 values, got 2"),
        ({"heights": [{"of": 1, "above": [1, 2]}]}, "above: needs 3 values, got 2"),
        ({"distances": [{"ends": [1, "a"]}]}, r"ends\[1\]: 'a' is no pick"),
        ({"scale_bars": [{"ends": [1, 2]}]}, "length_m: this key is missing"),
        ({"click_stddev_px": 0}, "click_stddev_px"),
    ],
)
def test_what_is_wrong_in_a_file_is_told_with_its_key(tmp_path, content, words):
    path = tmp_path / "measurements.yaml"
    path.write_text(yaml.safe_dump({"version": 1, **content}))
    with pytest.raises(InputError, match=words) as error:
        load_measurements(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_what_a_file_leaves_out_is_this():
    """Clicks of a pixel, exact bars, names by kind and number; each its own place."""
    four = ["1,0,0", "2,0,0", "3,0,0", "4,0,0"]
    picks = [WorldPick((k, 0.0, 0.0)) for k in (1.0, 2.0, 3.0, 4.0)]
    content = {
        "version": 1,
        "distances": [{"ends": four[:2]}],
        "polylines": [{"through": four[:2]}, {"through": four, "name": "branch"}],
        "areas": [{"corners": four[:3]}],
        "heights": [{"above": four[1:], "of": four[0]}],
        "angles": [{"between": four[1:3], "at": four[0]}],
        "scale_bars": [{"ends": four[:2], "length_m": 0.5}],
    }
    tasks = load_measurements(content)
    assert {task.click_stddev_px for task in tasks} == {1.0}
    assert {task.stddev_m for task in tasks} == {0.0}
    assert [task.length_m for task in tasks] == 6 * [None] + [0.5]
    assert [task.name for task in tasks] == [
        *("distance 1", "polyline 1", "branch", "area 1"),
        *("height 1", "angle 1", "scale bar 1"),
    ]
    assert [task.where for task in tasks] == [
        *("distances[0]", "polylines[0]", "polylines[1]", "areas[0]"),
        *("heights[0]", "angles[0]", "scale_bars[0]"),
    ]
    counts = (2, 2, 4, 3, 4, 3, 2)
    assert [list(task.picks) for task in tasks] == [picks[:k] for k in counts]
    assert tasks[0].keys == ("ends[0]", "ends[1]")
    assert tasks[2].keys == tuple(f"through[{k}]" for k in range(4))
    assert tasks[3].keys == ("corners[0]", "corners[1]", "corners[2]")
    assert tasks[4].keys == ("of", "above[0]", "above[1]", "above[2]")
    assert tasks[5].keys == ("at", "between[0]", "between[1]")


@pytest.mark.parametrize(
    ("key", "item"),
    [
        ("distances", {"ends": [1, 2, 3]}),
        ("polylines", {"through": [1]}),
        ("angles", {"at": 1, "between": [2]}),
        ("angles", {"at": 1, "between": [2, 3, 4]}),
        ("scale_bars", {"ends": [1, 2, 3], "length_m": 1.0}),
        ("scale_bars", {"ends": [1, 2], "length_m": 0.0}),
        ("scale_bars", {"ends": [1, 2], "length_m": float("inf")}),
        ("scale_bars", {"ends": [1, 2], "length_m": 1.0, "stddev_m": -0.1}),
        ("distances", {"ends": [1, 2], "click_stddev_px": 0.0}),
    ],
)
def test_every_entry_has_as_many_places_as_it_takes(key, item):
    with pytest.raises(InputError, match=rf"^{key}\[0\]"):
        load_measurements({"version": 1, key: [item]})
