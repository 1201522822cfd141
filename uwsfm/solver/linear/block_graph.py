"""Which frames share points: the pattern of the reduced system, found once per layout.

Free frames are numbered by their columns. Row i of the lower triangle has a 6x6 block
for every frame j <= i that sees a point of frame i.
"""

from typing import NamedTuple

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.scene import IndexArray
from uwsfm.solver.layout import HELD, Layout, ShortIndexArray

MANY_BLOCKS = 30_000
"""Of 288 bytes each."""


class BlockGraph(NamedTuple):
    """The blocks of every row; F free frames, P points, K cells."""

    frame: IndexArray
    """(F,) of the scene."""
    cell_row: ShortIndexArray
    """(K,) free frame of each cell, or HELD."""
    point_order: IndexArray
    """(P,) to go through them in: as they come, which is how their cells lie in memory;
    by their first frames if the blocks are too many for a cache to hold, so that
    neighbours touch the same."""
    row_start: IndexArray
    """(F + 1,) first block of each row."""
    row_other: IndexArray
    """(number of blocks,) the other frame of each block, rising; a row ends with its
    own frame."""
    work_start: IndexArray
    """(F + 1,) products of cells that the rows before this one take."""

    @property
    def num_frames(self) -> int:
        return len(self.frame)

    @property
    def num_blocks(self) -> int:
        return len(self.row_other)


def build_graph(layout: Layout) -> BlockGraph:
    """The pattern of a layout's reduced system."""
    frame = np.flatnonzero(layout.frame_col != HELD)
    row_of = np.full(len(layout.frame_col), HELD, dtype=np.int32)
    row_of[frame] = np.arange(len(frame))  # columns rise with the frames
    cell_row = row_of[layout.cell_frame]
    point_start = layout.point_start
    counts = np.bincount(cell_row + 1, minlength=len(frame) + 1)  # HELD comes first
    entry_start = np.concatenate([[0], np.cumsum(counts[1:])])
    entry_cell, entry_point = np.empty((2, entry_start[-1]), dtype=np.int32)
    first_row = np.full(len(point_start) - 1, len(frame))
    _list_entries(
        point_start,
        cell_row,
        entry_start[:-1].copy(),
        entry_cell,
        entry_point,
        first_row,
    )
    entries = (point_start, cell_row, entry_start, entry_cell, entry_point)
    num_blocks, work = np.zeros((2, len(frame)), dtype=np.int64)
    _count_blocks(entries, num_blocks, work)
    row_start = np.concatenate([[0], np.cumsum(num_blocks)])
    row_other = np.empty(row_start[-1], dtype=np.int64)
    _list_blocks(entries, row_start, row_other)
    if len(row_other) <= MANY_BLOCKS:
        first_row[:] = 0
    return BlockGraph(
        frame=frame,
        cell_row=cell_row,
        point_order=np.argsort(first_row, kind="stable"),
        row_start=row_start,
        row_other=row_other,
        work_start=np.concatenate([[0], np.cumsum(work)]),
    )


@kernel
def _list_entries(
    point_start, cell_row, next_entry, entry_cell, entry_point, first_row
):
    """Cells and points of each row, rising, and the first row of each point."""
    for p in range(len(first_row)):
        for c in range(point_start[p], point_start[p + 1]):
            i = cell_row[c]
            if i != HELD:
                first_row[p] = min(first_row[p], i)
                entry_cell[next_entry[i]], entry_point[next_entry[i]] = c, p
                next_entry[i] += 1


@inner
def _mark_row(entries, i, seen):
    """Mark with i the frames j <= i that share a point with frame i; their number, and
    how many cells were met."""
    point_start, cell_row, entry_start, entry_cell, entry_point = entries
    seen[i] = i
    count, met = 1, 0
    for e in range(entry_start[i], entry_start[i + 1]):
        for other in range(point_start[entry_point[e]], entry_cell[e]):
            j = cell_row[other]
            if j == HELD:
                continue
            met += 1
            if seen[j] != i:
                seen[j] = i
                count += 1
    return count, met


@kernel
def _count_blocks(entries, num_blocks, work):
    seen = np.full(len(num_blocks), -1)
    for i in range(len(num_blocks)):
        num_blocks[i], met = _mark_row(entries, i, seen)
        # Folding a cell costs about as much as a product, beside its own.
        work[i] = met + 2 * (entries[2][i + 1] - entries[2][i]) + 1


@kernel
def _list_blocks(entries, row_start, row_other):
    seen = np.full(len(row_start) - 1, -1)
    for i in range(len(seen)):
        _mark_row(entries, i, seen)
        at = row_start[i + 1]
        for j in range(i, -1, -1):
            if at == row_start[i]:
                break
            if seen[j] == i:
                at -= 1
                row_other[at] = j


@inner
def find_block(row_start, row_other, i, j, start):
    """Where the block of row i and frame j <= i is, not before ``start``."""
    end = row_start[i + 1] - 1
    s = max(start, end - (i - j))  # as many frames lie between them, at most
    while row_other[s] < j:
        s += 1
    return s
