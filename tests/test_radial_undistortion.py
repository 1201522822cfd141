"""A lens whose polynomial undistorts, and the COLMAP camera that stands in for it."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from uwsfm.errors import InputError
from uwsfm.models.lens import dir_from_img, lens_row
from uwsfm.models.radial_undistortion import convert_radial_undistortion
from uwsfm.results.summary import housing_summary
from uwsfm.rig.file import dump_rig, load_rig, template
from uwsfm.rig.rig import camera_from_colmap

LENSES = {
    "mild": ((1200, 900), (1000, 1000, 600, 450), (0.08, -0.02)),
    "strong barrel": ((800, 600), (600, 600, 400, 300), (0.25, 0.10)),
    "pincushion": ((800, 600), (600, 600, 400, 300), (-0.25,)),
    "weak": ((800, 600), (600, 600, 400, 300), (0.01,)),
    "off centre": ((800, 600), (610, 580, 330.25, 340.5), (0.2, -0.05, 0.03)),
}


def undistorted_dirs(xy, pinhole, undistortion):
    """Unit rays (N, 3) by the paper's convention, word for word."""
    fx, fy, cx, cy = pinhole
    k1, k2, k3 = (*undistortion, 0, 0)[:3]
    dirs = []
    for px, py in xy:
        x, y = (px - cx) / fx, (py - cy) / fy
        r2 = x * x + y * y
        factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        dirs.append([x * factor, y * factor, 1.0])
    return np.array(dirs) / np.linalg.norm(dirs, axis=1, keepdims=True)


def pixel_grid(size, num):
    """Rows (num^2, 2) over the whole image, its corners included."""
    axes = [np.linspace(0, side, num) for side in size]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES)
def test_the_reported_error_is_the_true_one(lens):
    size, pinhole, undistortion = LENSES[lens]
    found = convert_radial_undistortion(*size, pinhole, undistortion)
    camera = camera_from_colmap(found.model, *size, found.params)
    xy = pixel_grid(size, 260)  # other pixels than the conversion measures
    projected = camera.img_from_cam(undistorted_dirs(xy, pinhole, undistortion))
    errors = np.linalg.norm(projected - xy, axis=1)
    # Both grids hold the corners and miss a few per mille of the peaks between.
    assert errors.max() == pytest.approx(found.max_px, rel=5e-3)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(found.rms_px, rel=1e-2)
    assert found.rms_px < found.max_px < 0.01


@pytest.mark.parametrize("lens", LENSES)
def test_rays_are_those_of_the_polynomial(lens):
    """COLMAP's rays and ours: the converted lens inverts up to the corners."""
    size, pinhole, undistortion = LENSES[lens]
    found = convert_radial_undistortion(*size, pinhole, undistortion)
    xy = pixel_grid(size, 30)
    truth = undistorted_dirs(xy, pinhole, undistortion)
    camera = camera_from_colmap(found.model, *size, found.params)
    row = lens_row(found.model, found.params)
    # A pixel is an angle of at most 1/f: what undistorting stretches, obliquity undoes.
    # 1e-10: COLMAP ends its iteration there.
    allowed = found.max_px / min(pinhole[:2]) + 1e-10
    for dirs in (
        camera.cam_ray_from_img(xy),
        np.array([dir_from_img(*pixel, row) for pixel in xy]),
    ):
        assert np.max(np.linalg.norm(dirs - truth, axis=1)) <= allowed


def test_no_distortion_is_the_pinhole():
    pinhole = (600.0, 610.0, 400.0, 300.0)
    found = convert_radial_undistortion(800, 600, pinhole, [0.0, 0.0, 0.0])
    assert found.params == (*pinhole, 0.0, 0.0, 0.0, 0.0)
    assert (found.model, found.max_px, found.rms_px) == ("OPENCV", 0.0, 0.0)


def test_weak_distortion_needs_no_more_than_opencv():
    found = convert_radial_undistortion(*LENSES["weak"][0], *LENSES["weak"][1:])
    assert found.model == "OPENCV"
    # 1 / (1 + k r_d^2) = 1 - k r_u^2 + O(k^2)
    assert found.params[4] == pytest.approx(-0.01, rel=0.02)


