"""Which frames of a survey are mapped together: connected parts that overlap.

The frames and the matches between them are a graph. It is halved again and again where
few matches are cut (normalised cut, Shi & Malik, PAMI 2000: the second eigenvector of
the Laplacian orders the frames), and each part borrows the frames of its neighbours
that it shares most matches with.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray

AUTO_SINGLE = 400
"""Frames that are still mapped in one piece: splitting gains nothing there."""
AUTO_FRAMES = 200
"""Of the largest part of more: its global adjustments take seconds, and its memory
stays below two gigabytes."""
MIN_PART = 3
"""Frames that make a part: fewer hardly share enough with others to be placed."""
OVERLAP_SHARE = 0.1
"""Of the largest part: frames borrowed from each neighbour,"""
MIN_OVERLAP = 6
"""but so many at least, if there are."""
MIN_LINK = 30
"""Matches that make two parts neighbours."""
BALANCE = 0.15
"""How far from even a cut may be, as a share of the frames."""
SMALL = 40
"""Frames whose eigenvectors are found densely."""


class Part(NamedTuple):
    """Frames of one submap."""

    core: IndexArray
    """Rising; every frame with matches is in one core."""
    frames: IndexArray
    """Rising; with those borrowed from neighbours."""


def part_size(num_frames: int, asked: int | None) -> int | None:
    """How many frames a part may have; None: all are mapped in one piece.

    Args:
        num_frames: Of the survey.
        asked: The largest part wanted; None: by the number of frames.
    """
    if asked is None:
        return None if num_frames <= AUTO_SINGLE else AUTO_FRAMES
    return None if num_frames <= asked else asked


def split(links: csr_array, max_frames: int) -> list[Part]:
    """Split a graph of frames.

    Args:
        links: (F, F) symmetric; how many matches join two frames. The diagonal is not
            read.
        max_frames: That a core may have, at least 2.

    Returns:
        The parts, by their first frame. Frames in pieces smaller than ``MIN_PART`` that
        nothing joins to the rest are in none.
    """
    links = links.astype(np.float64).tocsr()
    links.setdiag(0.0)
    links.eliminate_zeros()
    cores = [
        core
        for piece in _pieces(links, np.arange(links.shape[0]))
        if len(piece) >= MIN_PART
        for core in _halved(links, piece, max_frames)
    ]
    cores.sort(key=lambda core: core[0])
    label = np.full(links.shape[0], -1)
    for index, core in enumerate(cores):
        label[core] = index
    overlap = max(MIN_OVERLAP, round(OVERLAP_SHARE * max_frames))
    return [
        Part(core, np.union1d(core, _borrowed(links, label, index, overlap)))
        for index, core in enumerate(cores)
    ]


def _pieces(links: csr_array, frames: IndexArray) -> list[IndexArray]:
    """What of some frames hangs together, the largest piece first."""
    _, piece = connected_components(links[frames][:, frames], directed=False)
    sizes = np.bincount(piece)
    order = np.argsort(-sizes, kind="stable")
    return [frames[piece == index] for index in order]


def _halved(
    links: csr_array, frames: IndexArray, max_frames: int
) -> Iterator[IndexArray]:
    """Cut connected frames until no part is too large."""
    if len(frames) <= max_frames:
        yield frames
        return
    first = _cut(links[frames][:, frames], -(-len(frames) // max_frames))
    sides = [np.zeros(links.shape[0], dtype=bool) for _ in range(2)]
    torn = []
    for side, mine in zip(sides, (frames[first], frames[~first]), strict=True):
        main, *rest = _pieces(links, mine)
        side[main] = True
        torn += rest
    # What the cut has torn off hangs on the other side, or on another such piece.
    while torn:
        into = [[links[piece][:, side].sum() for side in sides] for piece in torn]
        best, home = np.unravel_index(np.argmax(into), (len(torn), 2))
        sides[home][torn.pop(best)] = True
    for side in sides:
        yield from _halved(links, np.flatnonzero(side), max_frames)


def _cut(links: csr_array, num_parts: int) -> np.ndarray:
    """Mask (F,) of one side of the best cut that leaves room for whole parts."""
    size = links.shape[0]
    order = np.argsort(_second_eigenvector(links), kind="stable")
    share = (num_parts // 2) / num_parts
    low = max(1, round((share - BALANCE) * size))
    high = min(size - 1, round((share + BALANCE) * size))
    place = np.empty(size, dtype=np.int64)
    place[order] = np.arange(size)
    pairs = links.tocoo()
    ends = np.sort(place[np.column_stack([pairs.row, pairs.col])], axis=1)
    # A link is cut by all cuts between its ends; each is there in both directions.
    change = np.bincount(ends[:, 0] + 1, 0.5 * pairs.data, minlength=size + 1)
    change -= np.bincount(ends[:, 1] + 1, 0.5 * pairs.data, minlength=size + 1)
    severed = np.cumsum(change)[: size + 1]
    volume = np.concatenate([[0.0], np.cumsum(links.sum(axis=1)[order])])
    cuts = np.arange(low, high + 1)
    inside = volume[cuts]
    costs = severed[cuts] / inside + severed[cuts] / (volume[-1] - inside)
    best = cuts[np.argmin(costs)]
    return place < best


def _second_eigenvector(links: csr_array) -> Array:
    """Of the normalised Laplacian of a connected graph, per unit of degree (F,)."""
    scale = 1.0 / np.sqrt(links.sum(axis=1))
    similar = diags_array(scale) @ links @ diags_array(scale)
    if links.shape[0] <= SMALL:
        vectors = np.linalg.eigh(similar.toarray())[1]
        return scale * vectors[:, -2]
    start = np.cos(np.arange(links.shape[0]))  # the same on every machine
    _, vectors = eigsh(similar.tocsc(), k=2, sigma=1.001, which="LM", v0=start)
    # The first is the constant one, whose values are all of one sign.
    constant = np.argmax(np.abs(vectors.sum(axis=0)))
    return scale * vectors[:, 1 - constant]


def _borrowed(
    links: csr_array, label: IndexArray, index: int, overlap: int
) -> IndexArray:
    """Frames of other parts that share most matches with one."""
    into = links[:, label == index].sum(axis=1)
    near = np.flatnonzero((into > 0.0) & (label != index) & (label >= 0))
    found = [np.empty(0, dtype=np.int64)]
    for neighbour in np.unique(label[near]):
        theirs = near[label[near] == neighbour]
        if into[theirs].sum() >= MIN_LINK:
            found.append(theirs[np.argsort(-into[theirs], kind="stable")[:overlap]])
    return np.concatenate(found)
