"""Feature matches between pairs of images; the rig's geometry is verified later."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path

import pycolmap

from uwsfm._progress import Progress, silent
from uwsfm.sfm import background
from uwsfm.sfm.background import opened, quiet_colmap
from uwsfm.sfm.images import Frames
from uwsfm.sfm.match_blocks import Matches, Pair, match_block, pair_blocks
from uwsfm.sfm.options import MatchOptions, thread_count
from uwsfm.sfm.paper_matching import match_pairs


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
        num_threads: -1 for all cores. The matches do not depend on it.
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
        _match_with_colmap(
            frames, pairs, database_path, thread_count(num_threads), progress
        )
    progress("matching", len(pairs), len(pairs))


def _match_with_colmap(
    frames: Frames,
    pairs: list[tuple[str, str]],
    database_path: Path,
    num_threads: int,
    progress: Progress,
) -> None:
    """Blocks of pairs, each in a thread of its own; each is kept when it is done."""
    with opened(database_path) as database, quiet_colmap():
        ids = {image.name: image.image_id for image in database.read_all_images()}
        todo = [
            (ids[a], ids[b])
            for a, b in pairs
            if not database.exists_matches(ids[a], ids[b])
        ]
        blocks = pair_blocks(
            todo, [ids[name] for name in frames.image_names()], num_threads
        )
        counts = [0] * len(blocks)
        stopped = threading.Event()

        def matched(k: int) -> list[Matches]:
            def watch(done: int) -> None:
                if stopped.is_set():
                    raise InterruptedError
                counts[k] = done

            watch(0)
            used = {image for pair in blocks[k] for image in pair}
            with access:
                descriptors = {i: database.read_descriptors(i).data for i in used}
            return match_block(descriptors, blocks[k], database_path.parent, watch)

        access = threading.Lock()  # to the connection, which is not for two threads
        before = len(pairs) - len(todo)
        with ThreadPoolExecutor(num_threads) as pool:
            waiting = {pool.submit(matched, k): k for k in range(len(blocks))}
            try:
                while waiting:
                    done, _ = wait(
                        waiting,
                        timeout=background.POLL_SECONDS,
                        return_when=FIRST_COMPLETED,
                    )
                    for job in done:
                        block = blocks[waiting.pop(job)]
                        with access:
                            _write_matches(database, block, job.result())
                    progress("matching", before + sum(counts), len(pairs))
            finally:
                stopped.set()


def _write_matches(
    database: pycolmap.Database, pairs: list[Pair], found: list[Matches]
) -> None:
    for (a, b), matches in zip(pairs, found, strict=True):
        database.write_matches(a, b, matches)  # none too: the pair is done


def clear_matches(database_path: Path) -> None:
    """Forget matches made with other options."""
    if database_path.exists():
        with opened(database_path) as database:
            database.clear_matches()
            database.clear_two_view_geometries()
