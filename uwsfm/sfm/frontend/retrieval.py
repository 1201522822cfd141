"""Frames that look alike: where a long dive may have come back to a place.

Every image is summed up by what its SIFT descriptors add to the centres of a small
vocabulary (VLAD: Jegou et al., CVPR 2010, with the normalisation of each centre of
Arandjelovic & Zisserman, CVPR 2013). The vocabulary is made of the dive's own
descriptors: nothing has to be downloaded, and it fits the sea floor at hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

NUM_WORDS = 64
NUM_TRAINING = 40_000
"""Descriptors that the vocabulary is made of."""
MAX_DESCRIPTORS = 1500
"""Of an image, evenly spread over it."""
BLOCK = 512  # frames compared at a time
SIFT_NORM = 512.0  # of COLMAP's descriptors, which are square roots already

Descriptors = NDArray[np.uint8]
Rows = NDArray[np.float32]


def similar_frames(
    images: Callable[[int], Iterable[Descriptors]],
    num_frames: int,
    *,
    num_similar: int,
    min_step: int,
    seed: int = 0,
) -> list[tuple[int, int]]:
    """Pairs of frames (i < j) of which one is among the most similar to the other.

    Args:
        images: Gives the descriptors (N, 128) of each image of a frame.
        num_frames: Frames.
        num_similar: Partners of each frame.
        min_step: Frames nearer than this in time are no partners.
        seed: Of the vocabulary.

    Returns:
        Pairs, sorted.
    """
    if num_similar == 0 or num_frames <= min_step:
        return []
    with threadpool_limits(1, user_api="blas"):  # the same sums on every machine
        words = _vocabulary(images, num_frames, seed)
        sums = np.zeros((num_frames, NUM_WORDS * words.shape[1]), dtype=np.float32)
        for f in range(num_frames):
            for descriptors in images(f):
                sums[f] += _summed_up(_thinned(descriptors), words)
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        found: set[tuple[int, int]] = set()
        for begin in range(0, num_frames, BLOCK):
            rows = np.arange(begin, min(begin + BLOCK, num_frames))
            likeness = sums[rows] @ sums.T
            near = np.abs(rows[:, None] - np.arange(num_frames)) < min_step
            likeness[near] = -np.inf
            best = np.argsort(-likeness, axis=1, kind="stable")[:, :num_similar]
            for i, partners, values in zip(
                rows.tolist(),
                best.tolist(),
                np.take_along_axis(likeness, best, axis=1).tolist(),
                strict=True,
            ):
                for j, value in zip(partners, values, strict=True):
                    if np.isfinite(value):
                        found.add((min(i, j), max(i, j)))
    return sorted(found)


def _thinned(descriptors: Descriptors) -> Rows:
    step = max(1, -(-len(descriptors) // MAX_DESCRIPTORS))
    return descriptors[::step].astype(np.float32) / np.float32(SIFT_NORM)


def _vocabulary(
    images: Callable[[int], Iterable[Descriptors]], num_frames: int, seed: int
) -> Rows:
    """Centres (NUM_WORDS, 128) of a sample of all descriptors."""
    from scipy.cluster.vq import kmeans2  # heavy, and short dives do not need it

    rng = np.random.default_rng(seed)
    chosen = np.unique(np.linspace(0, num_frames - 1, min(num_frames, 200)).astype(int))
    per_frame = NUM_TRAINING // len(chosen)
    sample = []
    for f in chosen.tolist():
        rows = np.concatenate([_thinned(descriptors) for descriptors in images(f)])
        sample.append(rng.permutation(rows)[:per_frame])
    data = np.concatenate(sample)
    if len(data) < NUM_WORDS:
        return np.zeros((NUM_WORDS, 128), dtype=np.float32)
    start = rng.permutation(data)[:NUM_WORDS]
    return kmeans2(data, start, iter=10, minit="matrix", missing="warn")[0]


def _summed_up(descriptors: Rows, words: Rows) -> Rows:
    """The differences to the nearest centre, summed per centre, of equal weight."""
    if len(descriptors) == 0:
        return np.zeros(words.size, dtype=np.float32)
    word = np.argmax(descriptors @ words.T - 0.5 * np.sum(words**2, axis=1), axis=1)
    member = np.zeros((len(words), len(descriptors)), dtype=np.float32)
    member[word, np.arange(len(word))] = 1.0
    sums = member @ descriptors - member.sum(axis=1, keepdims=True) * words
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return sums.reshape(-1)
