"""Small inputs for kills and full disks: the sample's images, at half their size."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import yaml

from uwsfm._base.partial import PARTIAL
from uwsfm.jobs.demo import sample_dir
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.rig.rig import Rig

SCALE = 0.5
RIG, IMAGES, DIVES = "rig.yaml", "images", "dives.yaml"
TIMES = frozenset(
    {"timings_s", "steps_of_earlier_runs", "seconds", "solve_s", "reused"}
)
"""Keys of JSON files that say how a run went, and not what it found."""
NOT_RESULTS = ("uwsfm-work", "uwsfm.log", "SHA256SUMS")
"""The workspace, the log, and hashes of archives that hold the time of day. The page,
which holds it too, is not written."""


def write_dive(folder: Path, num_frames: int, first: int = 0) -> None:
    """A rig file and the images of some frames of the sample."""
    for side in ("left", "right"):
        (folder / IMAGES / side).mkdir(parents=True)
        sources = sorted((sample_dir() / "images" / side).iterdir())
        for source in sources[first : first + num_frames]:
            image = cv2.imread(str(source))
            small = cv2.resize(
                image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_AREA
            )
            target = folder / IMAGES / side / source.with_suffix(".png").name
            cv2.imwrite(str(target), small)
    dump_rig(_reduced(load_rig(sample_dir() / "rig.yaml")), folder / RIG, "reduced")


def write_dives(folder: Path, num_frames: int) -> None:
    """Two dives for `uwsfm batch`, one after the other in the sample."""
    entries = []
    for index, name in enumerate(("bow", "stern")):
        write_dive(folder / name, num_frames, first=index * num_frames)
        paths = {"rig": f"{name}/{RIG}", "images": f"{name}/{IMAGES}"}
        entries.append({"name": name, **paths, "out": f"results/{name}"})
    content = {"version": 1, "options": {"report": False}, "dives": entries}
    (folder / DIVES).write_text(yaml.safe_dump(content), encoding="utf-8")


def _reduced(rig: Rig) -> Rig:
    cameras = []
    for item in rig.cameras:
        lens = pycolmap.Camera(item.camera.todict())
        lens.rescale(SCALE)
        cameras.append(replace(item, camera=lens))
    return replace(rig, cameras=tuple(cameras))


def results(folder: Path) -> dict[str, str]:
    """Hashes of all files of a result, by name: equal if what was found is.

    Of archives their arrays count, of JSON files all but how long it took; all else
    counts byte by byte.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if path.is_file() and not set(parts) & set(NOT_RESULTS):
            digest = hashlib.sha256(_content(path)).hexdigest()
            found["/".join(parts)] = digest
    return found


def _content(path: Path) -> bytes:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as stored:
            parts = [(name, _array(stored[name])) for name in sorted(stored.files)]
        return repr(parts).encode()
    if path.suffix == ".json":
        return json.dumps(_without_times(json.loads(path.read_text()))).encode()
    return path.read_bytes()


def _array(values: np.ndarray) -> Any:
    if values.dtype.kind == "U" and values.ndim == 0:  # JSON in an archive
        try:
            return json.dumps(_without_times(json.loads(str(values))))
        except ValueError:
            return str(values)
    return values.dtype.str, values.shape, hashlib.sha256(values.tobytes()).hexdigest()


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in TIMES}
    if isinstance(value, list):
        return [_without_times(item) for item in value]
    return value


def left_over(*folders: Path) -> list[Path]:
    """What a killed run left half-written in some folders."""
    return [path for folder in folders for path in folder.rglob(f"{PARTIAL}*")]
