"""Images that are missing, broken or of the wrong size end in one sentence."""

import cv2
import numpy as np
import pytest

from uwsfm.errors import InputError
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.features import extract_features
from uwsfm.sfm.frontend.image_features import find_features
from uwsfm.sfm.frontend.images import (
    check_masks,
    find_frames,
    mask_warnings,
    natural_key,
)
from uwsfm.sfm.options import FeatureOptions, MatchOptions
from uwsfm.simulate.rigs import sample_rig

WIDTH, HEIGHT = 80, 60


@pytest.fixture
def rig():
    return sample_rig(image_scale=WIDTH / 800)


@pytest.fixture
def image_dir(tmp_path, rng):
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        for name in ("frame2.png", "frame10.png", "frame1.png"):
            image = rng.integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
            cv2.imwrite(str(tmp_path / folder / name), image)
    return tmp_path


def features_of(image_dir, rig) -> None:
    frames = find_frames(image_dir, rig)
    extract_features(frames, rig, image_dir / "work" / "f.db", FeatureOptions())


def sentence(error: pytest.ExceptionInfo) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def test_frames_are_equal_names_in_natural_order(image_dir, rig):
    frames = find_frames(image_dir, rig)
    assert frames.names == ("frame1.png", "frame2.png", "frame10.png")
    assert frames.image_name(1, 2) == "right/frame10.png"
    assert frames.warnings() == []


def test_natural_key_sorts_numbers_as_numbers():
    names = ["b1.png", "a10.png", "a9.png", "10.png", "9.png"]
    assert sorted(names, key=natural_key) == [
        "9.png",
        "10.png",
        "a9.png",
        "a10.png",
        "b1.png",
    ]


def test_a_frame_keeps_its_images_when_one_camera_lacks_its_own(image_dir, rig):
    (image_dir / "left" / "frame2.png").unlink()
    frames = find_frames(image_dir, rig)
    assert frames.names == ("frame1.png", "frame2.png", "frame10.png")
    assert [frames.has_image(c, 1) for c in (0, 1)] == [False, True]
    assert frames.num_images == 5
    assert "left/frame2.png" not in set(frames.image_names())
    (warning,) = frames.warnings()
    assert "left/frame2.png does not exist: its frame is used" in warning


def test_images_of_another_suffix_are_named_beside_the_missing_ones(image_dir, rig):
    """One of three frames was saved as PNG on one side, as JPEG on the other."""
    path = image_dir / "right" / "frame2.png"
    path.rename(path.with_suffix(".jpg"))
    (warning,) = find_frames(image_dir, rig).warnings()
    assert warning.startswith("2 images are missing, for instance ")
    assert "left/frame2.jpg does not exist, but left/frame2.png does" in warning


@pytest.mark.parametrize(
    ("rename", "words"),
    [
        (lambda p: p.with_suffix(".jpg"), "differ by their suffixes only"),
        (lambda p: p.with_name(p.name.upper()), "differ by their upper and lower case"),
    ],
)
def test_what_keeps_all_names_apart_is_named(image_dir, rig, rename, words):
    for path in list((image_dir / "right").iterdir()):
        path.rename(rename(path))
    with pytest.raises(InputError, match=words):
        find_frames(image_dir, rig)


def test_files_that_are_not_images_are_ignored(image_dir, rig):
    (image_dir / "left" / "Thumbs.db").write_text("x")
    (image_dir / "left" / "._frame1.png").write_text("x")
    frames = find_frames(image_dir, rig)
    assert len(frames.names) == 3
    assert frames.absent == frozenset()


def test_missing_directory_is_named(tmp_path, rig):
    with pytest.raises(InputError) as error:
        find_frames(tmp_path / "dive", rig)
    assert str(tmp_path / "dive") in sentence(error)


def test_missing_folder_is_named_with_its_camera(image_dir, rig):
    (image_dir / "right").rename(image_dir / "starboard")
    with pytest.raises(InputError) as error:
        find_frames(image_dir, rig)
    assert str(image_dir / "right") in sentence(error)
    assert "'right'" in sentence(error)


def test_an_empty_image_file_is_named(image_dir, rig):
    (image_dir / "right" / "frame2.png").write_bytes(b"")
    with pytest.raises(InputError) as error:
        find_frames(image_dir, rig)
    assert "right/frame2.png is an empty file" in sentence(error)


def test_empty_folder_is_named(image_dir, rig):
    for path in (image_dir / "right").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"right.* holds no image"):
        find_frames(image_dir, rig)


def test_names_without_a_pair_are_shown_from_each_side(image_dir, rig):
    for path in (image_dir / "right").iterdir():
        path.rename(path.with_name(f"R_{path.name}"))
    with pytest.raises(InputError) as error:
        find_frames(image_dir, rig)
    assert "frame1.png" in sentence(error)
    assert "R_frame1.png" in sentence(error)


