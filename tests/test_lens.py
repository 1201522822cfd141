"""In-air lenses: equal to COLMAP's, and honest about where they end."""

import numpy as np
import pycolmap
import pytest
from jacobians import (
    CAMERA_IDS,
    EXAMPLE_CAMERAS,
    camera_from_line,
    central_differences,
)

from uwsfm import FlatPort, InputError, RefractiveCamera, Status
from uwsfm.models.lens import (
    ANGLE_KINDS,
    SUPPORTED_MODELS,
    dir_from_img,
    distort,
    img_from_dir,
    lens_row,
)

EXAMPLES = pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)

# No port at all: equal indices, so only the lens is left.
NO_PORT = FlatPort(distance=0.0, thickness=0.0, n_glass=1.0, n_water=1.0)

EVERY_OTHER_MODEL = [
    "SIMPLE_FISHEYE 800 600 400 400 300",
    "FISHEYE 800 600 400 401 400 300",
    "RAD_TAN_THIN_PRISM_FISHEYE 800 600 400 401 400 300 .01 0 0 0 0 0 0 0 0 0 0 0",
    "SIMPLE_DIVISION 800 600 400 400 300 -0.05",
    "DIVISION 800 600 400 401 400 300 -0.05",
]


FISHEYES = ("OPENCV_FISHEYE", "FOV")


def pixel_grid(camera, count=15):
    """The whole image; of a fisheye, whose corners are behind it, up to 76 degrees."""
    low, high = (0.15, 0.85) if camera.model_name in FISHEYES else (0.0, 1.0)
    share = np.linspace(low, high, count)
    grid = np.meshgrid(camera.width * share, camera.height * share)
    return np.stack(grid, axis=-1).reshape(-1, 2)


def dirs_from_img(xy, lens):
    return np.array([dir_from_img(x, y, lens) for x, y in xy])


def img_from_dirs(dirs, lens):
    return np.array([img_from_dir(*row, lens)[:2] for row in dirs])


def test_the_examples_cover_every_model():
    assert {camera.model_name for camera in EXAMPLE_CAMERAS} == set(SUPPORTED_MODELS)


@EXAMPLES
def test_pixels_are_those_of_colmap(camera, rng):
    lens = lens_row(camera.model_name, camera.params)
    dirs = dirs_from_img(pixel_grid(camera), lens)
    assert np.isfinite(dirs).all()
    dirs = np.concatenate([dirs, 0.99 * dirs, [[0.0, 0.0, 2.0]]])
    expected = camera.img_from_cam(dirs)
    # Both are closed forms: a few roundings of some 3000 px. COLMAP's FOV is a series
    # of two terms within a hundredth of the focal length (measured: 1.4e-10).
    atol = 1e-9 if camera.model_name == "FOV" else 5e-12
    np.testing.assert_allclose(img_from_dirs(dirs, lens), expected, atol=atol, rtol=0)


@EXAMPLES
def test_directions_are_those_of_colmap_and_come_back(camera):
    lens = lens_row(camera.model_name, camera.params)
    xy = np.concatenate([pixel_grid(camera), [[lens[2], lens[3]]]])
    dirs = dirs_from_img(xy, lens)
    np.testing.assert_allclose(np.linalg.norm(dirs, axis=1), 1.0, rtol=1e-14)
    # Ours is solved to rounding (5e-12 px is 2e-15 of 3000 px, twice)...
    np.testing.assert_allclose(img_from_dirs(dirs, lens), xy, atol=1e-11, rtol=0)
    # ... COLMAP's undistortion stops at steps of 1e-10 (measured: 1e-9 at worst).
    np.testing.assert_allclose(
        dirs[:, :2] / dirs[:, 2:], camera.cam_from_img(xy), atol=1e-8, rtol=0
    )


@EXAMPLES
def test_lens_jacobian(camera):
    lens = lens_row(camera.model_name, camera.params)
    for ray in dirs_from_img(pixel_grid(camera, 4), lens):
        point = 1.7 * ray  # not unit: the depth column counts
        jac = np.array(img_from_dir(*point, lens)[2:]).reshape(2, 3)
        numeric = central_differences(
            lambda delta, x=point: np.array(img_from_dir(*(x + delta), lens)[:2]),
            3,
            1e-4,
        )
        # Stencil of 1e-4 on pixels rounded at 5e-13: 5e-9, times a few.
        np.testing.assert_allclose(jac, numeric, rtol=1e-8, atol=1e-6)


def _random_dirs(lens, rng, count=400):
    """Directions all over the part of a lens that it claims to invert."""
    reach = (
        np.tan(min(lens[13], 1.5))
        if lens[12] in ANGLE_KINDS
        else np.sqrt(min(lens[13], 9))
    )
    radius = reach * np.sqrt(rng.uniform(0.0, 1.0, count))
    radius[:50] = reach * (1.0 - 10.0 ** rng.uniform(-4.0, -1.0, 50))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return radius * np.cos(angle), radius * np.sin(angle)


# The distortion grows, then turns.
SWOLLEN = camera_from_line("RADIAL 1000 1000 1000 500 500 0.5 -0.3")
FOLDING_LENSES = [
    *EXAMPLE_CAMERAS,
    SWOLLEN,
    camera_from_line("SIMPLE_RADIAL 1000 1000 1000 500 500 -0.3"),
    # Tangential terms fold the image before the radial ones do.
    camera_from_line("OPENCV 1024 768 868 866 525 420 -0.4 0 0.01 0.01"),
    camera_from_line("OPENCV_FISHEYE 1000 1000 500 500 500 500 -0.3 0 0 0"),
]


