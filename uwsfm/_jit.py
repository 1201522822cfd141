"""The decorators of compiled kernels, and where their machine code is kept.

Numba keys its cache by the file of the outermost function only, so an edit in a
kernel's callee would go unnoticed. Keying the cache folder by the source of everything
that kernels are made of makes stale code impossible; a folder that cannot be written
(read-only home) moves to the temporary directory, and failing that, kernels compile in
each process.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config
from numba.core.registry import CPUDispatcher

Function = TypeVar("Function", bound=Callable)


# Kernels call and read only what is in these folders, or in their own file.
_KERNEL_FOLDERS = ("geometry", "models", "residuals", "solver")


def _source_key() -> str:
    digest = hashlib.sha1(numba.__version__.encode())
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        name, source = path.relative_to(root), path.read_bytes()
        if name.parts[0] in _KERNEL_FOLDERS or b"uwsfm._jit" in source:
            digest.update(name.as_posix().encode())
            digest.update(source)
    return digest.hexdigest()[:16]


def _cache_dir() -> Path | None:
    home = os.environ.get("UWSFM_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    user = os.getuid() if hasattr(os, "getuid") else "user"
    candidates = [Path(home)] if home else []
    if not home:
        with suppress(RuntimeError):  # a user without a home, as in containers
            candidates.append(Path.home() / ".cache")
    candidates.append(Path(tempfile.gettempdir()) / f"uwsfm-{user}")
    for base in candidates:
        folder = base / "uwsfm" / "kernels" / _source_key()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


CACHE_DIR = _cache_dir()
if CACHE_DIR is not None:
    config.CACHE_DIR = str(CACHE_DIR)  # type: ignore[attr-defined]


_OPTIONS: dict[str, Any] = {
    "cache": CACHE_DIR is not None,
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
# What is called by kernels alone needs no entrance from Python, which is a fifth of
# what there is to compile.
_INNER = {**_OPTIONS, "no_cpython_wrapper": True}

# What SIMD needs and no more: sums may be regrouped, NaN stays NaN.
_LANE_MATH = {"nsz", "arcp", "contract", "reassoc"}


class _InnerDispatcher(CPUDispatcher):
    """A kernel without an entrance from Python: to call that would end the process.

    Called from Python all the same, in tests say, it is compiled with one, for this
    process alone: in the cache both would have the same name.
    """

    def __call__(self, *args: Any) -> Any:
        if not hasattr(self, "_entrance"):
            options = {**self.targetoptions, "no_cpython_wrapper": False}
            self._entrance = numba.jit(**options)(self.py_func)
        return self._entrance(*args)


def kernel(function: Function) -> Function:
    """Compile with numba: releases the GIL, IEEE division, cached on disk."""
    compiled: Any = numba.njit(**_OPTIONS)
    return compiled(function)


def inner(function: Function) -> Function:
    """Compile a kernel that only kernels call."""
    return _inner(function, **_INNER)


def fused(function: Function) -> Function:
    """Compile a kernel whose sums may be regrouped, as those of lanes are."""
    compiled: Any = numba.njit(**_OPTIONS, fastmath=_LANE_MATH)
    return compiled(function)


def inner_fused(function: Function) -> Function:
    """Compile a kernel that only kernels call, and whose sums may be regrouped."""
    return _inner(function, **_INNER, fastmath=_LANE_MATH)


def lane(function: Function) -> Function:
    """Compile a formula of one lane, or a loop over lanes, for SIMD; inner.

    It becomes part of its caller, else the caller's loop would not vectorise: keep it
    free of branches (min, max, `x if ok else y`), inner loops and arrays of any length.
    """
    return _inner(function, **_INNER, fastmath=_LANE_MATH, forceinline=True)


def _inner(function: Function, **options: Any) -> Function:
    compiled: Any = numba.njit(**options)(function)
    if isinstance(compiled, CPUDispatcher):  # not where compilation is turned off
        compiled.__class__ = _InnerDispatcher
    return compiled
