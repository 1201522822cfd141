"""How much of `uwsfm reconstruct` is neither in pycolmap nor in compiled kernels.

CPU time: of all threads that run Python, less what they spend in calls of pycolmap and
of kernels; beside that of the process, in which the threads that pycolmap starts are,
too. What is left is Python, imports, and what it calls in other libraries, of which
OpenCV's functions (images are decoded by them) have a clock of their own.
"""

import threading
import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


class Clock:
    """CPU seconds of Python's threads, and those inside some calls."""

    def __init__(self) -> None:
        self.ended: list[float] = []
        self.inside: dict[str, list[float]] = {
            name: [] for name in ("pycolmap", "kernels", "opencv")
        }
        self._thread = threading.local()
        run = threading.Thread.run

        def watched(thread: threading.Thread) -> None:
            try:
                run(thread)
            finally:
                self.ended.append(time.thread_time())

        threading.Thread.run = watched  # type: ignore[method-assign]

    def timed(self, what: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function whose outermost calls are added up."""
        mine, seconds = self._thread, self.inside[what]

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if getattr(mine, "busy", False):
                return function(*args, **kwargs)
            mine.busy, start = True, time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                seconds.append(time.thread_time() - start)
                mine.busy = False

        return call

    def watch(self, place: Any, name: str, what: str) -> None:
        """Replace a function of a module, or a method, by a timed one."""
        found = vars(place)[name]
        if isinstance(found, staticmethod):
            setattr(place, name, staticmethod(self.timed(what, found.__func__)))
        elif callable(found):
            setattr(place, name, self.timed(what, found))

    def seconds(self, what: str) -> float:
        """Inside the calls of one kind so far."""
        return sum(self.inside[what])

    def python_s(self) -> float:
        """Of all threads so far, outside pycolmap, the kernels and OpenCV."""
        alive = [
            time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
            for thread in threading.enumerate()
            if thread.ident is not None
        ]
        return sum(alive) + sum(self.ended) - sum(map(sum, self.inside.values()))


def measure(num_frames: int) -> dict[str, Any]:
    """CPU seconds of a reconstruction of some frames of the sample, with imports."""
    clock = Clock()
    import cv2
    import pycolmap

    for name, thing in list(vars(cv2).items()):
        if type(thing).__name__ == "builtin_function_or_method":
            clock.watch(cv2, name, "opencv")
    for name, thing in list(vars(pycolmap).items()):
        if not isinstance(thing, type):
            if type(thing).__name__ == "builtin_function_or_method":
                clock.watch(pycolmap, name, "pycolmap")
            continue
        for method, found in list(vars(thing).items()):
            kind = type(found).__name__
            own = method[0] != "_" or method == "__exit__"  # which closes a database
            if kind in ("instancemethod", "staticmethod") and own:
                clock.watch(thing, method, "pycolmap")

    from uwsfm import reconstruct
    from uwsfm._base import jit as _jit
    from uwsfm.jobs.compile_kernels import compile_kernels
    from uwsfm.jobs.demo import sample_dir

    enter = _jit._Dispatcher.__call__
    _jit._Dispatcher.__call__ = clock.timed("kernels", enter)  # type: ignore
    compile_kernels(2)
    imports = clock.python_s()
    with TemporaryDirectory() as name:
        images = Path(name) / "images"
        for folder in (sample_dir() / "images").iterdir():
            (images / folder.name).mkdir(parents=True)
            for image in sorted(folder.iterdir())[:num_frames]:
                (images / folder.name / image.name).symlink_to(image)
        reconstruct(sample_dir() / "rig.yaml", images, Path(name) / "out")
    python, whole = clock.python_s(), time.process_time()
    return {
        "frames": num_frames,
        "cpu_s": whole,
        "python_s": python,
        "imports_s": imports,
        "opencv_s": clock.seconds("opencv"),
        "kernels_s": clock.seconds("kernels"),
    }
