"""LAS and LAZ, read back by laspy."""

from pathlib import Path

import numpy as np
import pytest

from uwsfm.cloud import Cloud, write_cloud
from uwsfm.errors import InputError, MissingPackageError
from uwsfm.export.las import offsets_and_scale, write_las
from uwsfm.surface.commands import export_las

laspy = pytest.importorskip("laspy")


def random_cloud(rng: np.random.Generator, count: int, extent: float) -> Cloud:
    return Cloud(
        points=rng.uniform(-0.5, 0.5, (count, 3)) * extent + [4e5, 5.4e6, -30.0],
        normals=np.full((count, 3), np.nan),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        stddev=rng.uniform(size=count),
        num_views=rng.integers(1, 9, count),
        view_range=np.full(count, np.nan),
    )


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("extent", [2.0, 5e4])
def test_positions_colours_and_deviations_come_back(tmp_path, rng, suffix, extent):
    cloud = random_cloud(rng, 500, extent)
    cloud.points[7] = np.nan
    write_cloud(cloud, tmp_path / "cloud.ply")
    path = tmp_path / f"cloud.{suffix}"
    export_las(tmp_path / "cloud.ply", path, suffix)
    good = cloud.select(np.isfinite(cloud.points).all(axis=1))
    las = laspy.read(path)
    # Half of the largest step allowed; and 1e-9 of doubles at 5,400 km.
    np.testing.assert_allclose(las.xyz, good.points, rtol=0, atol=5.001e-5)
    rgb = np.stack([las.red, las.green, las.blue], axis=1)
    np.testing.assert_array_equal(rgb // 257, good.colors)
    assert rgb.max() == 257 * int(good.colors.max())
    np.testing.assert_allclose(las.stddev, good.stddev, rtol=1e-6)
    np.testing.assert_array_equal(las.num_views, good.num_views)
    assert "view_range" not in list(las.point_format.extra_dimension_names)
    assert las.header.system_identifier == "unit: metre"


def test_steps_are_as_fine_as_the_extent_allows():
    assert offsets_and_scale(np.array([[0.2, 0.3, 0.4], [3.0, 9.0, 7.0]]))[1] == 1e-6
    with pytest.raises(InputError, match="LAS cannot store that"):
        offsets_and_scale(np.array([[0.0, 0.0, 0.0], [1e6, 0.0, 0.0]]))


def test_without_laspy_one_sentence_names_it(tmp_path: Path, rng, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(MissingPackageError, match=r"package laspy.*\.\[inspect\]"):
        write_las(random_cloud(rng, 5, 1.0), tmp_path / "cloud.las")
