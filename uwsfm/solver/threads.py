"""Threads of the solver: how many, and what each of them does.

Kernels release the GIL, so plain Python threads run them side by side: nothing has to
be compiled twice, as with numba's ``parallel=True``, and a process that forks (a Dask
worker, a test runner) starts its own threads when it first needs them.

Work is cut by `chunk_bounds`. A result is the same in every run with as many threads if
chunks write to places of their own, or if what they sum is added in the order of the
chunks; it is the same for *any* number of threads if the chunks do not depend on it.
"""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np

from uwsfm.scene import IndexArray

_local = threading.local()
_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()


def num_threads() -> int:
    """Threads that the calling thread may use.

    The cores that the process may run on, at most NUMBA_NUM_THREADS if that is set, and
    at most what `limited` allows; one inside a task of `run_chunks`.
    """
    count = _available()
    limit: int | None = getattr(_local, "limit", None)
    return count if limit is None else max(1, min(count, limit))


def _available() -> int:
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    wanted = os.environ.get("NUMBA_NUM_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        count = min(count, int(wanted))
    return count


@contextmanager
def limited(count: int) -> Iterator[None]:
    """At most so many threads for the calling thread, in this context."""
    before: int | None = getattr(_local, "limit", None)
    _local.limit = count if before is None else min(count, before)
    try:
        yield
    finally:
        _local.limit = before


def chunk_bounds(work_start: IndexArray, num_chunks: int) -> IndexArray:
    """Bounds (num_chunks + 1,) that cut items into runs of about equal work.

    Args:
        work_start: (N + 1,) rising: the work before each item, and the total; as
            ``layout.point_start`` for points that cost as much as their cells.
        num_chunks: positive.
    """
    total = int(work_start[-1])
    wanted = total * np.arange(1, num_chunks) / num_chunks
    inner = np.searchsorted(work_start, wanted)
    return np.concatenate([[0], inner, [len(work_start) - 1]]).astype(np.int64)


def run_chunks(task: Callable[[int], None], num_chunks: int) -> None:
    """Call ``task(chunk)`` for every chunk; the caller's thread takes part.

    Raises:
        Exception: what the first of the failed chunks raised, after all have ended.
    """
    count = min(num_threads(), num_chunks)
    if count <= 1:
        for chunk in range(num_chunks):
            task(chunk)
        return
    chunks = iter(range(num_chunks))

    def work() -> None:
        with limited(1):
            while True:
                with _lock:
                    chunk = next(chunks, None)
                if chunk is None:
                    return
                task(chunk)

    others = [_pool(count - 1).submit(work) for _ in range(count - 1)]
    try:
        work()
    finally:
        errors = [other.exception() for other in others]
    for error in errors:
        if error is not None:
            raise error


def _pool(size: int) -> ThreadPoolExecutor:
    with _lock:
        if size not in _pools:
            _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="uwsfm-solver")
        return _pools[size]


def _forget_pools() -> None:
    """In a forked child the threads of the parent do not exist."""
    global _lock
    _lock = threading.Lock()
    _pools.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)
