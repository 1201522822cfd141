"""Files for other programs: what one number of a point or a pixel is, read back."""

import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from hand_made_result import small_model

from uwsfm._base.checksums import write_checksums
from uwsfm.errors import InputError, MissingPackageError
from uwsfm.geometry import rigid3
from uwsfm.results.files import (
    HOUSING,
    SUMMARY,
    WORK,
    depth_stddev,
    export_colmap,
    export_ply,
    read_model,
    read_summary,
    unit_of_model,
)
from uwsfm.results.housing import export_housing
from uwsfm.surface.geotiff import (
    write_color_tiff,
    write_height_tiff,
    write_origin_tiff,
)
from uwsfm.surface.height_map import HeightMap
from uwsfm.surface.units import length_words, short_unit

KINDS = {"float": "f4", "uchar": "u1", "int": "i4"}


def read_points(path):
    """The vertices of a binary PLY, by a reader of its own, and its comment."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[1] == "format binary_little_endian 1.0"
    (comment,) = [line for line in lines if line.startswith("comment ")]
    (count,) = [int(x.split()[-1]) for x in lines if x.startswith("element vertex")]
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    kinds = [(name, f"<{KINDS[kind]}") for kind, name in fields]
    return np.frombuffer(body, kinds, count), comment


@pytest.fixture(scope="module")
def model():
    return small_model()


def test_points_have_the_mean_of_their_errors(model, tmp_path):
    """Point 0 is off by 1, 2, 3, ... px in its images, all others by none."""
    scene = model.scene
    exact, _ = scene.projections()
    mine = np.flatnonzero(scene.point_idx == 0)
    off = 1.0 + np.arange(len(mine))
    xy = exact.copy()
    xy[mine, 1] += off
    moved = replace(model, scene=replace(scene, xy=xy))
    export_ply(moved, tmp_path / "p.ply", unit="fathom")
    rows, comment = read_points(tmp_path / "p.ply")
    assert comment == "comment unit: fathom; made by uwsfm"
    # Half a unit in the last of 24 bits.
    assert rows["reprojection_error_px"][0] == pytest.approx(off.mean(), rel=1e-6)
    assert np.all(rows["reprojection_error_px"][1:] < 1e-6)
    assert np.array_equal(rows["track_length"], np.bincount(scene.point_idx))
    assert np.array_equal(rows["id"], np.arange(scene.num_points) + 1)
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(rows[name], scene.points[:, axis], rtol=1e-6)
    for channel, name in enumerate(("red", "green", "blue")):
        assert np.array_equal(rows[name], model.colors[:, channel])
    own = ("id", "track_length", "reprojection_error_px")
    assert rows.dtype.names == (*"xyz", "red", "green", "blue", *own)
    export_ply(moved, tmp_path / "q.ply")
    assert "unit: metre" in read_points(tmp_path / "q.ply")[1]


def test_the_deviation_of_a_depth_is_along_the_line_of_sight(model, tmp_path):
    """A covariance of 3 mm along a point's mean sight and 1 mm across."""
    scene = model.scene
    centers = rigid3.inverse(
        rigid3.compose(
            scene.cam_from_rig[scene.camera_idx], scene.rig_from_world[scene.frame_idx]
        )
    )[:, 4:]
    covariances = np.zeros((scene.num_points, 3, 3))
    for point, place in enumerate(scene.points):
        dirs = place - centers[scene.point_idx == point]
        dirs /= np.linalg.norm(dirs, axis=1)[:, None]
        sight = dirs.mean(axis=0)
        sight /= np.linalg.norm(sight)
        covariances[point] = 1e-6 * np.eye(3) + 8e-6 * np.outer(sight, sight)
    np.testing.assert_allclose(depth_stddev(model, covariances), 0.003, rtol=1e-9)
    export_ply(model, tmp_path / "p.ply", covariances)
    rows, _ = read_points(tmp_path / "p.ply")
    np.testing.assert_allclose(rows["depth_stddev_m"], 0.003, rtol=1e-6)


