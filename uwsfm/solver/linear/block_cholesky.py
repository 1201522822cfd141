"""Sparse Cholesky factor of 6x6 blocks, front by front, and what it tells.

Multifrontal (Duff & Reid, ACM TOMS 1983): the sums are dense products of matrices, by
BLAS. Threads take branches of the tree, then share the products of its trunk. The
blocks of the inverse at the places of the factor's follow from the last front to the
first (Takahashi, Fagan & Chen 1973), without the inverse.
"""

from collections.abc import Callable
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike
from scipy.linalg import blas, lapack

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.linear.elimination_tree import EliminationTree, Front
from uwsfm.solver.threads import run_chunks

ROWS_AT_ONCE = 48
"""That are eliminated by a triangle, which the L1 cache holds."""
STRIP = 96
"""Columns of a product's strips."""


class Panel(NamedTuple):
    """The factor's part of one front: rows of L^T."""

    own: Array
    """(k, k) upper triangle."""
    rest: Array
    """(k, m)"""


@kernel
def _place_blocks(blocks, slots, where, own, rest):
    """Add the blocks that start in a front, to the upper triangle of its rows."""
    k = len(own)
    for s in range(len(slots)):
        slot, row, col, turned = slots[s], 6 * where[s, 0], 6 * where[s, 1], where[s, 2]
        for a in range(6):
            for b in range(6):
                value = blocks[slot, b, a] if turned else blocks[slot, a, b]
                if col < k:
                    own[row + a, col + b] += value
                else:
                    rest[row + a, col - k + b] += value


@kernel
def _take_from_pivots(update, places, own, rest):
    """Subtract what a child left, from the pivots' rows of the upper triangle."""
    k = len(own)
    for i in range(len(places)):
        row = 6 * places[i]
        if row >= k:  # places rise
            return
        for a in range(6):
            for j in range(i, len(places)):
                col = 6 * places[j]
                for b in range(6):
                    value = update[6 * i + a, 6 * j + b]
                    if col < k:
                        own[row + a, col + b] -= value
                    else:
                        rest[row + a, col - k + b] -= value


