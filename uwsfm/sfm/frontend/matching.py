"""Feature matches between pairs of images; the rig's geometry is verified later."""

from __future__ import annotations

import logging
import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from itertools import combinations_with_replacement
from pathlib import Path

import pycolmap

from uwsfm._base.disk import require_room
from uwsfm._base.progress import Progress, silent
from uwsfm.sfm.frontend import background
from uwsfm.sfm.frontend.background import opened, quiet_colmap
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.frontend.match_blocks import (
    Matches,
    Pair,
    match_block,
    pair_blocks,
    scratch_bytes,
)
from uwsfm.sfm.frontend.paper_matching import match_pairs
from uwsfm.sfm.frontend.retrieval import similar_frames
from uwsfm.sfm.options import MatchOptions, thread_count

logger = logging.getLogger(__name__)


def is_exhaustive(num_frames: int, options: MatchOptions) -> bool:
    """Whether all frames are compared."""
    return options.strategy == "exhaustive" or (
        options.strategy == "auto" and num_frames <= options.max_exhaustive_frames
    )


def frame_pairs(
    num_frames: int, options: MatchOptions, similar: Iterable[Pair] = ()
) -> Iterator[Pair]:
    """Pairs of frames to match (i <= j), each with itself first."""
    if is_exhaustive(num_frames, options):
        yield from combinations_with_replacement(range(num_frames), 2)
        return
    steps = set(range(1, options.overlap + 1))
    steps.update(2**k for k in range(num_frames.bit_length()))
    alike: defaultdict[int, set[int]] = defaultdict(set)
    for i, j in similar:
        alike[i].add(j)
    for i in range(num_frames):
        yield i, i
        partners = alike[i].union(i + step for step in steps)
        yield from ((i, j) for j in sorted(partners) if j < num_frames)


def image_pairs(
    frames: Frames, options: MatchOptions, similar: Iterable[Pair] = ()
) -> list[tuple[str, str]]:
    """Pairs of images: every camera of one frame with every camera of the other."""
    cameras = range(len(frames.folders))
    return [
        (frames.image_name(a, i), frames.image_name(b, j))
        for i, j in frame_pairs(len(frames.names), options, similar)
        for a in cameras
        for b in cameras
        if (i < j or a < b) and frames.has_image(a, i) and frames.has_image(b, j)
    ]


def chosen_pairs(
    frames: Frames, database_path: Path, options: MatchOptions
) -> list[tuple[str, str]]:
    """`image_pairs`, with the frames that look alike if they are many.

    Args:
        frames: The images.
        database_path: With their features.
        options: Which pairs.
    """
    num_frames = len(frames.names)
    if is_exhaustive(num_frames, options):
        logger.info("matching: all pairs of %d frames", num_frames)
        return image_pairs(frames, options)
    with opened(database_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        similar = similar_frames(
            lambda f: (
                database.read_descriptors(ids[frames.image_name(c, f)]).data
                for c in range(len(frames.folders))
                if frames.has_image(c, f)
            ),
            num_frames,
            num_similar=options.num_similar,
            min_step=options.overlap + 1,
        )
    logger.info(
        "matching: %d frames in sequence, each with %d neighbours, frames 16, 32, ... "
        "away, and %d pairs of frames that look alike",
        num_frames,
        options.overlap,
        len(similar),
    )
    return image_pairs(frames, options, similar)


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
    pairs = chosen_pairs(frames, database_path, options)
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
            # Every thread may ask before any of them has written.
            needed = num_threads * scratch_bytes(descriptors, len(blocks[k]))
            require_room(database_path.parent, needed, "matching")
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