def test_the_unit_of_a_result_is_that_of_its_summary(tmp_path):
    assert read_summary(tmp_path) is None
    assert unit_of_model(tmp_path) not in ("metre", "scale arbitrary")
    path = tmp_path / "summary.json"
    path.write_text('{"scale": {"unit": "scale arbitrary"}}')
    assert unit_of_model(tmp_path) == "scale arbitrary"
    for text in ("[1]", '{"scale": '):
        path.write_text(text)
        with pytest.raises(
            InputError, match="summary.json is damaged: run the command"
        ):
            read_summary(tmp_path)
    with pytest.raises(InputError, match="nowhere: no such folder"):
        read_model(tmp_path / "nowhere")


def test_a_model_is_read_back_with_its_housing(model, tmp_path):
    export_colmap(model, tmp_path / "sparse")
    export_housing(model.rig, tmp_path / "housing.yaml")
    found = read_model(tmp_path)
    assert np.array_equal(found.scene.points, model.scene.points)
    assert np.array_equal(found.scene.xy, model.scene.xy)
    for before, after in zip(model.rig.cameras, found.rig.cameras, strict=True):
        np.testing.assert_allclose(after.port.row, before.port.row, rtol=1e-12)


def test_every_file_of_a_model_is_held_against_its_checksum(model, tmp_path):
    """A byte more, which their readers would not mind; and what was not copied."""
    export_colmap(model, tmp_path / "sparse")
    export_housing(model.rig, tmp_path / "housing.yaml")
    paths = [*sorted((tmp_path / "sparse").iterdir()), tmp_path / "housing.yaml"]
    names = ["cameras", "frames", "images", "points3D", "rigs"]
    assert [path.name for path in paths] == [*(f"{n}.bin" for n in names), HOUSING]
    write_checksums(tmp_path, paths)
    assert read_model(tmp_path).scene.num_points == model.scene.num_points
    for path in paths:
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        changed = f"{path.name} is not the file that the run wrote"
        with pytest.raises(InputError, match=changed):
            read_model(tmp_path)
        path.unlink()
        with pytest.raises(InputError, match=f"{path.name} is missing, but SHA256SUMS"):
            read_model(tmp_path)
        path.write_bytes(content)
    read_model(tmp_path)


def test_a_summary_of_more_than_a_hundred_megabytes_is_none(tmp_path):
    path = tmp_path / "summary.json"
    path.write_bytes(b"{}" + 10**8 * b" ")
    try:
        with pytest.raises(InputError, match="summary.json is damaged"):
            read_summary(tmp_path)
    finally:
        path.unlink()


def test_lengths_are_words_with_two_digits():
    assert length_words(0.01234, "metre") == "12 mm"
    assert length_words(0.0956, "metre") == "96 mm"
    assert length_words(0.1, "metre") == "0.1 m"
    assert length_words(0.12, "metre") == "0.12 m"
    assert length_words(1.234, "metre") == "1.2 m"
    assert length_words(0.01234, "arbitrary unit") == "0.012 (arbitrary unit)"
    assert short_unit("metre") == "m" and short_unit("fathom") == "fathom"
    assert short_unit("scale arbitrary") == "arbitrary unit"


# ---- GeoTIFF ------------------------------------------------------------------------

_SIZES = {2: ("s", 1), 3: ("H", 2), 4: ("I", 4), 12: ("d", 8)}


def tags_of(path):
    """The tags of the first image of a TIFF, by a reader of its own."""
    data = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}[data[:2]]
    (at,) = struct.unpack(f"{order}I", data[4:8])
    (count,) = struct.unpack(f"{order}H", data[at : at + 2])
    found = {}
    for k in range(count):
        entry = data[at + 2 + 12 * k : at + 14 + 12 * k]
        tag, kind, number = struct.unpack(f"{order}HHI", entry[:8])
        if kind not in _SIZES:
            continue
        letter, size = _SIZES[kind]
        start = struct.unpack(f"{order}I", entry[8:])[0]
        raw = entry[8:] if size * number <= 4 else data[start : start + size * number]
        if kind == 2:
            found[tag] = raw[:number].rstrip(b"\0").decode()
        else:
            found[tag] = struct.unpack(f"{order}{number}{letter}", raw[: size * number])
    return found


