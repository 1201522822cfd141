"""What is given of lengths and positions, and is in another unit."""

import pytest
from dense import small_scene

from uwsfm import InputError, calibrate
from uwsfm.geometry import rigid3
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.inputs.lengths_file import load_positions
from uwsfm.simulate.rigs import sample_rig

HEADER = "frame,x,y,z,sx,sy,sz\n"


def test_a_dive_straight_down_is_no_pair_of_degrees(tmp_path):
    path = tmp_path / "nav.csv"
    rows = "".join(f"{i}.png,0,0,{-0.1 * i},0.1,0.1,0.1\n" for i in range(1, 5))
    path.write_text(HEADER + rows)
    assert len(load_positions(path).frames) == 4
    path.write_text(HEADER + rows.replace("-0.", "-0.00"))
    with pytest.raises(InputError, match="within 20 mm of each other"):
        load_positions(path)


def test_a_lever_arm_in_millimetres_is_refused():
    with pytest.raises(InputError, match="is not 500 m away"):
        KnownLengths.read(None, "nav.csv", [200.0, -100.0, -500.0])


def test_a_distance_that_the_baseline_contradicts_grossly_is_refused(tmp_path):
    path = tmp_path / "lengths.yaml"
    names = [f"{i}.png" for i in range(4)]
    text = "version: 1\nframe_distances:\n"
    text += f"  - {{frames: [{names[0]}, {names[3]}], length_m: 500, stddev_m: 1}}\n"
    path.write_text(text)
    scene = small_scene(4, 60).truth
    known = KnownLengths.read(path, None, None)
    with pytest.raises(InputError, match="500 m, but by the rig's baseline these"):
        known.placed(sample_rig(), names, scene)


def test_positions_in_millimetres_are_refused_by_the_name_of_their_file(tmp_path):
    path = tmp_path / "nav.csv"
    names = [f"{i}.png" for i in range(4)]
    scene = small_scene(4, 60).truth
    places = 1e3 * rigid3.inverse(scene.rig_from_world)[:, 4:]
    path.write_text(
        HEADER
        + "".join(
            f"{name},{x},{y},{z},1,1,1\n"
            for name, (x, y, z) in zip(names, places, strict=True)
        )
    )
    known = KnownLengths.read(None, path, None)
    scene, lengths = known.placed(sample_rig(), names, scene)
    with pytest.raises(InputError, match=r"nav\.csv: the positions are 1000 times"):
        calibrate(scene, lengths=lengths)


def test_degrees_near_a_meridian_and_at_one_depth_are_degrees(tmp_path):
    path = tmp_path / "nav.csv"
    rows = "".join(f"{i}.png,-0.1234{i},51.50{i},-12,1,1,1\n" for i in range(4))
    path.write_text(HEADER + rows)
    with pytest.raises(InputError, match="are degrees of longitude and latitude"):
        load_positions(path)
