"""Photographs on meshes: at their place, of the best images, behind nothing."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from sfm_scenes import model_of, simulated_dive

from uwsfm.geometry import rigid3
from uwsfm.simulate.rigs import sample_rig
from uwsfm.surface.atlas import Atlas, make_atlas
from uwsfm.surface.level import level_by_axis
from uwsfm.surface.mesh import Mesh
from uwsfm.surface.mesh_files import write_textured_glb
from uwsfm.surface.texture import make_texture, texel_size

pytest.importorskip("open3d")
pytest.importorskip("xatlas")

GAINS = np.array([1.0, 0.7, 1.3, 0.9])
"""Of the frames: exposures that change."""
SCREEN_COLOR = (250, 10, 10)


def painted(points):
    """Colours (N, 3) RGB of places (N, 3): waves that no channel shares, three grey
    levels a pixel steep."""
    x, y, _ = points.T
    waves = [np.sin(60.0 * x), np.sin(50.0 * y), np.sin(40.0 * x - 45.0 * y)]
    return 110.0 + 40.0 * np.stack(waves, axis=1)


def square(center, half, depth, colors, count=12):
    """A grid of triangles that faces the cameras, which look along z."""
    side = np.linspace(-half, half, count)
    x, y = np.meshgrid(side + center[0], side + center[1])
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
    a = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    first = np.stack([a, a + count, a + 1], axis=1)
    second = np.stack([a + 1, a + count, a + count + 1], axis=1)
    return Mesh(
        vertices=vertices,
        triangles=np.concatenate([first, second]),
        normals=np.tile([0.0, 0.0, -1.0], (len(vertices), 1)),
        colors=np.tile(np.array(colors, dtype=np.uint8), (len(vertices), 1)),
    )


def joined(one: Mesh, two: Mesh) -> Mesh:
    return Mesh(
        vertices=np.concatenate([one.vertices, two.vertices]),
        triangles=np.concatenate([one.triangles, two.triangles + len(one.vertices)]),
        normals=np.concatenate([one.normals, two.normals]),
        colors=np.concatenate([one.colors, two.colors]),
    )


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """Four frames over a painted floor, with a red screen before a part of it; pixels
    are traced exactly through the ports."""
    folder = tmp_path_factory.mktemp("photographs")
    model = model_of(sample_rig(), simulated_dive(num_frames=4, num_points=200).truth)
    scene = model.scene
    depth = float(np.median(scene.points[:, 2]))
    middle = np.median(scene.points, axis=0)
    floor = square(middle, 0.5, depth, (1, 2, 3))
    screen = square(middle, 0.06, depth - 0.1, SCREEN_COLOR)
    for frame, gain in enumerate(GAINS):
        for camera, lens in enumerate(scene.cameras):
            pose = rigid3.compose(
                scene.cam_from_rig[camera], scene.rig_from_world[frame]
            )
            back = rigid3.inverse(pose)
            x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
            xy = np.column_stack([x.ravel(), y.ravel()]) + 0.5
            origins, dirs = lens.ray_from_img(xy)
            origins, dirs = rigid3.transform(back, origins), rigid3.rotate(back, dirs)

            def met(z, origins=origins, dirs=dirs):
                return origins + ((z - origins[:, 2]) / dirs[:, 2])[:, None] * dirs

            colors = gain * painted(met(depth))
            before = np.abs(met(depth - 0.1)[:, :2] - middle[:2]).max(axis=1) < 0.06
            colors[before] = SCREEN_COLOR
            image = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
            path = folder / model.image_name(camera, frame)
            path.parent.mkdir(exist_ok=True)
            path = path.with_suffix(".png")
            image = image.reshape(lens.height, lens.width, 3)
            cv2.imwrite(str(path), image[..., ::-1])
    names = tuple(Path(name).with_suffix(".png").name for name in model.frame_names)
    return replace(model, frame_names=names), folder, floor, screen


def texels_of(atlas: Atlas, image: np.ndarray) -> np.ndarray:
    return image.reshape(-1, 3)[atlas.texel].astype(np.float64)


def test_an_atlas_is_the_mesh_laid_flat():
    """Every texel's place on the mesh is where its picture coordinates say, and a texel
    is as large as it was asked for."""
    mesh = square((1000.0, -3.0), 0.5, 2.0, (10, 20, 30))
    bent = replace(mesh, vertices=mesh.vertices + [0.0, 0.0, 0.0])
    bent.vertices[:, 2] += 0.2 * np.sin(3.0 * bent.vertices[:, 0])
    atlas = make_atlas(bent, 0.01, 4096)
    corners = atlas.mesh.triangles[atlas.triangle]
    places = atlas.uv[corners].astype(np.float64) * atlas.size
    middles = np.stack([atlas.texel % atlas.size[0], atlas.texel // atlas.size[0]], 1)
    for k in range(3):  # a mesh corner lies where its place in the picture is
        offset = places[:, k] - (middles + 0.5)
        steps = atlas.mesh.vertices[corners[:, k]] - atlas.points
        lengths = np.linalg.norm(steps, axis=1)
        # Texels at an edge may lie beyond it by one; a chart hardly stretches.
        assert np.abs(lengths - 0.01 * np.linalg.norm(offset, axis=1)).max() < 0.012
    area = len(atlas.texel) * 0.01**2
    assert area == pytest.approx(bent.area(), rel=0.1)  # the rims are drawn whole
    assert (atlas.colors == [10, 20, 30]).all()
    np.testing.assert_allclose(np.linalg.norm(atlas.normals, axis=1), 1.0)
    assert (atlas.normals[:, 2] < 0.0).all()
    small = make_atlas(bent, 0.001, 64)
    assert max(small.size) <= 64 * 1.5  # packed as well as it goes


def test_texels_have_the_colours_of_the_floor_and_not_of_what_hides_it(dive):
    model, folder, floor, screen = dive
    mesh = joined(floor, screen)
    atlas = make_atlas(mesh, texel_size(model), 1024)
    texture = make_texture(atlas, mesh, model, folder)
    found = texels_of(atlas, texture.image)
    seen = (found != atlas.colors).any(axis=1)
    assert texture.share_seen == pytest.approx(np.mean(seen), abs=0.02)
    assert texture.num_images == 8
    of_floor = atlas.points[:, 2] > screen.vertices[:, 2].max() + 0.05
    wanted = painted(atlas.points)
    some = of_floor & seen
    # Gains are known up to a common one: their geometric mean is one.
    factor = np.exp(np.mean(np.log(GAINS)))
    miss = found[some] - factor * wanted[some]
    # Rounding of one image after another; a shift by a pixel makes it 1.6.
    assert np.median(np.abs(miss), axis=0).max() < 0.4
    rim = np.abs(miss).max(axis=1) > 12.0  # beside the screen pixels mix both
    assert np.mean(rim) < 0.01
    # The screen itself is red, and none of the floor behind it.
    on_screen = found[~of_floor & seen]
    assert np.median(np.abs(on_screen - SCREEN_COLOR * np.array(factor))) < 60.0
    assert np.mean(found[some][:, 0] > 200.0) < 0.005
    assert not (on_screen[:, 1] > 100.0).mean() > 0.05


def test_what_no_image_sees_has_the_colours_of_the_cloud(dive):
    model, folder, floor, _ = dive
    away = replace(floor, vertices=floor.vertices + [50.0, 0.0, 0.0])
    atlas = make_atlas(away, 0.02, 256)
    texture = make_texture(atlas, away, model, folder)
    assert texture.share_seen == 0.0
    assert (texels_of(atlas, texture.image) == (1, 2, 3)).all()


def test_a_textured_glb_is_read_by_another_program(dive, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    _, _, floor, _ = dive
    atlas = make_atlas(floor, 0.02, 256)
    width, height = atlas.size
    row = np.linspace(0, 255, width).astype(np.uint8)
    image = np.stack([np.tile(row, (height, 1))] * 3, axis=-1)
    path = tmp_path / "textured.glb"
    write_textured_glb(atlas, image, path, level_by_axis("-z"), "metre")
    (mesh,) = trimesh.load(path, process=False).geometry.values()
    assert len(mesh.faces) == len(floor.triangles)
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert picture.shape == (height, width, 3)
    assert np.abs(picture.astype(int) - image).mean() < 3.0  # JPEG
    # trimesh counts v from below.
    uv = np.column_stack([mesh.visual.uv[:, 0], 1.0 - mesh.visual.uv[:, 1]])
    np.testing.assert_allclose(uv, atlas.uv, atol=1e-6)
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    assert "COLOR_0" not in document["meshes"][0]["primitives"][0]["attributes"]
    assert document["images"][0]["mimeType"] == "image/jpeg"