@pytest.fixture(scope="module")
def height_map():
    """Two rows of three cells of 0.25, whose outer corner is at (-7.5, 11)."""
    colors = np.zeros((2, 3, 4), dtype=np.uint8)
    colors[0, 1] = (10, 20, 30, 255)
    return HeightMap(
        height=np.array([[1.5, 2.5, np.nan], [3.5, 4.5, 5.5]], dtype=np.float32),
        colors=colors,
        resolution=0.25,
        west=-7.5,
        north=11.0,
        max_gap=0.75,
        origin=np.array([[1, 1, 0], [1, 2, 1]], dtype=np.uint8),
    )


def test_a_map_names_the_package_that_it_lacks(height_map, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tifffile", None)
    words = r"^writing GeoTIFF needs the package tifffile: pip install '\.\[inspect\]'"
    with pytest.raises(MissingPackageError, match=words):
        write_height_tiff(height_map, tmp_path / "h.tif", "local", "metre")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unit", ["metre", "scale arbitrary"])
@pytest.mark.parametrize(
    "write", [write_height_tiff, write_color_tiff, write_origin_tiff]
)
def test_a_map_declares_its_scale_place_and_unit(height_map, tmp_path, unit, write):
    """Tags and keys by the GeoTIFF standard (OGC 19-008r4)."""
    tifffile = pytest.importorskip("tifffile")
    path = tmp_path / "map.tif"
    write(height_map, path, "local frame", unit)
    tags = tags_of(path)
    assert tags[33550] == (0.25, 0.25, 0.0)  # ModelPixelScale
    # ModelTiepoint: the raster's corner is at the world's place.
    assert tags[33922] == (0.0, 0.0, 0.0, -7.5, 11.0, 0.0)
    version, *_, count = tags[34735][:4]
    assert version == 1 and len(tags[34735]) == 4 + 4 * count
    keys = {
        tags[34735][i]: tags[34735][i + 1 : i + 4] for i in range(4, 4 + 4 * count, 4)
    }
    assert keys[1024] == (0, 1, 32767)  # a model of its own
    assert keys[1025] == (0, 1, 1)  # pixels are areas
    where, size, start = keys[1026]
    citation = tags[34737][start : start + size]
    assert where == 34737 and citation == f"local frame, unit: {unit}|"
    # ProjLinearUnits: 9001 is the metre; no other unit is declared as one.
    assert keys.get(3076) == ((0, 1, 9001) if unit == "metre" else None)
    assert (tags.get(42113) == "nan") == (write is write_height_tiff)
    pixels = tifffile.imread(path)
    if write is write_height_tiff:
        np.testing.assert_array_equal(pixels, height_map.height)
    elif write is write_origin_tiff:
        np.testing.assert_array_equal(pixels, height_map.origin)
    else:
        assert pixels.shape == (2, 3, 4) and list(pixels[0, 1]) == [10, 20, 30, 255]
        assert tags[338] == (2,)  # alpha that colours were not multiplied by


def test_a_run_that_was_stopped_is_told_from_a_result_that_lost_its_model(tmp_path):
    (tmp_path / WORK).mkdir()
    with pytest.raises(InputError, match="no result yet: its run was stopped"):
        read_model(tmp_path)
    (tmp_path / SUMMARY).write_text("{}")
    with pytest.raises(InputError, match="sparse: no such COLMAP model folder"):
        read_model(tmp_path)
    (tmp_path / SUMMARY).unlink()
    (tmp_path / WORK).rmdir()
    with pytest.raises(InputError, match="sparse: no such COLMAP model folder"):
        read_model(tmp_path)
