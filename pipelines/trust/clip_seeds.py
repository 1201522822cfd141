"""Is a real video mapped rightly with every seed, and from other frames of it?

    python pipelines/trust/clip_seeds.py -o OUT CLIP [--only TEXT]

CLIP holds the frames and the three rig files of ``gopro_clip``. All runs have half as
many features as usual. A seed changes neither features nor matches: runs of the same
frames share them. Beside them stands ``uwsfm refine`` of stock COLMAP's model, from as
many features, with the same rig file. A run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from against_colmap import CLIP_OPTIONS, stock_model

import uwsfm
from uwsfm._base.files import replaced_file
from uwsfm.errors import UwsfmError
from uwsfm.jobs.output_folder import WORK
from uwsfm.models.ports.port import FlatPort
from uwsfm.scene import Scene

NUM_SEEDS = 10
MAX_FEATURES = 4096
ALL = "all frames"
FRAMES = {
    ALL: slice(None),
    "as PNG": slice(None),
    "every 2nd": slice(0, None, 2),
    "every 2nd, from 2": slice(1, None, 2),
    "every 3rd": slice(0, None, 3),
    "every 3rd, from 2": slice(1, None, 3),
    "every 3rd, from 3": slice(2, None, 3),
    "first half": slice(None, 11),
    "second half": slice(11, None),
}
MIN_OBSERVATIONS = 80_000
"""Of all frames."""
MARGIN = 0.1
"""Of the RMS, beside that of `uwsfm refine`."""
K1 = (0.25, 0.45)
"""Stock COLMAP's lens has 0.34."""
MAX_TILT_DEG = 1.5
"""No one knows the port's; action cameras have theirs square to the lens."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One reconstruction."""

    frames: str
    rig: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.frames}; {self.rig}; {self.seed}"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of it."""

    registered: int = 0
    observations: int = 0
    rms_px: float = np.nan
    k1: float = np.nan
    tilt_deg: float = 0.0
    verdict: str

    def faults(self, case: Case, refined: Outcome | None, num_frames: int) -> list[str]:
        """What it misses of what we ask for."""
        limit_px = (1.0 + MARGIN) * refined.rms_px if refined is not None else np.inf
        least = MIN_OBSERVATIONS if case.frames in (ALL, "as PNG") else 1
        found = {
            "registered": self.registered < num_frames,
            "observations": self.observations < least,
            "RMS": not self.rms_px <= limit_px,
            "k1": case.rig == "none" and not K1[0] <= self.k1 <= K1[1],
            "tilt": not self.tilt_deg <= MAX_TILT_DEG,
        }
        return [name for name, fault in found.items() if fault]


def cases() -> Iterator[Case]:
    for frames in FRAMES:
        for seed in range(NUM_SEEDS if frames == ALL else 1):
            for rig in CLIP_OPTIONS:
                yield Case(frames=frames, rig=rig, seed=seed)