def test_one_pair_is_not_a_dive(image_dir, rig):
    for name in ("frame2.png", "frame10.png"):
        (image_dir / "left" / name).unlink()
    with pytest.raises(InputError, match=r"only one frame \(frame1.png\)"):
        find_frames(image_dir, rig)


def test_white_space_in_a_name_is_refused(image_dir, rig):
    for folder in ("left", "right"):
        path = image_dir / folder / "frame2.png"
        path.rename(path.with_name("frame 2.png"))
    with pytest.raises(InputError, match=r"frame 2.png: its name contains white"):
        find_frames(image_dir, rig)


@pytest.mark.parametrize("content", [b"not an image", b"\x89PNG\r\n\x1a\n"])
def test_image_that_cannot_be_decoded_is_named(image_dir, rig, content):
    (image_dir / "right" / "frame2.png").write_bytes(content)
    with pytest.raises(InputError, match=r"right.frame2.png cannot be read"):
        features_of(image_dir, rig)


def test_image_of_another_size_is_named_with_both_sizes(image_dir, rig):
    path = image_dir / "left" / "frame10.png"
    cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH // 2), dtype=np.uint8))
    with pytest.raises(InputError, match=r"left.frame10.png has 40 x 60 .* 80 x 60"):
        features_of(image_dir, rig)


def test_options_refuse_what_they_cannot_do(tmp_path):
    with pytest.raises(InputError, match="mask directory"):
        FeatureOptions(mask_dir=tmp_path / "nowhere").require_masks()
    with pytest.raises(InputError, match="'random'"):
        MatchOptions(strategy="random")  # type: ignore[arg-type]


def write_mask(path, shape=(HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full(shape, 255, dtype=np.uint8))


def test_masks_are_named_when_they_do_not_fit(image_dir, rig, tmp_path):
    frames, masks = find_frames(image_dir, rig), tmp_path / "masks"
    with pytest.raises(InputError, match=r"first image would be .*left/frame1.png.png"):
        check_masks(frames, rig, masks)
    for name in frames.image_names():
        write_mask(masks / f"{name}.png")
    check_masks(frames, rig, masks)
    write_mask(masks / "right" / "frame2.png.png", (30, WIDTH))
    with pytest.raises(InputError, match="frame2.png.png has 80 x 30 pixels"):
        check_masks(frames, rig, masks)
    (masks / "right" / "frame2.png.png").write_text("no image")
    with pytest.raises(InputError, match="frame2.png.png cannot be read"):
        check_masks(frames, rig, masks)


def test_images_without_a_mask_are_used_whole_and_counted(image_dir, rig, tmp_path):
    """Black masks for two of six images, under both names that COLMAP knows."""
    frames, masks = find_frames(image_dir, rig), tmp_path / "masks"
    for name in ("left/frame1.png", "right/frame2.png.png"):
        write_mask(masks / name)
        black = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        cv2.imwrite(str(masks / name), black)
    check_masks(frames, rig, masks)
    (warning,) = mask_warnings(frames, masks)
    assert warning.startswith("4 of 6 images have no mask")
    assert "for instance right/frame1.png" in warning
    options, path = FeatureOptions(mask_dir=masks), tmp_path / "work" / "f.db"
    extract_features(frames, rig, path, options)
    with opened(path) as database:
        counts = {
            image.name: len(database.read_keypoints(image.image_id))
            for image in database.read_all_images()
        }
    assert [n for n in sorted(counts) if counts[n] == 0] == [
        "left/frame1.png",
        "right/frame2.png",
    ]


def test_colours_and_grey_values_come_from_one_look_at_an_image(tmp_path, rng):
    """Dots on a dark ground: the colour beneath each keypoint is its dot's."""
    image = np.full((120, 160, 3), 20, dtype=np.uint8)
    places = [(x, y) for x in range(20, 150, 24) for y in range(20, 110, 24)]
    dots = [(x, y, rng.integers(90, 255, 3)) for x, y in places]
    for x, y, color in dots:
        cv2.circle(image, (x, y), 5, [int(v) for v in color], -1)
    cv2.imwrite(str(tmp_path / "dots.png"), image)
    (found,) = find_features(
        tmp_path, ["dots.png"], (160, 120), FeatureOptions(), tmp_path, lambda: None
    )
    centers = np.array([(x + 0.5, y + 0.5) for x, y, _ in dots])
    distance = np.linalg.norm(found.keypoints[:, None, :2] - centers, axis=2)
    near = distance.min(axis=1) < 2.0
    assert near.sum() >= len(dots)
    expected = np.array([color[::-1] for _, _, color in dots])[distance.argmin(axis=1)]
    np.testing.assert_array_equal(found.colors[near], expected[near])
    assert [path.name for path in tmp_path.iterdir()] == ["dots.png"]