@pytest.mark.parametrize(
    "undistortion,sentence",
    [
        ([], "has 1 to 3 values, got 0"),
        ([0.1, 0.0, 0.0, 0.0], "has 1 to 3 values, got 4"),
        # 1 - 3 * 0.6 r^2 = 0 at 0.745; the corner is at hypot(400, 300) / 600.
        ([-0.6], r"shrinks again 0\.74\d focal lengths .* corner is at 0\.833$"),
        # Grows, but so slowly at the corner that no rational function inverts it.
        ([-0.475], r"no COLMAP model follows .* to 0\.1 px .* is off by \d\.\d px$"),
        ([1e-9 * 600**6, 0.0], "stretches the image .*-fold at its border"),
        ([1e308, 1e308], "stretches the image"),
    ],
)
def test_what_no_lens_does_is_refused(undistortion, sentence):
    with pytest.raises(InputError, match=f"^undistortion.*{sentence}"):
        convert_radial_undistortion(800, 600, (600, 600, 400, 300), undistortion)


def test_a_fold_counts_up_to_the_corner_farthest_from_the_principal_point():
    fold = (1 / (3 * 0.4)) ** 0.5 * 600  # pixels: 548
    convert_radial_undistortion(800, 600, (600, 600, 400, 300), [-0.4])  # corner: 500
    assert np.hypot(500, 300) > fold
    with pytest.raises(InputError, match="folds the image"):
        convert_radial_undistortion(800, 600, (600, 600, 300, 300), [-0.4])


# ---- In a rig file -------------------------------------------------------------------

BLOCK = {
    "width_px": 1200,
    "height_px": 900,
    "camera_matrix": [[1000, 0, 599.5], [0, 1000, 449.5], [0, 0, 1]],
    "undistortion": [0.08, -0.02],
    "pixel_origin": "opencv",
}


def load_with(folder, lens):
    """The template's rig with another lens in its second camera."""
    data = yaml.safe_load(template())
    data["cameras"][1]["intrinsics"] = lens
    (folder / "rig.yaml").write_text(yaml.safe_dump(data))
    return load_rig(folder / "rig.yaml")


def test_a_rig_file_gives_the_camera_and_its_error(tmp_path):
    lens = {"radial_undistortion": BLOCK, "valid_radius_px": 700}
    left, right = load_with(tmp_path, lens).cameras
    assert (left.conversion_max_px, left.conversion_rms_px) == (None, None)
    assert 0 < right.conversion_rms_px < right.conversion_max_px < 0.01
    assert (right.camera.width, right.camera.height) == (1200, 900)
    assert right.camera.has_prior_focal_length and right.valid_radius_px == 700
    # The paper's polynomial at one pixel: 150 px right and 300 px below the centre.
    factor = 1 + 0.08 * 0.1125 - 0.02 * 0.1125**2
    xy = right.camera.img_from_cam([[0.15 * factor, 0.3 * factor, 1]])[0]
    # The centre of the first pixel is (0, 0) in the file, (0.5, 0.5) in the camera.
    np.testing.assert_allclose(xy, [750, 750], atol=right.conversion_max_px)
    lens = {"radial_undistortion": {**BLOCK, "pixel_origin": "colmap"}}
    camera = load_with(tmp_path, lens).cameras[1].camera
    assert camera.params[2:4].tolist() == [599.5, 449.5]


def test_the_template_tells_how_to_write_it(tmp_path):
    text = template().replace(" opencv:\n", " radial_undistortion:\n")
    text = text.replace("      #   undistortion: [", "        undistortion: [")
    lines = [line for line in text.splitlines() if " distortion: [" not in line]
    (tmp_path / "rig.yaml").write_text("\n".join(lines))
    right = load_rig(tmp_path / "rig.yaml").cameras[1]
    assert right.conversion_max_px < 0.01


