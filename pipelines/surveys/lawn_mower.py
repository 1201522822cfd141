"""A survey in parts against the same survey in one piece.

    python pipelines/surveys/lawn_mower.py -o OUT [--frames 300] [--part-frames 100]

Geometric observations of lines and cross lines over a floor, with 0.4 px of noise and
10 % of wrong matches; the rig file says what a user would. Both runs get the same
matches, and end in the same refractive adjustment; OUT receives the numbers, and keeps
what was computed.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from comparison import RESULT, RUNS, compared, page

from uwsfm._base.files import replaced_file
from uwsfm._base.tasks import LOCAL
from uwsfm.jobs.finish import start_scene
from uwsfm.rig.rig import Rig
from uwsfm.sfm.options import MappingOptions, StartOptions
from uwsfm.sfm.refine import refine_scene
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import nominal_rig, paper_rig
from uwsfm.simulate.surveys import SurveySpec, simulate_survey, survey_track

DATABASE = "database.db"
WRONG = 0.1
"""Share of wrong matches."""
POINTS_PER_FRAME = 120


@dataclass(frozen=True, kw_only=True)
class Survey:
    """A survey and where its runs are kept."""

    num_frames: int
    folder: Path

    @property
    def spec(self) -> SurveySpec:
        return SurveySpec(
            num_frames=self.num_frames,
            num_points=POINTS_PER_FRAME * self.num_frames,
            detection_rate=0.6,
            noise_px=0.4,
        )

    def rig(self) -> Rig:
        """What a user would write: straight ports at half their distance."""
        return nominal_rig(paper_rig())

    def write(self, names: list[str]) -> None:
        """The same features for each run."""
        scene = simulate_survey(self.spec).scene
        for name in names:
            work_dir = self.folder / name
            work_dir.mkdir(parents=True, exist_ok=True)
            frames = frames_of(self.rig(), self.num_frames, work_dir)
            with replaced_file(work_dir / DATABASE) as partial:
                write_features(partial, scene, frames, wrong=WRONG)


def run(survey: Survey, name: str, part_frames: int, scheduler: str) -> None:
    """Map and adjust; in a process of its own, whose memory is measured."""
    work_dir = survey.folder / name
    rig = survey.rig()
    frames = frames_of(rig, survey.num_frames, work_dir)
    options = StartOptions(
        mapper="refractive",
        mapping=MappingOptions(
            submap_frames=survey.num_frames if name == "whole" else part_frames
        ),
        scheduler=scheduler,
    )

    def tell(step: str, done: int, total: int | None) -> None:
        if step in ("submaps", "merging"):
            print(f"{name}: {step} {done} of {total}", flush=True)

    start = start_from_matches(rig, frames, Steps(work_dir), "", options, tell)
    arrays = start.arrays()
    clock = time.monotonic()
    refined = refine_scene(start_scene(rig, start, arrays), rig)
    seconds = time.monotonic() - clock
    calibration = refined.calibration
    report = {
        "timings_s": {**start.summary["timings_s"], "adjustment": seconds},
        "submaps": start.summary.get("submaps"),
        "num_registered": len(arrays.frame_names),
        "num_points": calibration.summary.num_points,
        "num_observations": calibration.summary.num_observations,
        "sigma_px": calibration.summary.sigma_px,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    names = [frames.names.index(frame) for frame in arrays.frame_names]
    with replaced_file(work_dir / RESULT) as partial, partial.open("wb") as file:
        np.savez(
            file,
            frames=np.array(names),
            poses=refined.scene.rig_from_world,
            covariances=calibration.covariance.frames,
            ports=np.array([port.row for port in refined.scene.ports]),
            port_stddevs=np.array(
                [
                    [np.radians(c.normal_stddev_deg), c.distance_stddev_m]
                    for c in calibration.covariance.cameras
                ]
            ),
            report=json.dumps(report),
        )


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--part-frames", type=int, default=100)
    parser.add_argument("--runs", default=",".join(RUNS), help="of: %(default)s")
    parser.add_argument("--scheduler", default=LOCAL, help="of Dask: tcp://HOST:PORT")
    parser.add_argument("--only", choices=RUNS, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    options = parse()
    survey = Survey(
        num_frames=options.frames, folder=options.out / f"work-{options.frames}"
    )
    if options.only:
        run(survey, options.only, options.part_frames, options.scheduler)
        return
    runs = options.runs.split(",")
    survey.write([n for n in runs if not (survey.folder / n / DATABASE).exists()])
    for name in runs:
        if not (survey.folder / name / RESULT).exists():
            subprocess.run([sys.executable, *sys.argv, "--only", name], check=True)
    found = compared(survey.folder, survey_track(survey.spec), runs)
    with replaced_file(options.out / f"lawn_mower_{options.frames}.json") as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    with replaced_file(options.out / "lawn_mower.md") as partial:
        partial.write_text(page(options.out), encoding="utf-8")
    print(options.out / "lawn_mower.md")


if __name__ == "__main__":
    main()
