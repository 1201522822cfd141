"""Clouds and their file, against Open3D's reader."""

from pathlib import Path

import numpy as np
import pytest

from uwsfm.cloud import (
    Cloud,
    read_cloud,
    read_table,
    unit_of_cloud,
    write_cloud,
)
from uwsfm.errors import InputError


def random_cloud(rng: np.random.Generator, count: int) -> Cloud:
    return Cloud(
        # Far from the origin: single precision would lose the millimetres.
        points=rng.normal(size=(count, 3)) + 4e5,
        normals=rng.normal(size=(count, 3)),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        stddev=rng.uniform(size=count),
        num_views=rng.integers(1, 9, count),
        view_range=rng.uniform(1.0, 3.0, count),
        plain=rng.random(count) < 0.5,
    )


def test_a_cloud_comes_back_from_its_file(tmp_path: Path, rng: np.random.Generator):
    cloud, path = random_cloud(rng, 100), tmp_path / "new" / "cloud.ply"
    write_cloud(cloud, path, "baseline")
    back = read_cloud(path)
    for name, values in vars(cloud).items():
        assert getattr(back, name).dtype == values.dtype
        # Only positions are stored in double precision.
        tolerance = 0.0 if name == "points" else 1e-6
        np.testing.assert_allclose(getattr(back, name), values, tolerance, 0.0)
    assert unit_of_cloud(path) == "baseline"
    assert len(back.select(back.num_views > 4)) == np.count_nonzero(back.num_views > 4)


def test_open3d_reads_the_same(tmp_path: Path, rng: np.random.Generator, open3d):
    cloud, path = random_cloud(rng, 100), tmp_path / "cloud.ply"
    write_cloud(cloud, path)
    read = open3d.t.io.read_point_cloud(str(path)).point
    np.testing.assert_array_equal(read["positions"].numpy(), cloud.points)
    np.testing.assert_array_equal(read["colors"].numpy(), cloud.colors)
    np.testing.assert_array_equal(read["num_views"].numpy()[:, 0], cloud.num_views)


def _header(*lines: str) -> bytes:
    head = ("ply", "format binary_little_endian 1.0", *lines, "end_header", "")
    return "\n".join(head).encode()


def _ascii(*lines: str) -> bytes:
    return _header(*lines).replace(b"binary_little_endian", b"ascii")


COLUMNS = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("views", "<i4")]
ROWS = [(400000.125, -2.5, 3.0, 255, -7), (1.0, 0.25, 1e-3, 0, 70000)]
PROPERTIES = ("double x", "double y", "double z", "uchar red", "int views")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("kind", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_every_kind_of_ply_gives_the_same_numbers(tmp_path, kind, end, open3d):
    """Two rows written by hand, and after them a face that is no vertex."""
    lines = ["ply", f"format {kind} 1.0", "comment unit: metre", "element vertex 2"]
    lines += [f"property {name}" for name in PROPERTIES]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    head = "".join(line + end for line in lines).encode()
    table = np.array(ROWS, dtype=COLUMNS)
    if kind == "ascii":
        body = "".join(" ".join(map(str, row)) + end for row in ROWS).encode()
        body += f"3 0 1 0{end}".encode()
    else:
        order = "<" if "little" in kind else ">"
        body = table.astype(table.dtype.newbyteorder(order)).tobytes()
        body += b"\x03" + np.array([0, 1, 0], dtype=f"{order}i4").tobytes()
    path = tmp_path / "cloud.ply"
    path.write_bytes(head + body)
    found = read_table(path)
    assert found.dtype == table.dtype
    np.testing.assert_array_equal(found, table)
    assert unit_of_cloud(path) == "metre"
    if end == "\n":  # as Open3D reads it
        points = open3d.t.io.read_point_cloud(str(path)).point["positions"].numpy()
        np.testing.assert_array_equal(read_cloud(path).points, points)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no such file"),
        (_header("element vertex many"), "expected 'element NAME COUNT'"),
        (_header("element vertex"), "expected 'element NAME COUNT'"),
        (_header("element vertex -1"), "expected 'element NAME COUNT'"),
        (_header(f"element vertex {2**63}"), "it is damaged"),
        (
            _header("element vertex 999999999999", "property float x"),
            "holds 0 of its 999999999999",
        ),
        (
            _header("element vertex 1", "property float \u00e9") + b"1234",
            "no x",
        ),
        (
            _header("element vertex 1", *["property float x"] * 2),
            "x of vertex comes tw",
        ),
        (_header("element vertex 1", "property float"), "property 'float' of vertex"),
        (_header(), "without vertices"),
        (b"ply\nformat binary_little_endian 1.0\n", "no end_header within"),
        (b"solid\n", "not a PLY file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "without vertices"),
        (b"ply\nformat text 1.0\nend_header\n", "got 'format text 1.0'"),
        (
            _ascii("element vertex 2", "property float x") + b"1\n",
            "holds 1 of its 2 vertices",
        ),
        (
            _ascii("element vertex 2", "property float x") + b"1\nnorth\n",
            "a vertex is no row of numbers",
        ),
        (
            _ascii("element vertex 1", "property uchar red") + b"256\n",
            "red of a vertex is no integer from 0 to 255",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
            b"property float x\nend_header\n0000",
            "holds 1 of its 2 vertices",
        ),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path: Path, content, message: str):
    path = tmp_path / "cloud.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
