"""Meshes: on the floor, with its holes, and as other libraries read them."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_map import HOLE, RELIEF, SPACING, WORLD_FROM_FLOOR, floor_cloud

from uwsfm._base.ply import read_vertices
from uwsfm.cloud import write_cloud
from uwsfm.errors import InputError, MissingPackageError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.surface.commands import mesh_cloud
from uwsfm.surface.mesh import make_mesh

trimesh = pytest.importorskip("trimesh")


@pytest.fixture(scope="module")
def floor(open3d):
    return floor_cloud(np.random.default_rng(7))


@pytest.mark.parametrize("method", ["poisson", "ball-pivoting"])
def test_surface_is_the_floor_and_its_hole_stays(floor, method):
    mesh, reach = make_mesh(floor, method, 2.5 * SPACING, None)
    in_floor = rigid3.transform(rigid3.inverse(WORLD_FROM_FLOOR), mesh.vertices)
    miss = in_floor[:, 2] - RELIEF.depth(in_floor[:, :2])
    # Ball pivoting keeps the points; Poisson smooths over about a spacing, whose square
    # / 2 times the curvature of 1/m (root mean square) is 0.2 mm, and rounds the rim.
    limit = 1e-9 if method == "ball-pivoting" else 0.0005
    assert np.sqrt(np.median(miss**2)) < limit
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    places = np.concatenate([mesh.vertices, middles])
    # Nothing is invented: by a tree of its own.
    assert cKDTree(floor.points).query(places)[0].max() <= reach
    distance = np.linalg.norm(in_floor[:, :2] - [0.6, 0.3], axis=1)
    assert distance.min() > HOLE - reach
    flat = 2.0 * 1.4 - np.pi * HOLE**2
    # Slopes of 0.05 / 0.3 add 3 % to the area; rims come off, or reach out a little.
    rim = 2.0 * (2.0 + 1.4) + 2.0 * np.pi * HOLE
    assert 0.9 * flat < mesh.area() < 1.03 * flat + rim * reach
    # Triangles look up into the water.
    up = rigid3.rotate(WORLD_FROM_FLOOR, np.array([[0.0, 0.0, -1.0]]))[0]
    assert np.mean(mesh.normals @ up > 0.5) > 0.99
    # Colours tell x and y.
    shown = mesh.colors[:, :2] / 100.0 - [1.0, 0.7]
    assert np.median(np.abs(shown - in_floor[:, :2])) < 0.5 * SPACING


def test_other_libraries_read_the_files(floor, open3d, tmp_path: Path):
    write_cloud(floor, tmp_path / "cloud.ply")
    report = mesh_cloud(
        tmp_path / "cloud.ply", tmp_path / "mesh", web_triangles=1000, max_distance=0.06
    )
    folder = tmp_path / "mesh"
    assert json.loads((folder / "mesh.json").read_text()) == report
    assert report["web"]["num_triangles"] <= 1000 < report["mesh"]["num_triangles"]
    assert report["mesh"]["farthest_from_points"] <= report["max_distance"]
    ply = open3d.t.io.read_triangle_mesh(str(folder / "mesh.ply"))
    vertices = ply.vertex.positions.numpy()
    triangles = ply.triangle.indices.numpy()
    colors = np.rint(255 * ply.vertex.colors.numpy()).astype(np.uint8)
    assert len(triangles) == report["mesh"]["num_triangles"]
    assert read_vertices(folder / "mesh.ply")[1] == ["unit: metre; uwsfm mesh"]

    obj = trimesh.load(folder / "mesh.obj", process=False)
    np.testing.assert_allclose(obj.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(obj.faces, triangles)
    np.testing.assert_array_equal(obj.visual.vertex_colors[:, :3], colors)

    scene = trimesh.load(folder / "mesh.glb", process=False)
    (node,) = scene.graph.nodes_geometry
    transform, name = scene.graph[node]
    local = scene.geometry[name]
    np.testing.assert_array_equal(local.faces, triangles)
    in_gltf = local.vertices @ transform[:3, :3].T + transform[:3, 3]
    # +Y is up in glTF: normals point there; and nothing is mirrored.
    assert np.linalg.det(transform[:3, :3]) == pytest.approx(1.0)
    normals = local.vertex_normals @ transform[:3, :3].T
    assert np.mean(normals[:, 1]) > 0.9
    pose = scene.metadata.get("world_from_gltf") or _asset(folder)["world_from_gltf"]
    world_from_gltf = np.array(pose["rotation_xyzw"] + pose["translation_m"])
    # Single precision of 1 m.
    np.testing.assert_allclose(
        rigid3.transform(world_from_gltf, in_gltf), vertices, atol=1e-6
    )
    # Colours are linear in glTF: 100 of 255 in sRGB is 0.127 of the light.
    stored = np.asarray(local.visual.vertex_attributes["color"])
    linear = stored[:, 0] / np.iinfo(stored.dtype).max
    expected = ((colors[:, 0] / 255.0 + 0.055) / 1.055) ** 2.4
    bright = colors[:, 0] > 40
    np.testing.assert_allclose(linear[bright], expected[bright], atol=1 / 254)
    web = trimesh.load(folder / "web.glb", process=False)
    assert sum(len(g.faces) for g in web.geometry.values()) <= 1000


def _asset(folder: Path) -> dict:
    """``asset.extras`` of a GLB: its first chunk is JSON."""
    data = (folder / "mesh.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length])["asset"]["extras"]


def test_what_cannot_be_a_mesh_ends_in_one_sentence(floor, monkeypatch):
    with pytest.raises(UwsfmError, match="no surface lies within 1e-06"):
        make_mesh(floor.select(np.arange(200)), "poisson", 1e-6, None)
    with pytest.raises(InputError, match="poisson, ball-pivoting"):
        make_mesh(floor, "delaunay", None, None)
    bare = floor.select(np.arange(100))
    bare.normals[3] = np.nan
    with pytest.raises(InputError, match="without normals, and no cameras"):
        make_mesh(bare, "poisson", None, None)
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(MissingPackageError, match=r"a mesh needs.*\.\[inspect\]"):
        make_mesh(floor, "poisson", None, None)
