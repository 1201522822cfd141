"""A reconstruction whose disk gets full at a given moment.

The disk is a small file system in memory where one may be mounted (Linux, as root).
Elsewhere files are limited to a few kilobytes from that moment on (RLIMIT_FSIZE),
which programs see as a full disk ("File too large"); the table says which it was.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from small_dives import IMAGES, RIG, left_over

MOMENTS = ("features", "matching", "refractive bundle adjustment")
"""Steps at whose end, or first report if none tells its end, nothing fits any more: the
next one writes a database from COLMAP's threads, the next one copies it, and the last
one is the result itself."""
MEGABYTES = 96
LIMIT_BYTES = 20_000
BALLAST = "ballast"


@dataclass(frozen=True)
class Filled:
    """What became of a run on a full disk, and of the same command with room."""

    how: str
    message: str
    one_sentence: bool
    """It ended in one sentence that says so, and no traceback."""
    results: dict[str, str]
    """Of the second run, by `results`."""
    left_over: list[Path]


def filled_at(
    moment: str, dive: Path, disk: Path, results: Callable[[Path], dict[str, str]]
) -> Filled:
    """Reconstruct a dive on a disk that is full from a moment on, make room, resume.

    Args:
        moment: of `MOMENTS`.
        dive: of `write_dive`.
        disk: the place of the disk.
        results: hashes of a folder of results.
    """
    shutil.rmtree(disk, ignore_errors=True)
    disk.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={MEGABYTES}m", "tmpfs", str(disk)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False)
        is_mounted = mounted.returncode == 0
    except FileNotFoundError:
        is_mounted = False
    try:
        how = "ballast" if is_mounted else "limit"
        first = _child(dive, disk, moment, how)
        (disk / BALLAST).unlink(missing_ok=True)
        second = _child(dive, disk, moment, "none")
        if second.returncode:
            raise SystemExit(second.stderr)
        lines = first.stderr.strip().splitlines()
        message = lines[-1] if lines else ""
        told = message.startswith("the disk") and "run the same command" in message
        return Filled(
            how="tmpfs" if is_mounted else "RLIMIT_FSIZE",
            message=message,
            one_sentence=first.returncode == 1 and len(lines) == 1 and told,
            results=results(disk / "out"),
            left_over=left_over(disk),
        )
    finally:
        if is_mounted:
            subprocess.run(["umount", str(disk)], check=True)


def _child(
    dive: Path, disk: Path, moment: str, how: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, __file__, str(dive), str(disk), moment, how],
        cwd=disk,
        capture_output=True,
        text=True,
        check=False,
    )


def _fill(disk: Path) -> None:
    with (disk / BALLAST).open("wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while file.write(bytes(size)) == size:
                    pass
            except OSError:
                continue


def main() -> int:
    """The run in a process of its own: DIVE DISK MOMENT HOW."""
    from uwsfm import UwsfmError, reconstruct

    dive, disk = Path(sys.argv[1]), Path(sys.argv[2])
    moment, how = sys.argv[3:]

    def progress(step: str, done: int, total: int | None) -> None:
        if how == "none" or step != moment or total not in (None, done):
            return
        if how == "ballast" and not (disk / BALLAST).exists():
            _fill(disk)
        if how == "limit":
            _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES, hard))

    try:
        # As the command of kills.py, whose results it is compared with.
        paths = str(dive / RIG), str(dive / IMAGES), "out"
        reconstruct(*paths, report=False, progress=progress)
    except UwsfmError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
