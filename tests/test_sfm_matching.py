"""Which images are matched with which."""

from pathlib import Path

import numpy as np
import pytest

from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.frontend.match_blocks import match_block, pair_blocks
from uwsfm.sfm.frontend.matching import frame_pairs, image_pairs
from uwsfm.sfm.frontend.retrieval import similar_frames
from uwsfm.sfm.options import MatchOptions


def dive(num_frames: int) -> Frames:
    return Frames(
        image_dir=Path("dive"),
        folders=("left", "right"),
        names=tuple(f"{i}.png" for i in range(num_frames)),
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
    loops = list(frame_pairs(num_frames, MatchOptions(overlap=10), [(3, 403)]))
    assert set(loops) - set(pairs) == {(3, 403)}
    assert len(set(loops)) == len(loops)


@pytest.mark.parametrize("strategy", ["auto", "exhaustive", "sequential"])
def test_cameras_of_one_frame_are_always_matched(strategy):
    pairs = image_pairs(dive(70), MatchOptions(strategy=strategy, overlap=1))
    for i in range(70):
        assert (f"left/{i}.png", f"right/{i}.png") in pairs


def test_strategy_follows_the_number_of_frames():
    few, many = (len(list(frame_pairs(n, MatchOptions()))) for n in (60, 61))
    assert few == 60 * 61 // 2
    assert many < few


@pytest.mark.parametrize("num_threads", [1, 2, 4])
def test_blocks_hold_every_pair_once_and_little_else(num_threads):
    """An index per image and block is the price; a thread without work, too."""
    images = range(200)
    near = [(a, b) for a in images for b in range(a + 1, min(a + 20, 200))]
    loops = [(a, a + 100) for a in range(0, 100, 7)]
    blocks = pair_blocks(near + loops, images, num_threads)
    assert sorted(p for block in blocks for p in block) == sorted(near + loops)
    assert len(blocks) >= num_threads
    indices = sum(len({i for pair in block for i in pair}) for block in blocks)
    assert indices < 3 * len(images)
    # Few images still occupy every thread, to the same extent.
    small = pair_blocks([(a, b) for a in range(28) for b in range(a)], range(28), 2)
    assert max(map(len, small)) <= 0.55 * sum(map(len, small))


def test_matches_do_not_depend_on_the_block(tmp_path):
    """COLMAP searches approximately: a pair's order matters, its block does not."""
    rng = np.random.default_rng(5)
    scene = rng.integers(0, 80, (900, 128))
    views = {
        i: np.clip(
            scene[rng.permutation(900)[:700]] + rng.integers(-9, 9, (700, 128)), 0, 255
        )
        for i in (7, 3, 5, 1)
    }
    descriptors = {i: view.astype(np.uint8) for i, view in views.items()}
    pairs = [(7, 3), (7, 5), (5, 1), (1, 3)]
    together = match_block(descriptors, pairs, tmp_path)
    for pair, matches in zip(pairs, together, strict=True):
        (alone,) = match_block(descriptors, [pair], tmp_path)
        np.testing.assert_array_equal(alone, matches)
        a, b = (views[i][matches[:, k]] for k, i in enumerate(pair))
        assert len(matches) > 300  # of about 544 common rows
        assert np.mean(np.abs(a.astype(int) - b).max(axis=1) <= 18) > 0.99
    assert list(tmp_path.iterdir()) == []


def test_a_dive_that_comes_back_finds_the_frames_it_saw_before():
    """Two rounds over the same floor, half of the features new each time.

    Each frame shows half of the 300 features of its place, so that two rounds share a
    quarter, among as many that no other frame has. Chance would meet one frame in 20.
    """
    rng = np.random.default_rng(3)
    half = 40
    floor = rng.gamma(0.6, 60.0, (half, 300, 128)).clip(0, 255)
    # Neighbourhoods differ in what they are made of, as sand, rock and weed do.
    floor *= rng.gamma(2.0, 0.5, (half, 1, 128))

    def images(frame: int):
        rows = floor[frame % half][rng_of(frame).permutation(300)[:150]]
        strange = rng_of(frame).gamma(0.6, 60.0, (150, 128))
        noisy = np.vstack([rows, strange]) + rng_of(frame).normal(0.0, 8.0, (300, 128))
        return [noisy.clip(0, 255).astype(np.uint8)]

    def rng_of(frame: int) -> np.random.Generator:
        return np.random.default_rng(frame)

    pairs = similar_frames(images, 2 * half, num_similar=3, min_step=11)
    assert all(j - i >= 11 for i, j in pairs)
    assert len(pairs) <= 3 * 2 * half
    met = {i for i, j in pairs if j == i + half}
    assert len(met) > 0.9 * half
    assert pairs == similar_frames(images, 2 * half, num_similar=3, min_step=11)
