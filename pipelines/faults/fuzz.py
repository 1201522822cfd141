"""Mutated input of every kind, read as the commands read it: what does not end well?

Well is a result, or one `UwsfmError` of one line. Not well: another exception, an abort
of the process, more than five seconds, a file outside of the target. Every kind runs in
a process of its own, which is watched from here; the same seed gives the same cases.

    python pipelines/faults/fuzz.py --cases 300 --seed 0
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

SECONDS = 5.0
START_SECONDS = 120.0
"""Of a process, which imports and may compile."""
OUTCOMES = ("read", "refused", "traceback", "hang", "abort", "outside")
RIG = Path(__file__).parents[2] / "datasets" / "sample" / "rig.yaml"

LENGTHS = """version: 1
scale_bars:
  - length_m: 0.5
    stddev_m: 0.0005
    ends:
      - [{image: left/01.png, xy: [412.5, 300.0]}, {image: left/02.png, xy: [1.0, 2.0]}]
      - [{image: left/01.png, xy: [702.0, 310.5]}, {image: left/02.png, xy: [3.0, 4.0]}]
frame_distances:
  - {frames: [01.png, 14.png], length_m: 2.31, stddev_m: 0.01}
"""
POSITIONS = "frame,x,y,z,sx,sy,sz\n" + "".join(
    f"{i:04}.jpg,{0.5 * i},{0.1 * i},-3.2,0.02,0.02,0.05\n" for i in range(6)
)
DIVES = """version: 1
options: {clahe: true}
dives:
  - {name: bow, rig: rig.yaml, images: wreck/bow, out: results/bow}
  - {name: stern, rig: rig.yaml, images: stern, options: {seed: 3, lengths: l.yaml}}
"""
MEASUREMENTS = """version: 1
click_stddev_px: 1.0
distances:
  - {name: width, ends: [12, 56]}
areas:
  - {name: plate, corners: [1, 2, 3, 4]}
heights:
  - {name: colony, of: 7, above: [1, 2, 3]}
"""
NASTY = (
    *("{{ x }}", "[", "}", "? [1]\n: 2", "&a [*a]", "!!python/name:os.system", "\t"),
    *("1e300", "-1e300", "1e-300", ".nan", ".inf", "nan", "0", "-1", "true", "null"),
    *("9" * 400, "2" + "0" * 18, "\0", "\x1b[2J", "\\", "..", "../../x", "/etc/passwd"),
    *("C:\\x", "\u202e", "é", " ", "", "[]", "{}", "''", "~", "2001-01-01", "0x7f"),
)
"""What is put in the place of a word."""


# ---- Mutations ----------------------------------------------------------------------


def mutated_text(text: str, rng: np.random.Generator) -> bytes:
    """A word exchanged, a line lost, doubled or cut, or some bytes overwritten."""
    words = re.split(r"([\s,:/\[\]{}]+)", text)  # odd ones are what is between words
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = int(rng.integers(len(words)))
        words[at - at % 2 if rng.integers(8) else at] = NASTY[rng.integers(len(NASTY))]
    lines = "".join(words).splitlines(keepends=True) or [""]
    at, kind = int(rng.integers(len(lines))), int(rng.integers(8))
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[at])
    elif kind == 2:
        lines = lines[: at + 1]
    data = "".join(lines).encode("utf-8", "surrogatepass")
    return mutated_bytes(data, rng) if kind == 3 else data


def mutated_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut short, or some bytes overwritten by chance, zeros or the largest number."""
    changed = bytearray(data)
    if not changed or rng.integers(5) == 0:
        return bytes(changed[: int(rng.integers(len(changed) + 1))])
    for _ in range(rng.integers(1, 4)):
        at, size = int(rng.integers(len(changed))), int(rng.choice([1, 4, 8]))
        fill = rng.choice(3)
        new = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
        changed[at : at + size] = (new, b"\0" * size, b"\xff" * size)[fill]
    return bytes(changed)


# ---- Kinds of input -----------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """Files of one kind, and what reads them."""

    files: dict[str, bytes]
    """All of them are there; one is mutated."""
    read: Callable[[Path], object]
    """Of the folder that holds them."""
    is_text: bool = True


def _text_kind(name: str, text: str, read: Callable[[Path], object]) -> Kind:
    return Kind({name: text.encode()}, lambda folder: read(folder / name))