class Study:
    """Runs what is missing; everything is in one folder."""

    def __init__(self, clip: Path, out: Path) -> None:
        self.clip, self.out = clip, out
        self._stored = out / "clip_seeds.json"
        self.runs: dict[str, Any] = {}
        if self._stored.exists():
            self.runs = json.loads(self._stored.read_text())

    def images(self, frames: str) -> Path:
        """The folder that holds the camera's folder."""
        if frames == ALL:
            return self.clip / "images"
        folder = self._folder(frames) / "images"
        if not folder.exists():
            partial = folder.with_name("partial") / "cam"
            shutil.rmtree(partial.parent, ignore_errors=True)
            partial.mkdir(parents=True)
            for path in self._files()[FRAMES[frames]]:
                if frames == "as PNG":
                    cv2.imwrite(str(partial / f"{path.stem}.png"), cv2.imread(path))
                else:
                    (partial / path.name).symlink_to(path.resolve())
            partial.parent.rename(folder)
        return folder

    def run(self, case: Case) -> None:
        if case.name not in self.runs:
            self._note(case.name, asdict(self._reconstructed(case)))
        beside = Case(frames=case.frames, rig=case.rig, seed=-1).name
        if beside not in self.runs:
            refined = self._refined(case)
            self._note(beside, None if refined is None else asdict(refined))

    def rows(self) -> Iterator[tuple[Case, Outcome, Outcome | None]]:
        """What there is, with `uwsfm refine` of COLMAP's model of the same frames."""
        for case in cases():
            beside = Case(frames=case.frames, rig=case.rig, seed=-1).name
            if case.name in self.runs and beside in self.runs:
                refined = self.runs[beside]
                yield (
                    case,
                    Outcome(**self.runs[case.name]),
                    None if refined is None else Outcome(**refined),
                )

    def num_frames(self, frames: str) -> int:
        return len(self._files()[FRAMES[frames]])

    def _files(self) -> list[Path]:
        return sorted((self.clip / "images" / "cam").iterdir())

    def _folder(self, frames: str) -> Path:
        folder = self.out / frames.replace(", ", "_").replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _note(self, name: str, content: Any) -> None:
        self.runs[name] = content
        with replaced_file(self._stored) as partial:
            partial.write_text(json.dumps(self.runs, indent=1))
        print(name, content, flush=True)

    def _reconstructed(self, case: Case) -> Outcome:
        folder = self._folder(case.frames)
        out = folder / "run"
        shutil.rmtree(out, ignore_errors=True)
        if (folder / WORK).exists():
            shutil.copytree(folder / WORK, out / WORK)
        try:
            result = uwsfm.reconstruct(
                self.clip / f"{case.rig}.yaml",
                self.images(case.frames),
                out,
                matching="exhaustive",
                max_features=MAX_FEATURES,
                seed=case.seed,
                report=False,
                **CLIP_OPTIONS[case.rig],
            )
        except UwsfmError as error:
            return Outcome(verdict=str(error))
        if not (folder / WORK).exists():
            (out / WORK).rename(folder / WORK)
        return _outcome(result.model.scene, result.summary)

    def _refined(self, case: Case) -> Outcome | None:
        """`uwsfm refine` of stock COLMAP's model; None if that lacks a frame."""
        folder = self._folder(case.frames)
        stock, best = folder / "stock", folder / "best"
        shutil.rmtree(folder / "refined", ignore_errors=True)
        if not best.exists():
            model = stock_model(self.images(case.frames), stock, MAX_FEATURES)
            best.mkdir()
            if model is not None:
                model.write(best)
        if not (best / "images.bin").exists():
            return None
        try:
            result = uwsfm.refine_model(
                best,
                self.clip / f"{case.rig}.yaml",
                folder / "refined",
                report=False,
                **CLIP_OPTIONS[case.rig],
            )
        except UwsfmError as error:
            return Outcome(verdict=str(error))
        outcome = _outcome(result.model.scene, result.summary)
        return outcome if outcome.registered == self.num_frames(case.frames) else None


def _outcome(scene: Scene, summary: dict[str, Any]) -> Outcome:
    port, tilt_deg = scene.ports[0], 0.0
    if isinstance(port, FlatPort):
        tilt_deg = float(np.degrees(np.arccos(port.normal[2])))
    return Outcome(
        registered=summary["num_registered_frames"],
        observations=summary["num_observations"],
        rms_px=summary["reprojection_rms_px"]["after"],
        k1=float(scene.cameras[0].camera.params[3]),
        tilt_deg=tilt_deg,
        verdict=summary["verdict"],
    )


COLUMNS = (
    "frames",
    "rig file",
    "seed",
    "registered",
    "observations",
    "RMS px",
    "RMS px of refine",
    "k1",
    "tilt, degrees",
    "verdict",
    "misses",
)
HEAD = f"""\
# The clip, with ten seeds and from other frames

`python pipelines/trust/clip_seeds.py -o OUT CLIP`

{MAX_FEATURES} features per image. Asked for: all frames; {MIN_OBSERVATIONS}
observations of the 22 frames; an RMS within {MARGIN:.0%} of `uwsfm refine` of stock
COLMAP's model, where that has all frames; k1 of {K1[0]} to {K1[1]} with `none.yaml`;
a port within {MAX_TILT_DEG} degrees of straight. RMS: root of the mean squared length
of the residuals.

"""


def page(study: Study) -> str:
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    for case, found, refined in study.rows():
        num_frames = study.num_frames(case.frames)
        cells = [
            case.frames,
            case.rig,
            str(case.seed),
            f"{found.registered} of {num_frames}",
            str(found.observations),
            f"{found.rms_px:.3f}",
            "-" if refined is None else f"{refined.rms_px:.3f}",
            f"{found.k1:+.3f}",
            f"{found.tilt_deg:.2f}" if case.rig == "flat" else "-",
            found.verdict,
            ", ".join(found.faults(case, refined, num_frames)) or "nothing",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return HEAD + "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clip", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", default="", metavar="TEXT")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(options.clip, options.out)
    for case in cases():
        if options.only in case.name:
            study.run(case)
    text = page(study)
    with replaced_file(options.out / "clip_seeds.md") as partial:
        partial.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
