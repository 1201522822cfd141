"""Feature matches between pairs of images; the rig's geometry is verified later."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pycolmap

from uwsfm._files import replaced_file
from uwsfm._progress import Progress, silent
from uwsfm.sfm.background import opened, run_with_database
from uwsfm.sfm.images import Frames
from uwsfm.sfm.options import MatchOptions, thread_count
from uwsfm.sfm.paper_matching import match_pairs

BLOCK_SIZE = 200  # pairs between two looks at Ctrl-C


def frame_pairs(num_frames: int, options: MatchOptions) -> Iterator[tuple[int, int]]:
    """Pairs of frames to match (i <= j), each with itself first."""
    exhaustive = options.strategy == "exhaustive" or (
        options.strategy == "auto" and num_frames <= options.max_exhaustive_frames
    )
    steps = set(range(options.overlap + 1))
    steps.update(2**k for k in range(num_frames.bit_length()))
    for i in range(num_frames):
        yield i, i
        for j in range(i + 1, num_frames):
            if exhaustive or j - i in steps:
                yield i, j


def image_pairs(frames: Frames, options: MatchOptions) -> list[tuple[str, str]]:
    """Pairs of images: every camera of one frame with every camera of the other."""
    cameras = range(len(frames.folders))
    return [
        (frames.image_name(a, i), frames.image_name(b, j))
        for i, j in frame_pairs(len(frames.names), options)
        for a in cameras
        for b in cameras
        if i < j or a < b
    ]


def match_features(
    frames: Frames,
    database_path: Path,
    options: MatchOptions,
    *,
    seed: int = 0,
    num_threads: int = -1,
    progress: Progress = silent,
) -> None:
    """Match all pairs; those matched already are skipped.

    Args:
        frames: The images, with features in the database.
        database_path: Receives the matches.
        options: Which pairs, and how.
        seed: Of the paper's matcher; COLMAP's takes none.
        num_threads: Of the paper's matcher, -1 for all cores; COLMAP's takes one.
        progress: Called with the step "matching".
    """
    pairs = image_pairs(frames, options)
    if options.matcher == "paper":
        match_pairs(
            pairs,
            database_path,
            max_error_px=options.fundamental_max_error_px,
            seed=seed,
            num_threads=thread_count(num_threads),
            progress=progress,
        )
    else:
        _match_with_colmap(pairs, database_path, progress)
    progress("matching", len(pairs), len(pairs))


def _match_with_colmap(
    pairs: list[tuple[str, str]],
    database_path: Path,
    progress: Progress,
) -> None:
    list_path = database_path.parent / "pairs.txt"
    with replaced_file(list_path) as partial:
        partial.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    # Two threads share the indices of descriptors, and in one run of twenty they lose
    # up to half of the matches of some pairs (COLMAP 4.2, FAISS on the CPU).
    matching.num_threads = 1
    matching.skip_geometric_verification = True
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_path
    pairing.block_size = BLOCK_SIZE

    def match(token: pycolmap.CancellationToken) -> None:
        pycolmap.match_image_pairs(
            database_path,
            matching_options=matching,
            pairing_options=pairing,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    run_with_database(
        database_path,
        match,
        lambda database: progress(
            "matching", database.num_matched_image_pairs(), len(pairs)
        ),
    )


def clear_matches(database_path: Path) -> None:
    """Forget matches made with other options."""
    if database_path.exists():
        with opened(database_path) as database:
            database.clear_matches()
            database.clear_two_view_geometries()
