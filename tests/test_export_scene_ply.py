"""The PLY with cameras, as a reader of its own sees it, and as Open3D does."""

import numpy as np
import pycolmap
import pytest
from sfm_scenes import model_of

import uwsfm
from uwsfm.colmap.model import Model
from uwsfm.export.scene_ply import camera_lines, export_scene_ply
from uwsfm.geometry import rigid3
from uwsfm.simulate import ObservationOptions, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion

COLOR = np.array([1, 2, 3], dtype=np.uint8)


@pytest.fixture(scope="module")
def model() -> Model:
    rig = paper_rig()
    options = ObservationOptions(num_points=80, noise_px=0.3)
    return model_of(rig, simulate_scene(rig, rich_motion(3), None, options).scene)


def read_ply(path) -> dict[str, np.ndarray]:
    head, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    elements: list[tuple[str, int, list]] = []
    for line in head.decode().splitlines():
        word, *rest = line.split()
        if word == "element":
            elements.append((rest[0], int(rest[1]), []))
        elif word == "property":
            elements[-1][2].append((rest[1], kinds[rest[0]]))
    found = {}
    for name, count, fields in elements:
        found[name] = np.frombuffer(body, dtype=fields, count=count)
        body = body[found[name].nbytes :]
    assert body == b""
    return found


def test_file_holds_points_then_cameras_joined_by_edges(model, tmp_path):
    export_scene_ply(model, tmp_path / "scene.ply")
    found = read_ply(tmp_path / "scene.ply")
    xyz = np.stack([found["vertex"][axis] for axis in "xyz"], axis=1)
    count = model.scene.num_points
    np.testing.assert_allclose(xyz[:count], model.scene.points, rtol=1e-6)
    rgb = [found["vertex"][name][:count] for name in ("red", "green", "blue")]
    np.testing.assert_array_equal(np.stack(rgb, axis=1), model.colors)
    edges = np.stack([found["edge"]["vertex1"], found["edge"]["vertex2"]], axis=1)
    assert edges.min() >= count  # no edge touches a point
    assert edges.max() < len(xyz)
    # Every camera's centre is a vertex.
    for c in range(2):
        poses = rigid3.compose(model.scene.cam_from_rig[c], model.scene.rig_from_world)
        for center in rigid3.inverse(poses)[:, 4:]:
            assert np.min(np.linalg.norm(xyz[count:] - center, axis=1)) < 1e-6


def test_frusta_follow_the_water_rays(model):
    """A corner's line ends on its water ray; the outline lies on the port."""
    camera = model.scene.cameras[0]
    lines = camera_lines(camera, 0.5, COLOR)
    origins, dirs = camera.ray_from_img([[camera.width, camera.height]])
    distance = np.linalg.norm(lines.vertices - (origins + 0.5 * dirs), axis=1)
    assert distance.min() < 1e-12
    normal, depth = np.array(camera.port.normal), camera.port.distance
    outline = lines.vertices[(lines.colors == 255).all(axis=1)]
    np.testing.assert_allclose(
        outline @ normal, depth + camera.port.thickness, atol=1e-15
    )


def test_open3d_reads_points_and_lines(model, tmp_path, open3d):
    export_scene_ply(model, tmp_path / "scene.ply")
    found = read_ply(tmp_path / "scene.ply")
    cloud = open3d.io.read_point_cloud(str(tmp_path / "scene.ply"))
    assert len(cloud.points) == len(found["vertex"])
    lines = open3d.io.read_line_set(str(tmp_path / "scene.ply"))
    edges = np.stack([found["edge"]["vertex1"], found["edge"]["vertex2"]], axis=1)
    np.testing.assert_array_equal(np.asarray(lines.lines), edges)


def test_trimesh_reads_it_as_colours_of_edges_are_left_out(model, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    export_scene_ply(model, tmp_path / "scene.ply")
    found = read_ply(tmp_path / "scene.ply")
    assert found["edge"].dtype.names == ("vertex1", "vertex2")
    cloud = trimesh.load(tmp_path / "scene.ply")
    xyz = np.stack([found["vertex"][axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(np.asarray(cloud.vertices), xyz)
    export_scene_ply(model, tmp_path / "colours.ply", edge_colors=True)
    edges = read_ply(tmp_path / "colours.ply")["edge"]
    assert edges.dtype.names == ("vertex1", "vertex2", "red", "green", "blue")
    assert {tuple(row) for row in edges[["red", "green", "blue"]].tolist()} > {
        (255, 255, 255)
    }


def test_never_over_a_file(model, tmp_path):
    (tmp_path / "scene.ply").write_text("mine")
    with pytest.raises(uwsfm.InputError, match=r"scene.ply exists already"):
        export_scene_ply(model, tmp_path / "scene.ply")
    assert (tmp_path / "scene.ply").read_text() == "mine"


def test_pixels_without_a_ray_leave_gaps_not_nan():
    """At d = 0 a lens of 100 degrees sees beyond the critical angle of its corners."""
    lens = pycolmap.Camera(
        model="OPENCV_FISHEYE",
        width=800,
        height=600,
        params=[250, 250, 400, 300, 0, 0, 0, 0],
    )
    camera = uwsfm.RefractiveCamera(lens, uwsfm.FlatPort())
    lines = camera_lines(camera, 0.3, COLOR)
    assert np.isfinite(lines.vertices).all()
    assert lines.edges.max() < len(lines.vertices)