def test_the_error_is_told_where_results_are(tmp_path):
    rig = load_with(tmp_path, {"radial_undistortion": BLOCK})
    right = rig.cameras[1]
    path = tmp_path / "housing.yaml"
    dump_rig(rig, path, comments={"right": ["of the port"]})
    text = path.read_text()
    assert "  # of the port\n  # lens: converted from a radial undistortion, " in text
    assert text.count(f"off by at most {right.conversion_max_px:.2g} px (RMS ") == 1
    back = load_rig(path).cameras[1]
    assert back.camera.params.tolist() == right.camera.params.tolist()

    unknown = SimpleNamespace(
        normal_stddev_deg=np.nan,
        distance_stddev_m=np.nan,
        distance_at_zero=False,
        rotation_stddev_deg=np.nan,
        translation_stddev_m=[np.nan] * 3,
    )
    ports = [camera.port for camera in rig.cameras]
    calibration = SimpleNamespace(
        covariance=SimpleNamespace(
            cameras=[unknown] * 2,
            judged_cameras=[unknown] * 2,
            border_cols=np.full((2, 25), -1),
            in_all=None,
        ),
        scene=SimpleNamespace(cam_from_rig=rig.cam_from_rig, ports=ports),
        options=SimpleNamespace(refine_cam_from_rig=True),
    )
    entries = housing_summary(rig, calibration)
    keys = "lens_conversion_max_px", "lens_conversion_rms_px"
    found = [tuple(entry[key] for key in keys) for entry in entries]
    converted = right.conversion_max_px, right.conversion_rms_px
    assert found == [(None, None), converted]


WITHOUT_ORIGIN = {k: v for k, v in BLOCK.items() if k != "pixel_origin"}
WITH_DISTORTION = {("distortion" if "un" in k else k): v for k, v in BLOCK.items()}
SKEWED = [[1000, 0.3, 600], [0, 1000, 450], [0, 0, 1]]
SHEARED = [[1000, 0, 600], [0.1, 1000, 450], [0, 0, 1]]
MILLIMETRES = [[4.2, 0, 600], [0, 4.2, 450], [0, 0, 1]]
OUTSIDE = [[1000, 0, 1200], [0, 1000, 450], [0, 0, 1]]


@pytest.mark.parametrize(
    "block,sentence",
    [
        ({**BLOCK, "undistortion": [0.1] * 4}, ": undistortion has 1 to 3 values, got"),
        ({**BLOCK, "undistortion": [-0.9]}, ": undistortion folds the image"),
        ({**BLOCK, "undistortion": [-0.59]}, ": undistortion: no COLMAP model follows"),
        ({**BLOCK, "camera_matrix": SKEWED}, ": camera_matrix has a skew of 0.3"),
        ({**BLOCK, "camera_matrix": SHEARED}, ": camera_matrix is not [[fx, 0, cx]"),
        ({**BLOCK, "camera_matrix": MILLIMETRES}, ": fx = 4.2 is not the focal length"),
        ({**BLOCK, "camera_matrix": OUTSIDE}, ": cx = 1200.5 puts the principal point"),
        (WITH_DISTORTION, ".radial_undistortion.distortion: unknown key, did you mean"),
        ({**BLOCK, "fisheye": True}, ".radial_undistortion.fisheye: unknown key; the"),
        (WITHOUT_ORIGIN, ".radial_undistortion.pixel_origin: this key is missing"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_key(tmp_path, block, sentence):
    with pytest.raises(InputError) as caught:
        load_with(tmp_path, {"radial_undistortion": block})
    path = tmp_path / "rig.yaml"
    assert str(caught.value).startswith(f"{path}: cameras[1].intrinsics{sentence}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "slip,meant",
    [
        ("radial_distortion", "radial_undistortion"),
        ("undistortion", "radial_undistortion"),
        ("OpenCV", "opencv"),
    ],
)
def test_a_misspelt_block_is_recognised(tmp_path, slip, meant):
    sentence = rf"intrinsics\.{slip}: unknown key, did you mean {meant}\?$"
    with pytest.raises(InputError, match=sentence):
        load_with(tmp_path, {slip: BLOCK})
