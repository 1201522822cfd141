"""The decorators of compiled kernels, and where their machine code is kept.

Numba keys its cache by the file of the outermost function only, so an edit in a
kernel's callee would go unnoticed. Keying the cache folder by the source of everything
that kernels are made of makes stale code impossible. Files elsewhere, or touched, and
other processors are other code to numba too: with them in the key, a folder that says
it is complete is so for whoever reads it. Without a home that can be written it is in
the temporary directory, and failing that, kernels compile in each process; a folder
that the user chose is used or refused.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
from filelock import FileLock
from llvmlite.binding import Linkage, get_host_cpu_features, get_host_cpu_name
from numba.core import config
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher

from uwsfm.errors import InputError

Function = TypeVar("Function", bound=Callable)


# Kernels call and read only what is in these folders, or in their own file.
_KERNEL_FOLDERS = ("geometry", "models", "residuals", "solver")


def _source_key() -> str:
    root = Path(__file__).parents[1].resolve()
    machine = (get_host_cpu_name(), get_host_cpu_features().flatten())
    digest = hashlib.sha1(repr((numba.__version__, *machine, str(root))).encode())
    for path in sorted(root.rglob("*.py")):
        name, source = path.relative_to(root), path.read_bytes()
        if name.parts[0] in _KERNEL_FOLDERS or b"uwsfm._base.jit" in source:
            digest.update(f"{name.as_posix()} {path.stat().st_mtime_ns}".encode())
            digest.update(source)
    return digest.hexdigest()[:16]


def _cache_dir() -> Path | None:
    chosen = os.environ.get("UWSFM_CACHE_DIR")
    home = chosen or os.environ.get("XDG_CACHE_HOME")
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
        except OSError as error:
            if chosen:
                raise InputError(
                    f"UWSFM_CACHE_DIR: cannot write to {base}: {error.strerror}"
                ) from None
    return None


CACHE_DIR = _cache_dir()
if CACHE_DIR is not None:
    config.CACHE_DIR = str(CACHE_DIR)  # type: ignore[attr-defined]


_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}

# What SIMD needs and no more: sums may be regrouped, NaN stays NaN.
_LANE_MATH = {"nsz", "arcp", "contract", "reassoc"}


class _SharedCache(FunctionCache):
    """Numba's, for processes that compile a kernel for other arguments at a time.

    It reads an index, adds a line and writes it: one of them would lose its own.
    """

    def save_overload(self, *args: Any) -> None:
        with FileLock(f"{config.CACHE_DIR}/saving.lock"):  # type: ignore[attr-defined]
            super().save_overload(*args)


class _Library(JITCodeLibrary):
    """Machine code of one function."""

    closed = False
    """Whether what it calls is its own. Numba's are open: a process that compiles calls
    the functions that were compiled for themselves, one that loads calls the copies
    beside the kernel, and as sums may be regrouped, their last digits differed."""
    straight = False
    """Whether straight lines become SIMD by LLVM's SLP. Numba leaves it out, and lanes
    have to: it would undo them."""

    def _optimize_final_module(self) -> None:
        before = config.SLP_VECTORIZE  # type: ignore[attr-defined]
        config.SLP_VECTORIZE = int(self.straight)  # type: ignore[attr-defined]
        try:  # compilers have a lock: one at a time
            super()._optimize_final_module()
        finally:
            config.SLP_VECTORIZE = before  # type: ignore[attr-defined]

    def _finalize_final_module(self) -> None:
        for function in self._final_module.functions:
            if self.closed and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        super()._finalize_final_module()


def _compiler(*, closed: bool, straight: bool) -> type[Compiler]:
    library = type("Library", (_Library,), {"closed": closed, "straight": straight})

    class KernelCompiler(Compiler):
        def define_pipelines(self) -> list[Any]:
            state = self.state
            codegen, name = state.targetctx.codegen(), state.func_id.func_qualname
            state.library = library(codegen, name)
            state.library.enable_object_caching()
            return super().define_pipelines()

    return KernelCompiler


class _Dispatcher(CPUDispatcher):
    def enable_caching(self) -> None:
        self._cache = _SharedCache(self.py_func)


class _InnerDispatcher(_Dispatcher):
    """A kernel without an entrance from Python, a sixth of what there is to compile: to
    enter there would end the process.

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
    return _compiled(function, _Dispatcher)


def inner(function: Function) -> Function:
    """Compile a kernel that only kernels call."""
    return _compiled(function, _InnerDispatcher)


def straight(function: Function) -> Function:
    """Compile a kernel of small blocks, whose straight lines of sums become SIMD.

    As many of them as fit, where all is loaded before it is stored, and the last index
    is a literal: others may be negative, and then their neighbours are elsewhere.
    """
    return _compiled(function, _Dispatcher, straight=True, fastmath=_LANE_MATH)


def inner_unsaved(function: Function) -> Function:
    """Compile a kernel that only kernels call, and that is made by another function.

    It is kept inside its callers, not by itself: numba would keep what one line of
    source makes for other kernels under names of one process.
    """
    return _compiled(function, _InnerDispatcher, saved=False)


def inner_fused(function: Function) -> Function:
    """Compile a kernel that only kernels call, and whose sums may be regrouped."""
    return _compiled(function, _InnerDispatcher, fastmath=_LANE_MATH)


def inner_straight(function: Function) -> Function:
    """Compile a `straight` kernel that only kernels call."""
    return _compiled(function, _InnerDispatcher, straight=True, fastmath=_LANE_MATH)


def lane(function: Function) -> Function:
    """Compile what becomes part of its caller.

    A formula of one lane, or a loop over lanes: else the caller's loop would not become
    SIMD; keep it free of branches (min, max, `x if ok else y`), inner loops and arrays
    of any length. Or what is short and called with many arrays, which a call copies.
    """
    return _compiled(function, _InnerDispatcher, fastmath=_LANE_MATH, forceinline=True)


def _compiled(
    function: Function,
    dispatcher: type[_Dispatcher],
    *,
    straight: bool = False,
    saved: bool = True,
    **options: Any,
) -> Any:
    is_inner = issubclass(dispatcher, _InnerDispatcher)
    options["no_cpython_wrapper"] = is_inner
    options["pipeline_class"] = _compiler(closed=not is_inner, straight=straight)
    made: Any = numba.njit(**_OPTIONS, **options)(function)
    if isinstance(made, CPUDispatcher):  # not where compilation is turned off
        made.__class__ = dispatcher
        if saved and CACHE_DIR is not None:
            made.enable_caching()
    return made
