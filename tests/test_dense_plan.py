"""Memory and time are known before the first image."""

from dataclasses import replace

import pytest

from uwsfm.cli.dense import _larger_voxels
from uwsfm.dense.plan import Load, band_bytes, compared_bytes, plan
from uwsfm.errors import InputError

LOAD = Load(pixels=[270_000] * 42, map_bytes=3e8, is_stereo=False, neighbours=8)


def test_all_that_is_planned_fits():
    for memory in (1e9, 2e9, 4e9):
        found = plan(LOAD, memory, 4e8, threads=8)
        room = memory - 4e8
        assert found.matchers * LOAD.map_bytes <= room
        # Depth maps that are compared are among those that are kept.
        maps = max(found.fusers * compared_bytes(270_000, 8), found.store_bytes)
        bands = found.fusers * band_bytes(270_000)
        assert maps + bands + found.voxel_bytes <= room * 1.0001


def test_little_memory_means_fewer_at_a_time_and_more_time():
    tight, wide = (plan(LOAD, memory, 4e8, threads=4) for memory in (9e8, 4e9))
    assert tight.matchers == 1 < wide.matchers
    assert tight.seconds > wide.seconds
    assert "42 depth maps, 0.3 Mpx each: about" in str(wide)


def test_voxels_that_memory_made_larger_are_told():
    summary = {"unit": "metre", "voxel": 0.004, "voxel_asked": 0.002}
    text = _larger_voxels(summary)
    assert "voxels are 4 mm and not 2 mm" in text and "--max-memory" in text


def test_too_little_memory_is_told_before_the_work():
    with pytest.raises(InputError, match="--max-memory 0.50GB is too little"):
        plan(LOAD, 5e8, 4e8, threads=2)
    # What is said to be enough is enough.
    enough = 4e8 + 3e8
    with pytest.raises(InputError, match=f"they need {enough / 1e9:.2f}GB"):
        plan(replace(LOAD, pixels=[1000]), 5e8, 4e8, threads=2)
    plan(replace(LOAD, pixels=[1000]), enough, 4e8, threads=2)
