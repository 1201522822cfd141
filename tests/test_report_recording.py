"""Recordings for Rerun: geometry, and what is in the file."""

import subprocess
import sys

import numpy as np
import pytest
from test_mixed_ports import DOME, mixed_rig

from uwsfm import RefractiveCamera
from uwsfm.errors import MissingPackageError
from uwsfm.report.recording import port_mesh, ray_lines, write_recording


def cameras():
    flat, dome, _ = mixed_rig().refractive_cameras()
    return flat, dome


def test_port_meshes_lie_on_the_outer_surfaces():
    flat, dome = cameras()
    vertices, triangles = port_mesh(flat)
    depth = vertices @ flat.port.normal
    np.testing.assert_allclose(depth, flat.port.distance + flat.port.thickness)
    assert triangles.max() < len(vertices)
    vertices, triangles = port_mesh(dome)
    radii = np.linalg.norm(vertices - dome.port.center, axis=1)
    np.testing.assert_allclose(radii, DOME.radius + DOME.thickness)
    # Seen from the camera, all triangles turn the same way: none is folded over.
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.sum(normals * corners[:, 0], axis=1) > 0.0)


@pytest.mark.parametrize("camera", cameras(), ids=["flat", "dome"])
def test_rays_bend_at_the_port_and_end_at_their_points(camera: RefractiveCamera, rng):
    points = rng.uniform([-0.5, -0.5, 1.0], [0.5, 0.5, 2.0], (40, 3))
    xy, valid = camera.img_from_point(points)
    lines = np.array(ray_lines(camera, xy[valid], points[valid]))
    np.testing.assert_allclose(lines[:, 2], points[valid], atol=1e-8)
    inside, outside = lines[:, 1] - lines[:, 0], lines[:, 2] - lines[:, 1]
    sine = np.linalg.norm(np.cross(inside, outside), axis=1)
    sine /= np.linalg.norm(inside, axis=1) * np.linalg.norm(outside, axis=1)
    assert np.all(sine > 1e-4)  # off the axes of both ports


def test_a_missing_rerun_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingPackageError, match=r"rerun-sdk.*\.\[rerun\]"):
        write_recording(tmp_path)


@pytest.mark.slow  # the program that reads recordings takes seconds to start
def test_a_recording_has_the_rig_the_rays_and_the_cloud(dive_result):
    pytest.importorskip("rerun")
    path = write_recording(dive_result.out)
    found = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(path)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    for entity in (
        "world/points",
        "world/trajectory",
        "world/left/port",
        "world/right/frustum",
        "world/left/rays",
        "images/left/observations",
    ):
        assert entity in found