def _rig(path: Path) -> object:
    from uwsfm.rig.file import load_rig

    rig = load_rig(path)
    return rig.refractive_cameras(), rig.given_accuracy()


def _kinds(names: list[str] | None = None) -> dict[str, Callable[[], Kind]]:
    from uwsfm.inputs.lengths_file import load_lengths, load_positions
    from uwsfm.jobs.dives_file import load_dives
    from uwsfm.measuring.measurements_file import load_measurements
    from uwsfm.rig.covariance_file import read_covariance

    matrix = {"names": ["left.focal"], "matrix": [[1.0]]}
    return {
        "rig": lambda: _text_kind("rig.yaml", RIG.read_text(), _rig),
        "lengths": lambda: _text_kind("l.yaml", LENGTHS, load_lengths),
        "positions": lambda: _text_kind("p.csv", POSITIONS, load_positions),
        "dives": lambda: _text_kind("dives.yaml", DIVES, load_dives),
        "measurements": lambda: _text_kind("m.yaml", MEASUREMENTS, load_measurements),
        "covariance": lambda: _text_kind("c.json", json.dumps(matrix), read_covariance),
        "observations": _observations,
        "cloud": _cloud,
        "model": lambda: _model(binary=True),
        "text model": lambda: _model(binary=False),
        "ports": _ports,
        "names": _names,
        "images": _images,
    }


def _observations() -> Kind:
    from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
    from uwsfm.simulate.observation_file import read_observations, write_observations
    from uwsfm.simulate.rigs import sample_rig
    from uwsfm.simulate.trajectories import rich_motion

    options = ObservationOptions(num_points=30)
    simulated = simulate_scene(sample_rig(), rich_motion(3), Relief(), options)
    with tempfile.TemporaryDirectory() as name:
        write_observations(simulated, Path(name) / "o.npz")
        data = (Path(name) / "o.npz").read_bytes()
    return Kind({"o.npz": data}, lambda f: read_observations(f / "o.npz"), False)


def _cloud() -> Kind:
    from uwsfm.cloud import Cloud, read_cloud, write_cloud

    count = 5
    cloud = Cloud(
        points=np.arange(3.0 * count).reshape(-1, 3),
        normals=np.zeros((count, 3)),
        colors=np.zeros((count, 3), dtype=np.uint8),
        stddev=np.ones(count),
        num_views=np.ones(count, dtype=np.int64),
        view_range=np.ones(count),
    )
    with tempfile.TemporaryDirectory() as name:
        write_cloud(cloud, Path(name) / "c.ply")
        data = (Path(name) / "c.ply").read_bytes()
    return Kind({"c.ply": data}, lambda f: read_cloud(f / "c.ply"), False)


def _small_model(folder: Path, *, binary: bool) -> None:
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 2
    options.num_frames_per_rig, options.num_points3D = 3, 10
    model = pycolmap.synthesize_dataset(options)
    for image in model.images.values():
        side = "left" if image.camera_id == min(model.cameras) else "right"
        image.name = f"{side}/{image.frame_id:04}.jpg"
    (model.write_binary if binary else model.write_text)(str(folder))


def _model(*, binary: bool) -> Kind:
    from uwsfm.colmap.model import read_reconstruction

    def read(folder: Path) -> object:
        images = read_reconstruction(folder).images.values()
        return [image.cam_from_world() for image in images if image.has_pose]

    with tempfile.TemporaryDirectory() as name:
        _small_model(Path(name), binary=binary)
        files = {path.name: path.read_bytes() for path in Path(name).iterdir()}
    return Kind(files, read, not binary)


def _ports() -> Kind:
    from uwsfm.sfm.from_colmap.refractive_colmap import rig_of_refractive_colmap

    with tempfile.TemporaryDirectory() as name:
        _small_model(Path(name), binary=False)
        kept = ("cameras.txt", "images.txt", "points3D.txt")
        files = {item: (Path(name) / item).read_bytes() for item in kept}
    lines = files["cameras.txt"].decode().splitlines()
    port = " FLATPORT 0 0 1 0.02 0.005 1 1.49 1.33"
    lines = [line if line[:1] == "#" else line + port for line in lines]
    files["cameras.txt"] = "\n".join(lines).encode()
    return Kind(files, rig_of_refractive_colmap)


