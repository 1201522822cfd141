"""A clear sentence instead of an abort when pycolmap was imported too early.

pycolmap 4.2's Linux wheel exports a zlib of its own and links the system's as well. If
the system's is first loaded through pycolmap, its functions call pycolmap's, which free
memory they do not own: the first compression in the process (numba's, say) aborts. If
anything loaded the system's zlib before (numpy, Python's zlib), all is well.
"""

import ctypes
import sys


class _LoadedObject(ctypes.Structure):
    """The head of `struct dl_phdr_info`."""

    _fields_ = (("address", ctypes.c_void_p), ("name", ctypes.c_char_p))


def _loaded_objects() -> list[str]:
    """Paths of the shared objects of this process, in the order they were loaded."""
    names: list[str] = []
    signature = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.POINTER(_LoadedObject), ctypes.c_size_t, ctypes.c_void_p
    )

    def note(info, size, data):
        names.append((info.contents.name or b"").decode(errors="replace"))
        return 0

    ctypes.CDLL(None).dl_iterate_phdr(signature(note), None)
    return names


def refuse_broken_zlib() -> None:
    """Raise if the system's zlib was loaded by pycolmap.

    Raises:
        ImportError: the order of imports has to change.
    """
    if sys.platform != "linux" or "pycolmap" not in sys.modules:
        return
    for name in _loaded_objects():
        if "/libz.so" in name:
            return
        if "/pycolmap/_core" in name:
            raise ImportError(
                "import uwsfm, or numpy, before pycolmap: in this order pycolmap's "
                "zlib takes the place of the system's, and the process would abort"
            )
