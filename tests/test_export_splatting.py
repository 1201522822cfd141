"""Exports as trainers of radiance fields read them, by readers after their rules.

The rules are those of graphdeco's `dataset_readers.py`, of gsplat's `examples/datasets/
colmap.py` and of nerfstudio's `nerfstudio_dataparser.py`, written anew: the three need
a GPU's compiler, or gigabytes.
"""

import json
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pycolmap
import pytest
from command_line import one_sentence, run
from sfm_scenes import model_of
from test_export_pinhole import simulated, write_images

from uwsfm.colmap.model import Model
from uwsfm.errors import InputError
from uwsfm.export.pinhole import pinhole_model
from uwsfm.export.pinhole_files import export_pinhole
from uwsfm.export.trainers import image_names
from uwsfm.simulate.rigs import paper_rig

SIZE = 40


@pytest.fixture(scope="module")
def export(tmp_path_factory) -> tuple[Model, Path]:
    folder = tmp_path_factory.mktemp("splatting")
    model = simulated(0.0, num_points=300)
    # They differ after the first dot only.
    names = tuple(f"clip.{f:04}.png" for f in range(len(model.frame_names)))
    model = Model(**{**vars(model), "frame_names": names})
    write_images(model, folder / "images")
    export_pinhole(model, folder / "out", folder / "images", flat_names=True)
    return model, folder / "out"


def points_of(folder: Path) -> np.ndarray:
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    return np.array([p.xyz for p in model.points3D.values()])


def true_pixels(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Points and the keypoints that they project onto without noise, by image."""
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    found = {}
    for image in model.images.values():
        seen = [p for p in image.points2D if p.has_point3D()]
        xyz = np.array([model.points3D[p.point3D_id].xyz for p in seen])
        found[image.name] = xyz, np.array([p.xy for p in seen])
    return found


def graphdeco(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Names as its dictionary has them -> 4x4 world to camera, and the pinhole matrix.

    Images are the last part of a name in ``images``; a camera's name ends at the first
    dot; only fields of view are kept, so that the principal point is the middle.
    """
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    cameras = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model_name in ("PINHOLE", "SIMPLE_PINHOLE")
        path = folder / "images" / PurePosixPath(image.name).name
        height, width = cv2.imread(str(path)).shape[:2]
        fov = [
            2.0 * np.arctan(length / (2.0 * focal))
            for length, focal in zip(
                (camera.width, camera.height), camera.params[:2], strict=True
            )
        ]
        focal_x, focal_y = (
            length / (2.0 * np.tan(angle / 2.0))
            for length, angle in zip((width, height), fov, strict=True)
        )
        matrix = np.array(
            [[focal_x, 0, width / 2.0], [0, focal_y, height / 2.0], [0, 0, 1]]
        )
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        name = PurePosixPath(image.name).name.split(".")[0]
        assert name not in cameras, "two images of one name"
        cameras[name] = (pose, matrix)
    return cameras


def nerfstudio(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same from transforms.json: OpenGL cameras, one set of intrinsics a frame."""
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] == "PINHOLE"
    cameras = {}
    for frame in meta["frames"]:
        image = cv2.imread(str(folder / frame["file_path"]), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(folder / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert image.shape[:2] == (frame["h"], frame["w"])
        assert mask.ndim == 2 and mask.shape == image.shape[:2]
        world_from_cam = np.array(frame["transform_matrix"])
        world_from_cam[:3, 1:3] *= -1.0  # OpenGL -> OpenCV axes
        matrix = np.array(
            [
                [frame["fl_x"], 0, frame["cx"]],
                [0, frame["fl_y"], frame["cy"]],
                [0, 0, 1],
            ]
        )
        name = PurePosixPath(frame["file_path"]).stem
        cameras[name] = (np.linalg.inv(world_from_cam), matrix)
    return cameras


def gsplat(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same: the calibration matrix as it is; files of ``images`` by their paths."""
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    root = folder / "images"
    files = sorted(p.relative_to(root).as_posix() for p in root.rglob("*"))
    assert files == sorted(image.name for image in model.images.values())
    return {
        PurePosixPath(image.name).stem: (
            np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]),
            model.cameras[image.camera_id].calibration_matrix(),
        )
        for image in model.images.values()
    }


