"""Which images are matched with which."""

from pathlib import Path

import pytest

from uwsfm.sfm.images import Frames
from uwsfm.sfm.matching import frame_pairs, image_pairs
from uwsfm.sfm.options import MatchOptions


def dive(num_frames: int) -> Frames:
    return Frames(
        image_dir=Path("dive"),
        folders=("left", "right"),
        names=tuple(f"{i}.png" for i in range(num_frames)),
        unmatched=(),
    )


def test_exhaustive_pairs_are_all_pairs_of_images_once():
    pairs = image_pairs(dive(5), MatchOptions())
    assert len(pairs) == 10 * 9 // 2
    assert len({frozenset(pair) for pair in pairs}) == len(pairs)
    assert all(a != b for a, b in pairs)


def test_long_dives_are_matched_with_their_neighbours():
    num_frames = 500
    pairs = list(frame_pairs(num_frames, MatchOptions(overlap=10)))
    assert len(pairs) < 20 * num_frames
    assert all((i, i) in pairs for i in range(num_frames))
    distances = {j - i for i, j in pairs}
    assert distances == {*range(11), 16, 32, 64, 128, 256}


@pytest.mark.parametrize("strategy", ["auto", "exhaustive", "sequential"])
def test_cameras_of_one_frame_are_always_matched(strategy):
    pairs = image_pairs(dive(70), MatchOptions(strategy=strategy, overlap=1))
    for i in range(70):
        assert (f"left/{i}.png", f"right/{i}.png") in pairs


def test_strategy_follows_the_number_of_frames():
    few, many = (len(list(frame_pairs(n, MatchOptions()))) for n in (60, 61))
    assert few == 60 * 61 // 2
    assert many < few
