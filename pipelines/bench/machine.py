"""What the numbers were measured on."""

import os
import platform
from pathlib import Path
from typing import Any

import psutil

from uwsfm.export.summary import versions


def description() -> dict[str, Any]:
    usable = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        usable = len(os.sched_getaffinity(0))
    return {
        "cpu": _cpu_model(),
        "cores": usable,
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
    }


def _cpu_model() -> str:
    known = Path("/proc/cpuinfo")
    if not known.exists():
        return platform.processor() or platform.machine()
    pairs = [line.partition(":") for line in known.read_text().splitlines()]
    found = {key.strip(): value.strip() for key, _, value in pairs}
    name = found.get("model name", platform.machine())
    family = found.get("cpu family"), found.get("model")
    if all(family):
        name += f", family {family[0]}, model {family[1]}"
    wide = "avx512f" in found.get("flags", "").split()
    return name + (", AVX-512" if wide else "")
