"""Python processes that this one starts: they import what it imports.

Python puts the working folder first on the path of `python -m` and `python -c`. In the
source folder of an installed uwsfm a child would import another uwsfm than its parent,
and keep kernels of its own; any folder named like a module would take its place.
"""

import os
import sys
from pathlib import Path

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable that keeps the working folder off the path, from Python 3.11 on:
for processes whose command line is another package's."""


def import_path() -> list[str]:
    """Folders in which a child looks for modules, absolute.

    They are those of this process without the working folder, unless this very package
    was imported from there.
    """
    root, here = os.path.realpath(Path(__file__).parents[2]), os.path.realpath(".")
    path = [
        os.path.abspath(entry)
        for entry in sys.path
        if entry and (os.path.realpath(entry) != here or here == root)
    ]
    if root not in map(os.path.realpath, path):  # an editable install, or "" of `-c`
        path.insert(0, root)
    return path


def module_command(module: str, *arguments: str) -> list[str]:
    """Command line of a Python process that runs a module as `python -m` does.

    Nothing is imported, but for what is built in, before the path is set.
    """
    code = (
        f"import sys; sys.path[:] = {import_path()!r}; "
        f"import runpy; runpy.run_module({module!r}, None, '__main__', True)"
    )
    return [sys.executable, "-c", code, *arguments]
