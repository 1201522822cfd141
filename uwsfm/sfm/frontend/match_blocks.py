"""Blocks of image pairs, matched side by side: each is a job of its own.

COLMAP keeps one search index per image, and two of its threads that share them lose
matches now and then (4.2, FAISS on the CPU). Here every thread has its own matcher, on
a small database of its own, so that nothing is shared and all cores are used. The
matches of a pair do not depend on the block it is in.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm._base.partial import scratch_folder
from uwsfm.sfm.frontend.background import opened, run_with_database

Pair = tuple[int, int]
"""Identifiers of two images."""
Matches = NDArray[np.uint32]
"""(n, 2) rows of the keypoints of the first and of the second image."""
Descriptors = NDArray[np.uint8]
"""(N, 128)"""

MAX_GROUP = 32
"""Images. An index costs as much as two pairs: all pairs of two such groups cost 12 %
more than with indices that are there. An interrupted run loses one such block."""


def pair_blocks(
    pairs: Sequence[Pair], images: Sequence[int], num_threads: int
) -> list[list[Pair]]:
    """Split pairs so that each block has many pairs of few images.

    Args:
        pairs: Of images.
        images: All, in the order of the dive: neighbours share partners.
        num_threads: There is work for so many, if there are enough pairs.

    Returns:
        The same pairs: those between two groups of consecutive images stay together,
        and groups with few common pairs are joined.
    """
    if not pairs:
        return []
    matched = {image for pair in pairs for image in pair}
    images = [image for image in images if image in matched]
    num_groups = max(
        math.ceil(len(images) / MAX_GROUP),
        min(num_threads, math.ceil(math.sqrt(2 * num_threads))),
    )
    size = math.ceil(len(images) / num_groups)
    group = {image: k // size for k, image in enumerate(images)}
    tiles: defaultdict[tuple[int, int], list[Pair]] = defaultdict(list)
    for a, b in pairs:
        first, last = sorted((group[a], group[b]))
        tiles[first, last].append((a, b))
    blocks: list[list[Pair]] = [[]]
    for key in sorted(tiles):
        if len(blocks[-1]) >= size**2 // 4:
            blocks.append([])
        blocks[-1].extend(tiles[key])
    return blocks


def scratch_bytes(descriptors: Mapping[int, Descriptors], num_pairs: int) -> float:
    """Room that `match_block` may take for a while, in bytes: a database with its
    journal, and what all features of an image would match."""
    rows = [len(of_image) for of_image in descriptors.values()]
    return 2.0 * 136 * sum(rows) + 8.0 * num_pairs * max(rows, default=0)


def match_block(
    descriptors: Mapping[int, Descriptors],
    pairs: Sequence[Pair],
    work_dir: Path,
    watch: Callable[[int], None] | None = None,
) -> list[Matches]:
    """Match pairs of images by COLMAP's matcher, in one thread.

    Args:
        descriptors: SIFT, by the image's identifier.
        pairs: Of identifiers. The matches depend a little on which comes first.
        work_dir: Receives files that are removed at the end.
        watch: Called a few times per second with the number of pairs matched so far;
            what it raises stops the work.

    Returns:
        Matches for each pair, in the order of ``pairs``; none are verified.
    """
    report = watch or _nothing
    with scratch_folder(work_dir) as folder:
        path = folder / "block.db"
        _write_images(path, descriptors, {image for pair in pairs for image in pair})
        list_path = folder / "pairs.txt"
        list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.num_threads = 1
        matching.skip_geometric_verification = True
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = list_path

        def match(token: pycolmap.CancellationToken) -> None:
            pycolmap.match_image_pairs(
                path,
                matching_options=matching,
                pairing_options=pairing,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        run_with_database(
            path, match, lambda block: report(block.num_matched_image_pairs())
        )
        with opened(path) as database:
            return [database.read_matches(a, b) for a, b in pairs]


def _nothing(done: int) -> None:
    """No one watches."""


def _write_images(
    path: Path, descriptors: Mapping[int, Descriptors], images: set[int]
) -> None:
    """A database of images that are named by their identifiers."""
    with opened(path) as database:
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.5, 0.5]
        )
        camera_id = database.write_camera(camera)
        for image_id in sorted(images):
            image = pycolmap.Image(
                name=f"{image_id}", camera_id=camera_id, image_id=image_id
            )
            database.write_image(image, use_image_id=True)
            rows = descriptors[image_id]
            # Where the features are does not matter here; COLMAP wants to have it.
            database.write_keypoints(image_id, np.zeros((len(rows), 2), np.float32))
            database.write_descriptors(
                image_id,
                pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, rows),
            )
