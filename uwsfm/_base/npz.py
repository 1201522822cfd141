"""Arrays in .npz files, read without trust: no pickle, no more than the file holds."""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path

import numpy as np

from uwsfm._base.files import require_regular
from uwsfm.errors import InputError

MAX_BYTES = 16 * 2**30
"""Of one array, unpacked: more than any survey has."""
_DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    SyntaxError,
    RuntimeError,  # a password, or NotImplementedError: an unknown compression
    zipfile.BadZipFile,
    zlib.error,
)


def read_npz(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """All arrays of a file, by name.

    Args:
        path: the file.
        max_bytes: what its arrays may take, unpacked.

    Raises:
        InputError: there is no such file, or it is damaged; a clause without the path.
    """
    require_regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return {
                _array_name(item.filename): _read(archive, item, max_bytes)
                for item in archive.infolist()
            }
    except InputError:
        raise
    except _DAMAGE as error:
        reason = str(error).splitlines()[0][:80] if str(error) else "cut short"
        raise InputError(f"is damaged, or no .npz file ({reason})") from None


def _array_name(filename: str) -> str:
    return filename[:-4] if filename.endswith(".npy") else filename


def _read(
    archive: zipfile.ZipFile, item: zipfile.ZipInfo, max_bytes: int
) -> np.ndarray:
    """One array; its header is compared with its size before any memory is taken."""
    with archive.open(item) as file:
        version = np.lib.format.read_magic(file)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        if version not in readers:
            raise ValueError(f"array format {version}")
        shape, fortran, kind = readers[version](file)
        if kind.hasobject:
            raise ValueError("an array of Python objects")
        size = math.prod(shape) * kind.itemsize  # Python integers do not overflow
        if size > max_bytes or size != item.file_size - file.tell():
            raise ValueError(f"{item.filename}: shape {shape} does not fit its data")
        data = file.read()
    array = np.frombuffer(data, dtype=kind)
    return array.reshape(shape, order="F" if fortran else "C").copy()