@kernel
def _add_to_rows(update, places, k, after):
    """Add what a child left of the rows after k pivots, to what its parent leaves."""
    for i in range(np.searchsorted(places, k // 6), len(places)):
        for a in range(6):
            source, target = update[6 * i + a], after[6 * places[i] - k + a]
            for j in range(i, len(places)):
                col = 6 * places[j] - k
                for b in range(6):
                    target[col + b] += source[6 * j + b]


@kernel
def _take_blocks(slots, where, own, rest, blocks):
    """The other way round: blocks of the graph from the rows of a front."""
    k = len(own)
    for s in range(len(slots)):
        slot, row, col, turned = slots[s], 6 * where[s, 0], 6 * where[s, 1], where[s, 2]
        for a in range(6):
            for b in range(6):
                value = own[row + a, col + b] if col < k else rest[row + a, col - k + b]
                if turned:
                    blocks[slot, b, a] = value
                else:
                    blocks[slot, a, b] = value


@kernel
def _gather(own, rest, after, places, out):
    """Rows and columns of a symmetric front, in blocks."""
    k = len(own)
    for i in range(len(places)):
        row = 6 * places[i]
        for j in range(len(places)):
            col = 6 * places[j]
            for a in range(6):
                for b in range(6):
                    r, c = row + a, col + b
                    if r < k:
                        value = own[r, c] if c < k else rest[r, c - k]
                    else:
                        value = rest[c, r - k] if c < k else after[r - k, c - k]
                    out[6 * i + a, 6 * j + b] = value


class _Pool:
    """Square arrays that factors use again: new pages would have to be cleared, which
    took as long as a quarter of the sums."""

    def __init__(self, dtype: DTypeLike) -> None:
        self._dtype = dtype
        self._free: list[Array] = []
        self._lock = Lock()

    def take(self, size: int) -> Array:
        """Any numbers (size, size), in the smallest array that is free."""
        with self._lock:
            return self._taken(size)

    def _taken(self, size: int) -> Array:
        count = len(self._free)
        fitting = [k for k in range(count) if self._size(k) >= size * size]
        if fitting:
            flat = self._free.pop(min(fitting, key=self._size))
        else:
            if self._free:  # one grows; the others wait for smaller fronts
                self._free.pop(max(range(len(self._free)), key=self._size))
            flat = np.empty(size * size, self._dtype)
        return flat[: size * size].reshape(size, size)

    def give(self, square: Array) -> None:
        """An array of `take` that is not needed any more."""
        assert square.base is not None  # the whole of which `take` gave a part
        with self._lock:
            self._free.append(square.base)

    def _size(self, number: int) -> int:
        return self._free[number].size


class _Functions(NamedTuple):
    """Of BLAS and LAPACK, for one kind of numbers."""

    potrf: Callable
    trtri: Callable
    trmm: Callable
    trsm: Callable
    trsv: Callable

    @classmethod
    def of(cls, dtype: DTypeLike) -> "_Functions":
        factors = lapack.get_lapack_funcs(("potrf", "trtri"), dtype=dtype)
        products = blas.get_blas_funcs(("trmm", "trsm", "trsv"), dtype=dtype)
        return cls(*factors, *products)

    def solve(self, own: Array, right: Array, *, turned: bool) -> None:
        """Solve a triangle's rows (k, k) for columns (k, r), in place; turned: L^-T."""
        if right.shape[1] == 1:  # twice as fast as trsm, which packs the triangle
            trans = int(turned)
            self.trsv(own.T, right[:, 0], lower=1, trans=trans, overwrite_x=1)
        else:
            trans = int(not turned)  # of the columns' rows
            self.trsm(
                1.0, own.T, right.T, side=1, lower=1, trans_a=trans, overwrite_b=1
            )


def _square(rest: Array, out: Array) -> None:
    """Upper triangle of rest^T rest, in strips: numpy's products leave Python to other
    threads, and scipy's syrk, no faster, does not."""

    def strip(number: int) -> None:
        first = STRIP * number
        part = slice(first, first + STRIP)
        np.matmul(rest[:, part].T, rest[:, first:], out=out[part, first:])

    run_chunks(strip, -(-rest.shape[1] // STRIP))


class BlockCholesky:
    """A factor L of the frames' part, A = L L^T in the order of a tree."""

    def __init__(self, tree: EliminationTree, dtype: DTypeLike = np.float64) -> None:
        """Args:
        tree: of the frames.
        dtype: of the factor and its sums.
        """
        self.order = tree.order
        self._dtype = dtype
        self._tree = tree
        self._panels: list[Panel] = [
            Panel(
                np.empty((6 * f.num_pivots, 6 * f.num_pivots), dtype),
                np.empty((6 * f.num_pivots, 6 * len(f.rows)), dtype),
            )
            for f in tree.fronts
        ]
        self._rows = [_in_columns(f) for f in tree.fronts]
        self._pool = _Pool(dtype)
        self._functions = _Functions.of(dtype)

    def factorize(self, blocks: Array) -> bool:
        """Factor blocks (number of blocks, 6, 6); False if they are not positive.

        Threads share the work; the digits do not depend on how many there are.
        """
        updates: dict[int, Array] = {}
        failed: list[int] = []

        def eliminate(number: int) -> None:
            if not failed and not self._eliminate_front(number, blocks, updates):
                failed.append(number)

        def branch(number: int) -> None:
            for front in self._tree.branches[number]:
                eliminate(front)

        run_chunks(branch, len(self._tree.branches))
        for number in self._tree.trunk:
            eliminate(number)
        # The last pivot of a front, after which any other NaN comes; below the diagonal
        # is what the pool's arrays held.
        pivots = [panel.own[-1, -1] for panel in self._panels]
        return not failed and bool(np.isfinite(pivots).all())

    def _eliminate_front(
        self, number: int, blocks: Array, updates: dict[int, Array]
    ) -> bool:
        """Its panel, from the updates that its children left, and its own update."""
        front, (own, rest) = self._tree.fronts[number], self._panels[number]
        own[...], rest[...] = 0.0, 0.0
        _place_blocks(blocks, front.slots, front.where, own, rest)
        given = [updates.pop(child) for child in front.children]
        for update, places in zip(given, front.maps, strict=True):
            _take_from_pivots(update, places, own, rest)
        if not self._eliminate(own, rest):
            return False
        if rest.size:
            after = self._pool.take(rest.shape[1])
            _square(rest, after)
            for update, places in zip(given, front.maps, strict=True):
                _add_to_rows(update, places, len(own), after)
            updates[number] = after
        for update in given:
            self._pool.give(update)
        return True

    def _eliminate(self, own: Array, rest: Array) -> bool:
        """Rows of L^T in place, a few at a time: most of it products of matrices. The
        inverse of a small triangle times all columns is one, too; BLAS would solve at
        half the speed."""
        potrf, trtri, trmm = self._functions[:3]
        for first in range(0, len(own), ROWS_AT_ONCE):
            part = slice(first, first + ROWS_AT_ONCE)
            if first:
                above = own[:first, part].T
                own[part, first:] -= above @ own[:first, first:]
                rest[part] -= above @ rest[:first]
            square = np.ascontiguousarray(own[part, part])
            _, info = potrf(square.T, lower=1, clean=0, overwrite_a=1)
            if info != 0:
                return False
            inverse, _ = trtri(square.T, lower=1)
            own[part, part] = square
            after = np.ascontiguousarray(own[part, first + len(square) :])
            for columns in (after, rest[part]):
                if columns.size:
                    trmm(
                        1.0,
                        inverse,
                        columns.T,
                        side=1,
                        lower=1,
                        trans_a=1,
                        overwrite_b=1,
                    )
            own[part, first + len(square) :] = after
        return True

    def solve_half(self, right: Array) -> Array:
        """L^-1 times columns (6 n, r) in the factor's order."""
        out = right.astype(self._dtype)
        for front, panel, rows in zip(
            self._tree.fronts, self._panels, self._rows, strict=True
        ):
            part = out[6 * front.first : 6 * (front.first + front.num_pivots)]
            self._functions.solve(panel.own, part, turned=False)
            if len(rows):
                out[rows] -= panel.rest.T @ part
        return out

    def solve_other_half(self, right: Array) -> Array:
        """L^-T times columns (6 n, r)."""
        out = right.astype(self._dtype)
        for front, panel, rows in zip(
            self._tree.fronts[::-1], self._panels[::-1], self._rows[::-1], strict=True
        ):
            part = out[6 * front.first : 6 * (front.first + front.num_pivots)]
            if len(rows):
                part -= panel.rest @ out[rows]
            self._functions.solve(panel.own, part, turned=True)
        return out

    def inverse_blocks(self, blocks: Array) -> None:
        """Write the blocks of A^-1 in the pattern of those of A."""
        known: dict[int, Array] = {}
        for number in range(len(self._tree.fronts) - 1, -1, -1):
            front = self._tree.fronts[number]
            own, rest = self._panels[number]
            after = known.pop(number, np.empty((0, 0)))
            root, _ = self._functions.trtri(own.T, lower=1)
            root = np.tril(root)  # L11^-1
            inverse, reach = root.T @ root, np.empty_like(rest)
            if rest.size:
                forward = root.T @ rest  # (L21 L11^-1)^T
                reach = -forward @ after
                inverse -= reach @ forward.T
            _take_blocks(front.slots, front.where, inverse, reach, blocks)
            for child, places in zip(front.children, front.maps, strict=True):
                part = np.empty((6 * len(places), 6 * len(places)))
                _gather(inverse, reach, after, places, part)
                known[child] = part


def _in_columns(front: Front):
    """Columns of a front's rows."""
    return (6 * front.rows[:, None] + np.arange(6)).ravel()
