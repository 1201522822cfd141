"""Arrays that linearisations and costs of a layout use again in every iteration.

Memory that is asked for anew is empty pages at first: filling and clearing them took a
fifth of a trial's time, on one thread, whatever the number of threads.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property

import numpy as np

from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.assembly import Sums, new_sums
from uwsfm.solver.chunks import Chunk, largest_chunk, new_chunk
from uwsfm.solver.layout import Layout
from uwsfm.solver.state import KernelState
from uwsfm.solver.threads import chunk_bounds

PART = 20_000
"""Observations that are worth a thread: two milliseconds."""
MAX_PARTS = 16
"""Each needs sums of its own, 30 + 6 S numbers for every frame that it sees."""


class Workspace:
    """Scratch of one problem: threads share it, two calls at a time must not."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.bounds = _parts(layout)
        """Of the points' parts, see `_parts`."""
        self._chunks: list[Chunk] = []
        self._squares_at: KernelState | None = None

    @property
    def num_parts(self) -> int:
        return len(self.bounds) - 1

    @cached_property
    def sums(self) -> list[Sums]:
        """Of each part, for the frames that it sees."""
        layout, cells = self.layout, self.layout.point_start[self.bounds]
        return [
            new_sums(layout, np.unique(layout.cell_frame[first:last]))
            for first, last in zip(cells, cells[1:], strict=False)
        ]

    @cached_property
    def squares(self) -> Array:
        """(N,) squared errors of the state that was evaluated last."""
        return np.empty(len(self.layout.xy))

    def squares_at(self, state: KernelState) -> Array | None:
        """`squares`, if they are those of this state."""
        return self.squares if state is self._squares_at else None

    def set_state(self, state: KernelState | None) -> None:
        """Of which the squares are; None while they are written."""
        self._squares_at = state

    @contextmanager
    def chunk(self) -> Iterator[Chunk]:
        """Scratch that no other thread uses meanwhile."""
        # A list is safe to share: each of its operations is atomic.
        try:
            chunk = self._chunks.pop()
        except IndexError:
            chunk = new_chunk(self.layout, self._largest)
        try:
            yield chunk
        finally:
            self._chunks.append(chunk)

    @cached_property
    def _largest(self) -> int:
        return largest_chunk(self.layout)


def _parts(layout: Layout) -> IndexArray:
    """Bounds of the points' parts, for threads.

    They depend on the problem alone, and parts are summed in their order: results are
    the same for any number of threads.
    """
    count = min(MAX_PARTS, 1 + len(layout.xy) // PART)
    return chunk_bounds(layout.cell_start[layout.point_start], count)
