"""COLMAP's incremental mapper, with lens and rig held."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from uwsfm._base.partial import scratch_folder
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.sfm.frontend.background import opened, run_watched
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.mapping_database import indices_of

MIN_INIT_INLIERS = 50
MIN_INIT_ANGLE_DEG = 4.0
"""Between the rays of the first pair. COLMAP's 16 degrees is out of reach for a rig
with a short baseline that moves little; the mapper halves it where it must."""
MIN_INIT_ANGLE_FREE_DEG = 16.0
"""The same without a rig: at 4 degrees the mapper may begin with the two images of one
frame, whose pose their short baseline leaves uncertain by degrees, and no rig holds it.
Halved twice, it is still 4."""
MIN_GIVEN_ANGLE_DEG = 1.0
"""The same of a pair that was chosen for more than its angle."""
MAX_EXTRA_PARAM = 1e3  # held parameters are not bogus, however large


def map_images(
    mapping_path: Path,
    frames: Frames,
    options: StartOptions,
    *,
    free: bool = False,
    first_pair: tuple[int, int] | None = None,
    progress: Progress = silent,
) -> list[pycolmap.Reconstruction]:
    """Reconstruct from a mapping database; the models with most images come first.

    Args:
        mapping_path: From `write_mapping_database`.
        frames: The images.
        options: Those of the mapping are used, and the seed.
        free: The database has no rig, and the cameras' distortion is refined.
        first_pair: Images (COLMAP's ids) to begin with; None: the mapper chooses.
        progress: Called with the step "mapping", in frames, or images where these are
            free; of several models in turn, the largest so far counts.

    Raises:
        UwsfmError: nothing could be reconstructed; says why, as far as it shows.
    """
    num_registered = most = 0
    pipeline = _pipeline_options(options, frames, free)
    if first_pair is not None:
        pipeline.init_image_id1, pipeline.init_image_id2 = first_pair
        pipeline.mapper.init_min_tri_angle = MIN_GIVEN_ANGLE_DEG

    def began() -> None:
        nonlocal num_registered
        num_registered = 0
        went_on()

    def went_on() -> None:
        nonlocal num_registered, most
        num_registered += 1
        most = max(most, num_registered)

    def call(
        token: pycolmap.CancellationToken,
    ) -> dict[int, pycolmap.Reconstruction]:
        with scratch_folder(mapping_path.parent) as scratch:
            return pycolmap.incremental_mapping(
                mapping_path,
                frames.image_dir,
                scratch,
                options=pipeline,
                initial_image_pair_callback=began,
                next_image_callback=went_on,
                cancellation_token=token,
            )

    total = frames.num_images if free else len(frames.names)
    models = run_watched(call, lambda: progress("mapping", min(most, total), total))
    if not models:
        raise UwsfmError(_why_empty(mapping_path, frames))
    progress("mapping", total, total)
    return sorted(
        models.values(),
        key=lambda model: (model.num_reg_images(), model.num_points3D()),
        reverse=True,
    )


def _pipeline_options(
    options: StartOptions, frames: Frames, free: bool
) -> pycolmap.IncrementalPipelineOptions:
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.ba_refine_focal_length = False
    pipeline.ba_refine_principal_point = False
    pipeline.ba_refine_extra_params = free
    pipeline.ba_refine_sensor_from_rig = False
    pipeline.max_extra_param = MAX_EXTRA_PARAM
    pipeline.min_model_size = 2
    pipeline.extract_colors = False
    pipeline.random_seed = options.seed
    # With more, the search for the first pair is a race (the task that succeeds first
    # stops the others), and sums of large adjustments depend on who came first.
    pipeline.num_threads = 1
    pipeline.mapper.init_min_num_inliers = MIN_INIT_INLIERS
    pipeline.mapper.init_min_tri_angle = (
        MIN_INIT_ANGLE_FREE_DEG
        if free or len(frames.folders) == 1
        else MIN_INIT_ANGLE_DEG
    )
    pipeline.mapper.filter_max_reproj_error = options.mapping.max_error_px
    pipeline.mapper.filter_min_tri_angle = options.mapping.min_angle_deg
    pipeline.triangulation.merge_max_reproj_error = options.mapping.max_error_px
    pipeline.triangulation.complete_max_reproj_error = options.mapping.max_error_px
    pipeline.triangulation.min_angle = options.mapping.min_angle_deg
    return pipeline


def _why_empty(mapping_path: Path, frames: Frames) -> str:
    """Count the matches between frames, the usual cause."""
    with opened(mapping_path) as database:
        pair_ids, geometries = database.read_two_view_geometries()
    best, best_pair = 0, (0, 0)
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = (
            indices_of(frames, i)[1] for i in pycolmap.pair_id_to_image_pair(pair_id)
        )
        if a != b and len(geometry.inlier_matches) > best:
            best, best_pair = len(geometry.inlier_matches), (a, b)
    if best < MIN_INIT_INLIERS:
        return (
            f"no model could be built: the best two frames share only {best} matches, "
            f"{MIN_INIT_INLIERS} are needed to begin; do consecutive images overlap, "
            "is the water clear enough?"
        )
    names = [frames.names[f] for f in best_pair]
    return (
        f"no model could be built, though frames {names[0]} and {names[1]} share "
        f"{best} matches: did the rig move between the frames, and do the in-air "
        "intrinsics and cam_from_rig belong to these images?"
    )
