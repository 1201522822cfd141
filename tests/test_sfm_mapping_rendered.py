"""Both mappers on a rendered dive where pinholes do badly, beside its truth."""

import json
import shutil
from pathlib import Path

import pytest

import uwsfm
from uwsfm.jobs.evaluate import Comparison, compare_with_truth
from uwsfm.simulate.sequence import near_spec, render_sequence

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def near(tmp_path_factory) -> Path:
    """0.3 m away, ports at 12 cm, tilted by 10 and 8 degrees; the file says 6 cm."""
    pytest.importorskip("open3d")
    folder = tmp_path_factory.mktemp("near") / "dive"
    render_sequence(near_spec(), folder)
    return folder


def reconstructed(near: Path, out: Path, **options) -> Comparison:
    result = uwsfm.reconstruct(
        near / "rig.yaml", near / "images", out, seed=1, **options, report=False
    )
    return compare_with_truth(result, near / "truth.json")


@pytest.fixture(scope="module")
def refractive(near, tmp_path_factory) -> tuple[Path, Comparison]:
    out = tmp_path_factory.mktemp("refractive") / "out"
    return out, reconstructed(near, out, num_threads=1)


def test_the_map_is_right_where_that_of_pinholes_is_far_off(near, refractive, tmp_path):
    """The map itself, before the last adjustment, which both mappers share."""
    out, ours = refractive
    shutil.copytree(out, tmp_path / "out")  # features and matches are the same
    pinhole = reconstructed(near, tmp_path / "out", mapper="pinhole")
    for name, found in (("refractive", ours), ("pinhole", pinhole)):
        print(
            f"\n{name}: {found.num_frames} of {found.num_true_frames} frames, centres "
            f"{1e3 * found.start_center_rms_m:.2f} mm, adjusted "
            f"{1e3 * found.center_rms_m:.2f} mm"
        )
    assert ours.num_frames == ours.num_true_frames
    # Found: 0.12 and 15 mm; adjusted 0.10 and 0.11 mm.
    assert ours.start_center_rms_m < 0.5e-3
    assert ours.start_center_rms_m < 0.1 * pinhole.start_center_rms_m
    assert ours.center_rms_m < 0.5e-3


def test_twice_the_same_files(near, refractive, tmp_path):
    """Same seed, another number of threads, another folder."""
    first, again = refractive[0], tmp_path / "out"
    reconstructed(near, again, num_threads=2)
    names = ["points.ply", "housing.yaml"]
    names += [f"sparse/{path.name}" for path in sorted((first / "sparse").iterdir())]
    for name in names:
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    summary = json.loads((again / "summary.json").read_text())
    assert summary["unregistered_frames"] == []
