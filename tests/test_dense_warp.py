"""The table of warps against exact projection."""

from dataclasses import replace

import numpy as np
import pytest

from uwsfm.dense.warp import Placement, depth_there, warp_table, warped
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import DomePort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.rigs import sample_rig

NEAR, FAR = 0.8, 3.0
POSE = np.array([0.02, 0.1, 0.05, 1.0, 0.2, -0.05, 0.03])
POSE[:4] /= np.linalg.norm(POSE[:4])


def cameras() -> dict[str, RefractiveCamera]:
    flat = sample_rig(image_scale=0.25).refractive_cameras()[0]
    near = replace(flat.port, distance=0.1)  # ten centimetres: far from a pinhole
    dome = DomePort(
        center=np.array([0.004, -0.003, 0.01]),
        radius=0.05,
        thickness=0.006,
        n_air=1.0,
        n_glass=1.5,
        n_water=1.34,
    )
    return {
        "flat": flat,
        "far behind glass": flat.with_port(near),
        "dome": flat.with_port(dome),
    }


def exact(camera, other, xy, inverse):
    """Pixels (N, 2), centres at integers, and inverse depths (N,) in the other."""
    origins, dirs = camera.ray_from_img(xy + 0.5)
    along = (1.0 / inverse - origins[:, 2]) / dirs[:, 2]
    there = rigid3.transform(POSE, origins + along[:, None] * dirs)
    return other.img_from_point(there)[0] - 0.5, 1.0 / there[:, 2]


@pytest.mark.parametrize("own", cameras())
@pytest.mark.parametrize("other", ["flat", "dome"])
def test_a_table_tells_where_a_neighbour_sees_the_rays(own, other, rng):
    camera, neighbour = cameras()[own], cameras()[other]
    placed = Placement(camera=neighbour, from_reference=POSE)
    table = warp_table(camera, [placed], NEAR, FAR)
    xy = rng.uniform(0.0, [camera.width - 1.0, camera.height - 1.0], (200, 2))
    inverse = rng.uniform(1.0 / FAR, 1.0 / NEAR, 200)
    truth, depth = exact(camera, neighbour, xy, inverse)
    values = np.column_stack([xy, inverse]).astype(np.float32)
    found = np.array([warped(*vars(table).values(), 0, *row) for row in values])
    # Nodes 4 px apart, of an image 200 px wide, and a range of 0.9/m in 15 steps.
    # Beyond its image nobody asks.
    size = neighbour.width, neighbour.height
    shown = np.all((truth > 0.0) & (truth < size), axis=1)
    assert np.count_nonzero(shown) > 60
    error = np.linalg.norm(found[:, :2] - truth, axis=1)[shown]
    assert np.median(error) < 0.02 and error.max() < 0.2
    there = np.array([depth_there(*vars(table).values(), 0, *row) for row in values])
    np.testing.assert_allclose(there[shown, 0], depth[shown], rtol=1e-3)
    # Derivatives, against differences of the exact projection.
    steps = (np.array([0.5, 0.0]), np.array([0.0, 0.5]), np.zeros(2))
    for index, (aside, deeper) in enumerate(zip(steps, (0, 0, 1e-3), strict=True)):
        ahead, behind = (
            exact(camera, neighbour, xy + sign * aside, inverse + sign * deeper)[0]
            for sign in (1.0, -1.0)
        )
        slope = ((ahead - behind) / (2.0 * (aside.sum() + deeper)))[shown]
        scale = np.abs(slope).max()
        np.testing.assert_allclose(
            found[shown, 2 + 2 * index : 4 + 2 * index], slope, atol=0.03 * scale
        )


def test_what_a_neighbour_does_not_see_is_unknown():
    camera = cameras()["flat"]
    behind = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # turned around
    table = warp_table(
        camera, [Placement(camera=camera, from_reference=behind)], NEAR, FAR
    )
    middle = np.float32([0.5 * camera.width, 0.5 * camera.height, 1.0 / FAR])
    assert np.isnan(warped(*vars(table).values(), 0, *middle)[0])
