"""Image files of more than 8 bits, and damaged ones, as what they are."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from uwsfm.errors import InputError, UwsfmError
from uwsfm.jobs.demo import sample_dir
from uwsfm.sfm.frontend.background import damaged
from uwsfm.sfm.frontend.images import find_frames, range_warnings
from uwsfm.sfm.frontend.pixels import image_fault, read_color, read_gray, value_range
from uwsfm.simulate.rigs import sample_rig

RAMP = np.linspace(0.0, 1.0, 80 * 60).reshape(60, 80)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_values_are_those_of_the_bits_that_are_used(tmp_path, bits):
    """A ramp from black to white, as a camera of so many bits stores it."""
    image = np.round(RAMP * (2**bits - 1)).astype(np.uint16 if bits > 8 else np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    for found in (read_gray(tmp_path / "a.png"), read_color(tmp_path / "a.png")):
        assert found.dtype == np.uint8
        assert (found.min(), found.max()) == (0, 255)
        exact = RAMP if found.ndim == 2 else RAMP[..., None]
        # Bits are cut off: half a level on average, one at most.
        assert np.abs(found - 255.0 * exact).max() <= 1.0
    words = value_range(tmp_path / "a.png")
    assert words == ("" if bits in (8, 16) else f"{bits} bits in pixels of 16")


@pytest.mark.parametrize("largest", [1.0, 255.0, 5000.0])
def test_floats_are_scaled_to_their_own_range(tmp_path, largest):
    image = (largest * RAMP).astype(np.float32)
    image[0, :3] = [np.nan, np.inf, -1.0]
    cv2.imwrite(str(tmp_path / "a.tiff"), image)
    found = read_gray(tmp_path / "a.tiff")
    np.testing.assert_array_equal(found[0, :3], 0)
    np.testing.assert_allclose(found[1:], 255.0 * RAMP[1:], atol=0.51)
    assert value_range(tmp_path / "a.tiff").startswith("pixels of type float32, up to")


def test_scaled_images_are_named_once_per_camera(tmp_path):
    for folder, dtype, top in (("left", np.uint16, 4095), ("right", np.uint8, 255)):
        (tmp_path / folder).mkdir()
        for name in ("1.png", "2.png"):
            image = (RAMP * top).astype(dtype)
            cv2.imwrite(str(tmp_path / folder / name), image)
    (words,) = range_warnings(find_frames(tmp_path, sample_rig(image_scale=0.1)))
    assert words.startswith("the images of left/ hold 12 bits in pixels of 16: ")


def jpeg() -> bytearray:
    (first, *_) = sorted((sample_dir() / "images" / "left").iterdir())
    return bytearray(first.read_bytes())


def zeroed(data: bytearray) -> bytes:
    """A block of the disk that was never written."""
    middle = len(data) // 2
    return bytes(data[:middle] + bytes(4096) + data[middle + 4096 :])


def noisy(data: bytearray) -> bytes:
    middle = len(data) // 2
    noise = np.random.default_rng(0).integers(0, 255, 500, dtype=np.uint8).tobytes()
    return bytes(data[:middle] + noise + data[middle + 500 :])


def cut(data: bytearray) -> bytes:
    return bytes(data[: 3 * len(data) // 4])


@pytest.mark.parametrize("harm", [zeroed, noisy, cut])
def test_a_jpeg_with_damaged_data_is_refused(tmp_path, harm):
    path = tmp_path / "a.jpg"
    path.write_bytes(bytes(jpeg()))
    assert read_color(path) is not None
    path.write_bytes(harm(jpeg()))
    with pytest.raises(InputError, match=r"a\.jpg is damaged \(.*\): copy it again"):
        image_fault(path, (800, 600))


def test_a_few_bytes_before_the_end_of_a_jpeg_are_no_damage(tmp_path):
    """Some cameras leave them, behind the whole image."""
    data = jpeg()
    assert data[-2:] == b"\xff\xd9"
    for count, refused in ((8, False), (500, True)):
        (tmp_path / "a.jpg").write_bytes(bytes(data[:-2] + b"\x55" * count + data[-2:]))
        if refused:
            with pytest.raises(InputError, match="extraneous bytes before marker 0xd9"):
                read_gray(tmp_path / "a.jpg")
        else:
            np.testing.assert_array_equal(
                read_gray(tmp_path / "a.jpg"),
                cv2.imdecode(np.frombuffer(bytes(data), np.uint8), 0),
            )


def test_a_png_with_damaged_pixels_is_refused_and_one_with_other_notes_is_not(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), (255 * RAMP).astype(np.uint8))
    whole = (tmp_path / "a.png").read_bytes()
    at = whole.index(b"IDAT") + 40
    harmed = whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]
    (tmp_path / "a.png").write_bytes(harmed)
    assert "or it is damaged" in image_fault(tmp_path / "a.png", (80, 60))
    # A text chunk with a wrong checksum: libpng leaves it out.
    note = b"\0\0\0\4tEXtA\0bc\1\2\3\4"
    at = whole.index(b"IDAT") - 4
    (tmp_path / "a.png").write_bytes(whole[:at] + note + whole[at:])
    assert image_fault(tmp_path / "a.png", (80, 60)) is None


def test_a_file_that_cannot_be_looked_at_is_not_called_damaged(tmp_path):
    loop = tmp_path / "a.jpg"
    loop.symlink_to(loop)
    with pytest.raises(InputError, match=r"a\.jpg cannot be read: Too many levels"):
        read_gray(loop)
    denied = PermissionError(13, "Permission denied")
    assert str(damaged(tmp_path, denied)) == (
        f"cannot read {tmp_path}: Permission denied"
    )
    assert isinstance(damaged(tmp_path), UwsfmError)
    assert "is damaged" in str(damaged(tmp_path / "x.npy", FileNotFoundError(2, "No")))


def test_libraries_say_nothing_of_their_own(tmp_path):
    """Cut TIFFs, PNGs and JPEGs: OpenCV and libtiff print to the terminal otherwise."""
    for name in ("a.tiff", "a.png", "a.jpg"):
        cv2.imwrite(str(tmp_path / name), (255 * RAMP).astype(np.uint8))
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
    code = (
        "import sys; from pathlib import Path\n"
        "from uwsfm.errors import InputError\n"
        "from uwsfm.sfm.frontend.pixels import image_fault\n"
        "for name in ('a.tiff', 'a.png', 'a.jpg'):\n"
        "    try: print(image_fault(Path(sys.argv[1]) / name, (80, 60)))\n"
        "    except InputError as error: print(error)\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert found.returncode == 0
    assert found.stderr == ""
    assert len(found.stdout.splitlines()) == 3