@pytest.mark.parametrize("camera", FOLDING_LENSES, ids=lambda c: c.params_to_string())
def test_every_pixel_a_lens_projects_to_leads_back_to_the_one_direction(camera, rng):
    lens = lens_row(camera.model_name, camera.params)
    folded = 0
    for u, v in zip(*_random_dirs(lens, rng), strict=True):
        px, py, *_ = img_from_dir(u, v, 1.0, lens)
        if np.isnan(px):
            folded += 1
            continue
        x, y, z = dir_from_img(px, py, lens)
        # Within 1e-4 of the limit the slope is 1e-4: rounding of 1e-15 over that.
        assert abs(x / z - u) + abs(y / z - v) < 1e-9 * (1.0 + u * u + v * v)
    assert folded < 40  # of 400: only the rim, where tangential terms fold it earlier


def test_a_pixel_as_far_out_as_the_limit_itself_is_undistorted():
    """A Newton step from the pixel's own radius would start where the slope is zero."""
    lens = lens_row(SWOLLEN.model_name, SWOLLEN.params)
    for share in (0.99, 1 - 1e-4, 1 - 1e-7, 1.0, 1 + 1e-7, 1 + 1e-4, 1.05):
        radius = share * np.sqrt(lens[13])
        x, y, z = dir_from_img(500.0 + 600.0 * radius, 500.0 + 800.0 * radius, lens)
        back = img_from_dir(x, y, z, lens)[:2]
        np.testing.assert_allclose(
            back, 500.0 + radius * np.array([600, 800]), atol=1e-9
        )


def test_beyond_the_turning_point_of_a_barrel_lens_there_is_no_answer():
    camera = camera_from_line("SIMPLE_RADIAL 1000 1000 1000 500 500 -0.3")
    lens = lens_row(camera.model_name, camera.params)
    limit = 1.0 / np.sqrt(0.9)  # 1 - 3 * 0.3 r^2 = 0
    assert lens[13] == pytest.approx(limit**2, rel=1e-12)
    rim = 500.0 + 1000.0 * limit * (1.0 - 0.3 * limit**2)  # the farthest pixel

    both = RefractiveCamera(camera, NO_PORT)
    # At 2.5 the lens has turned the image over, twice: there its Jacobian looks sound.
    points = np.array([[0.99 * limit, 0, 1], [1.01 * limit, 0, 1], [2.5, 0, 1]])
    xy, valid = both.img_from_point(points)
    # COLMAP gives them the pixels of false, second rays.
    assert valid.tolist() == [True, False, False] and np.isnan(xy[1:]).all()
    assert np.isfinite(camera.img_from_cam(points)).all()
    assert both.status_from_point(points)[1:].tolist() == [Status.OUTSIDE_LENS] * 2

    pixels = np.array([[rim - 0.1, 500.0], [rim + 0.1, 500.0]])
    assert both.status_from_img(pixels).tolist() == [Status.VALID, Status.OUTSIDE_LENS]
    assert np.isnan(both.ray_from_img(pixels)[0][1]).all()


def test_a_rational_lens_ends_at_its_pole_and_a_fisheye_at_90_degrees():
    rational = lens_row("FULL_OPENCV", [500, 500, 0, 0, 0, 0, 0, 0, 0, -0.5, 0, 0])
    assert rational[13] == pytest.approx(2.0)  # 1 - 0.5 s = 0
    assert np.isnan(distort(1.5, 0.0, rational)[0])
    fisheye = lens_row("OPENCV_FISHEYE", [500, 500, 0, 0, 0, 0, 0, 0])
    assert fisheye[13] == pytest.approx(np.pi / 2)
    assert np.isnan(dir_from_img(500 * 1.58, 0.0, fisheye)).all()
    assert np.isfinite(dir_from_img(500 * 1.57, 0.0, fisheye)).all()
    for lens in (rational, fisheye):
        assert np.isnan(img_from_dir(0.1, 0.1, -1.0, lens)[0])


def test_every_other_model_unprojects_and_is_refused_for_projection(rng):
    listed = {line.split()[0] for line in EVERY_OTHER_MODEL}
    everything = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    # EQUIRECTANGULAR is a panorama: it has no lens to put behind a port.
    assert everything - {"EQUIRECTANGULAR"} == listed | set(SUPPORTED_MODELS)
    for line in EVERY_OTHER_MODEL:
        camera = camera_from_line(line)
        refractive = RefractiveCamera(camera, NO_PORT)
        xy = np.array([[400.0, 300.0], [500.0, 200.0], [np.nan, 0.0]])
        _, dirs = refractive.ray_from_img(xy)
        in_air = np.array([camera.cam_ray_from_img(row) for row in xy[:2]])
        np.testing.assert_allclose(dirs[:2], in_air, atol=1e-15, err_msg=line)
        assert refractive.status_from_img(xy)[2] == Status.NOT_FINITE
        for method in (refractive.img_from_point, refractive.img_from_point_with_jac):
            with pytest.raises(InputError, match=camera.model_name):
                method([[0, 0, 1]])


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("PINHOLE", [500, 500, 320]),
        ("PINHOLE", [500, np.nan, 320, 240]),
        ("SIMPLE_PINHOLE", [0.0, 320, 240]),
        ("OPENCV", [500, -500, 320, 240, 0, 0, 0, 0]),
        ("FISHBOWL", [1.0]),
        ("FOV", [300, 300, 320, 240, 0.0]),
        ("FOV", [300, 300, 320, 240, 3.2]),
        ("EUCM", [300, 300, 320, 240, -0.1, 1.0]),
        ("EUCM", [300, 300, 320, 240, 0.5, 0.0]),
    ],
)
def test_unusable_parameters_are_refused_with_the_model_named(model, params):
    with pytest.raises(InputError, match=model):
        lens_row(model, params)