def _names() -> Kind:
    import cv2  # noqa: F401  what writes

    from uwsfm.export.warp import write_image

    pixels = np.zeros((2, 2), dtype=np.uint8)

    def read(folder: Path) -> object:
        name = (folder / "name").read_bytes().decode("utf-8", "surrogateescape")
        (folder / "target").mkdir(exist_ok=True)
        return write_image(folder / "target", name, pixels)

    return Kind({"name": b"left/dive/0001.jpg"}, read)


def _images() -> Kind:
    import cv2

    from uwsfm.errors import InputError
    from uwsfm.sfm.frontend.pixels import image_fault

    pixels = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)
    files = {
        f"i.{kind}": cv2.imencode(f".{kind}", pixels)[1].tobytes()
        for kind in ("png", "jpg", "tif", "bmp")
    }

    def read(folder: Path) -> None:
        for name in files:
            fault = image_fault(folder / name, (64, 48))
            if fault is not None:
                raise InputError(fault)

    return Kind(files, read, False)


# ---- Running ------------------------------------------------------------------------


def _outcome(kind: Kind, folder: Path, rng: np.random.Generator) -> tuple[str, str]:
    """What one case comes to, and a word on it."""
    from uwsfm.errors import UwsfmError

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    chosen = str(rng.choice(sorted(kind.files)))
    for name, data in kind.files.items():
        if name == chosen and kind.is_text:
            data = mutated_text(data.decode(), rng)
        elif name == chosen:
            data = mutated_bytes(data, rng)
        (folder / name).write_bytes(data)
    outer = folder.parents[2]
    before = {path for path in outer.rglob("*") if folder not in path.parents}
    result, word = "read", ""
    try:
        kind.read(folder)
    except UwsfmError as error:
        result = "refused" if "\n" not in str(error) else "traceback"
        word = str(error)
    except Exception as error:  # whatever it is, it is counted
        result, word = "traceback", f"{type(error).__name__}: {error}"
    here = {path for path in outer.rglob("*") if folder not in path.parents}
    known = {folder / name for name in (*kind.files, "target")}
    if here != before or set(folder.iterdir()) - known:
        result = "outside"
    return result, f"{chosen}: {word}"


def _work(name: str, first: int, last: int, seed: int, pipe: Connection) -> None:
    import pycolmap

    pycolmap.logging.minloglevel = 3
    kind = _kinds()[name]()
    with tempfile.TemporaryDirectory() as outer:
        folder = Path(outer) / "a" / "b" / "case"
        kind_seed = sorted(_kinds()).index(name)
        for case in range(first, last):
            pipe.send((case, "", ""))
            rng = np.random.default_rng([seed, kind_seed, case])
            pipe.send((case, *_outcome(kind, folder, rng)))
    pipe.send((last, "", ""))


def fuzz(name: str, cases: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Counts of the outcomes of a kind, and a line for each that is not well."""
    counts: Counter[str] = Counter()
    bad, first = [], 0
    context = multiprocessing.get_context("spawn")
    while first < cases:
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(
            target=_work, args=(name, first, cases, seed, theirs), daemon=True
        )
        process.start()
        theirs.close()
        case, patience = first, START_SECONDS
        while True:
            try:
                if not ours.poll(patience):
                    outcome, word = "hang", ""
                    break
                case, outcome, word = ours.recv()
            except EOFError:
                process.join()
                outcome, word = "abort", f"exit code {process.exitcode}"
                break
            patience = SECONDS
            if outcome:
                counts[outcome] += 1
                if outcome not in ("read", "refused"):
                    bad.append(f"{name} {case}: {outcome}: {word}")
            elif case == cases:
                break
        if case < cases:
            counts[outcome] += 1
            bad.append(f"{name} {case}: {outcome}: {word}")
        process.kill()
        process.join()
        first = case + 1
    return counts, bad


def main() -> int:
    """Print the table; non-zero if a case did not end well."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=300, help="Cases of each kind.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", help="Only these kinds.")
    options = parser.parse_args()
    all_bad: list[str] = []
    print(f"| kind | {' | '.join(OUTCOMES)} |\n|---|{'---|' * len(OUTCOMES)}")
    for name in options.kind or _kinds():
        counts, bad = fuzz(name, options.cases, options.seed)
        print(
            f"| {name} | {' | '.join(str(counts[o]) for o in OUTCOMES)} |", flush=True
        )
        all_bad += bad
    for line in all_bad:
        print(line[:300].replace("\n", " // "), file=sys.stderr)
    return 1 if all_bad else 0


if __name__ == "__main__":
    sys.exit(main())
