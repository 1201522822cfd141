"""Both mappers on a rendered dive where pinholes do badly, beside its truth."""

import json

import numpy as np
import pytest

import uwsfm
from uwsfm.evaluate import compare_with_truth
from uwsfm.simulate.sequence import near_spec, render_sequence

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    """0.3 m away, ports at 12 cm, tilted by 10 and 8 degrees; the file says 6 cm."""
    pytest.importorskip("open3d")
    folder = tmp_path_factory.mktemp("near") / "dive"
    render_sequence(near_spec(), folder)
    return folder


def reconstructed(near, out, mapper):
    result = uwsfm.reconstruct(
        near / "rig.yaml", near / "images", out, mapper=mapper, seed=1
    )
    return result, compare_with_truth(result, near / "truth.json")


def test_the_refractive_map_is_right_where_pinholes_are_far_off(near, tmp_path):
    """The map itself, before the last adjustment, which both mappers share."""
    _, refractive = reconstructed(near, tmp_path / "refractive", "refractive")
    result, pinhole = reconstructed(near, tmp_path / "pinhole", "pinhole")
    for name, found in (("refractive", refractive), ("pinhole", pinhole)):
        print(
            f"\n{name}: {found.num_frames} of {found.num_true_frames} frames, centres "
            f"{1e3 * found.start_center_rms_m:.2f} mm, adjusted "
            f"{1e3 * found.center_rms_m:.2f} mm"
        )
    assert refractive.num_frames == refractive.num_true_frames
    assert refractive.start_center_rms_m < 0.1 * pinhole.start_center_rms_m
    # The last adjustment finds the same from far off, if it finds its way at all.
    assert refractive.center_rms_m < max(1.2 * pinhole.center_rms_m, 0.5e-3)


def test_twice_the_same_files(near, tmp_path):
    """Same seed, other numbers of threads, another folder."""
    found = []
    for threads in (1, 2):
        out = tmp_path / str(threads)
        uwsfm.reconstruct(
            near / "rig.yaml", near / "images", out, seed=3, num_threads=threads
        )
        names = ["points.ply", "housing.yaml"]
        names += [f"sparse/{p.name}" for p in sorted((out / "sparse").iterdir())]
        found.append({name: (out / name).read_bytes() for name in names})
        summary = json.loads((out / "summary.json").read_text())
        assert summary["unregistered_frames"] == []
        assert np.isfinite(summary["sigma_px"])
    assert found[0].keys() == found[1].keys()
    for name, content in found[0].items():
        assert content == found[1][name], name
