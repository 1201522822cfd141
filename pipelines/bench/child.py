"""Functions of this folder in processes of their own: so is their peak memory.

python child.py MODULE FUNCTION ARGUMENTS.json RESULT.json
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

MEGABYTE = 1e6
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")


def call(module: str, function: str, num_threads: int = 1, **arguments: Any) -> Any:
    """What a function returns, called in a new process.

    Args:
        module, function: Of this folder.
        num_threads: That the process may use, BLAS included.
        **arguments: Anything that JSON knows.

    Raises:
        RuntimeError: the process failed; its own words are on stderr.
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    env = {**os.environ, "PYTHONPATH": paths}
    env.update(dict.fromkeys(_THREADS, str(num_threads)))
    with tempfile.TemporaryDirectory() as name:
        given, found = Path(name) / "arguments.json", Path(name) / "result.json"
        given.write_text(json.dumps(arguments), encoding="utf-8")
        command = [sys.executable, __file__, module, function, str(given), str(found)]
        if subprocess.run(command, env=env).returncode != 0:
            raise RuntimeError(f"{module}.{function}({arguments}) failed")
        return json.loads(found.read_text(encoding="utf-8"))


def peak_memory_mb() -> float:
    """Of this process so far, 1e6 bytes."""
    status = Path("/proc/self/status")
    if status.exists():  # the other number knows of the process that started this one
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM"):
                return 1024.0 * float(line.split()[1]) / MEGABYTE
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE


if __name__ == "__main__":
    module, function, given, found = sys.argv[1:]
    arguments = json.loads(Path(given).read_text(encoding="utf-8"))
    result = getattr(import_module(module), function)(**arguments)
    Path(found).write_text(json.dumps(result), encoding="utf-8")