@pytest.mark.parametrize("reader", [graphdeco, gsplat, nerfstudio])
def test_every_trainer_sees_the_points_where_they_are(export, reader):
    _, folder = export
    cameras, truth = reader(folder), true_pixels(folder)
    assert len(cameras) == len(truth) == 8
    for name, (xyz, xy) in truth.items():
        pose, matrix = cameras[PurePosixPath(name).stem]
        in_cam = xyz @ pose[:3, :3].T + pose[:3, 3]
        found = in_cam @ matrix.T
        # The lens's iterative undistortion, as in the simulator.
        np.testing.assert_allclose(found[:, :2] / found[:, 2:], xy, atol=1e-6)


def test_names_are_flat_and_differ_before_their_only_dot(export):
    _, folder = export
    names = sorted(path.name for path in (folder / "images").iterdir())
    assert names == [
        f"{side}_clip_{f:04}.png" for side in ("left", "right") for f in range(4)
    ]
    report = json.loads((folder / "pinhole.json").read_text())
    assert {(e["name"], e["written_as"]) for e in report["images"]} >= {
        ("left/clip.0001.png", "left_clip_0001.png")
    }


def test_masks_are_there_under_both_names(export):
    _, folder = export
    masks = folder / "masks"
    for path in (folder / "images").iterdir():
        both = [masks / f"{path.name}.png", masks / f"{path.stem}.png"]
        assert both[0].read_bytes() == both[1].read_bytes()
    assert len(list(masks.iterdir())) == 16


def test_points_for_nerfstudio_are_those_of_the_model(export, open3d):
    _, folder = export
    meta = json.loads((folder / "transforms.json").read_text())
    cloud = open3d.io.read_point_cloud(str(folder / meta["ply_file_path"]))
    points = np.asarray(cloud.points)  # single precision
    order, other = np.lexsort(points.T), np.lexsort(points_of(folder).T)
    np.testing.assert_allclose(points[order], points_of(folder)[other], atol=1e-6)


@pytest.mark.parametrize("centered", [True, False])
def test_the_principal_point_is_the_middle_unless_it_is_not_wanted(export, centered):
    model, _ = export
    found = pinhole_model(model, centered=centered)
    plain = pinhole_model(model, centered=False)
    for pinhole, other in zip(found.pinholes, plain.pinholes, strict=True):
        middle = (pinhole.width / 2.0, pinhole.height / 2.0)
        off = np.subtract(pinhole.principal_point, middle)
        assert np.all(off == 0.0) if centered else np.abs(off).max() > 1.0
        # Nothing of the image is lost: it only grows, by twice the offset.
        assert pinhole.width >= other.width and pinhole.height >= other.height
        assert pinhole.width - other.width < 60
        assert pinhole.focal_px == other.focal_px
    # Pixels moved with the principal point: the residuals are the same.
    errors = found.model.errors_px(), plain.model.errors_px()
    np.testing.assert_allclose(*errors, atol=1e-9)


@pytest.mark.parametrize(
    ("folders", "frames"),
    [
        (("a", "a_b"), ("b_1.jpg", "1.jpg")),  # a_b_1 twice
        (("left", "right"), ("x/1.jpg", "x_1.jpg")),
        (("left", "right"), ("1.a.jpg", "1_a.jpg")),
        (("left", "right"), ("1.jpg", "1.png")),  # masks of one stem
    ],
)
def test_flat_names_never_meet(folders, frames):
    rig = paper_rig()
    cameras = tuple(
        type(c)(**{**vars(c), "images": folder})
        for c, folder in zip(rig.cameras, folders, strict=True)
    )
    scene = simulated(0.0, num_points=20).scene
    model = model_of(type(rig)(**{**vars(rig), "cameras": cameras}), scene)
    names = (*frames, "3.jpg", "4.jpg")
    names_of = image_names(Model(**{**vars(model), "frame_names": names}), flat=True)
    flat = list(names_of.values())
    assert all("/" not in name and name.count(".") == 1 for name in flat)
    assert len({name.split(".")[0] for name in flat}) == len(flat) == 8


def test_images_of_another_size_leave_nothing(export, tmp_path):
    model, _ = export
    for place in np.ndindex(2, 4):
        path = tmp_path / "images" / model.image_name(*place)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((SIZE, SIZE), dtype=np.uint8))
    with pytest.raises(InputError, match="is 40 x 40, but its camera takes"):
        export_pinhole(model, tmp_path / "o", tmp_path / "images", flat_names=True)
    assert not (tmp_path / "o").exists()


def test_the_command_line_asks_for_the_images_that_trainers_need(tmp_path):
    (tmp_path / "out").mkdir()
    base = ("export", "out", "-o", "target", "--to")
    one_sentence(run(*base, "splatting", cwd=tmp_path), "--images")
    one_sentence(
        run(*base, "ply", "--flat-names", cwd=tmp_path), "--to ply writes no images"
    )
