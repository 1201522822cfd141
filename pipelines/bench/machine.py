"""What the numbers were measured on."""

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from uwsfm.results.summary import versions


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


def watched(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a section measures, with the machine, and how busy others kept it."""
    wall, busy, own = time.perf_counter(), _busy_s(), _own_s()
    found = measure()
    wall, busy = time.perf_counter() - wall, _busy_s() - busy
    others = max(0.0, busy - (_own_s() - own)) / wall
    return {**found, "machine": description(), "others_cores": round(others, 2)}


def _busy_s() -> float:
    """CPU seconds of all processes since the machine started."""
    times = psutil.cpu_times()
    return float(times.user + times.system + getattr(times, "nice", 0.0))


def _own_s() -> float:
    """CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


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
