"""Which keypoints see a point: chains that grow and shrink in place.

A map that grows asks this for the few points near its newest frame. Chains make the
answer as long as what is asked, however large the map: ``head[point]`` is the point's
newest keypoint, ``next[keypoint]`` the one before; -1 ends a chain.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.sfm.mapping.triangulation import Views, squared_error

IndexArray = NDArray[np.int64]


class Chains(NamedTuple):
    """The keypoints of all points; kernels change the arrays."""

    head: IndexArray
    """(P',) at least as many as there are points."""
    next: IndexArray
    """(N,)"""
    point_of: IndexArray
    """(N,) point that each keypoint sees, or -1."""

    @classmethod
    def empty(cls, num_keypoints: int) -> "Chains":
        head, *rest = (np.full(n, -1, np.int64) for n in (0, *2 * (num_keypoints,)))
        return cls(head, *rest)

    def with_room(self, num_points: int) -> "Chains":
        """Chains for so many points at least; doubling keeps the copies few."""
        if num_points <= len(self.head):
            return self
        head = np.full(max(num_points, 2 * len(self.head)), -1, dtype=np.int64)
        head[: len(self.head)] = self.head
        return self._replace(head=head)

    def link(self, keypoints: IndexArray, points: IndexArray) -> None:
        """Let keypoints (n,), which see nothing yet, see points (n,)."""
        _link(self, keypoints, points)

    def unlink(self, keypoints: IndexArray) -> None:
        """Let keypoints (n,) see nothing."""
        _unlink(self, keypoints)

    def of_points(self, points: IndexArray) -> IndexArray:
        """All keypoints that see some different points (n,), rising."""
        keypoints = np.empty(_count(self, points), dtype=np.int64)
        _gather(self, points, keypoints)
        keypoints.sort()
        return keypoints


@kernel
def _link(chains, keypoints, points):
    """Put each keypoint at the head of its point's chain."""
    for k in range(len(keypoints)):
        keypoint, point = keypoints[k], points[k]
        chains.point_of[keypoint] = point
        chains.next[keypoint] = chains.head[point]
        chains.head[point] = keypoint


@kernel
def _unlink(chains, keypoints):
    """Take keypoints out of their chains."""
    for k in range(len(keypoints)):
        keypoint = keypoints[k]
        point = chains.point_of[keypoint]
        if point < 0:
            continue
        if chains.head[point] == keypoint:
            chains.head[point] = chains.next[keypoint]
        else:
            before = chains.head[point]
            while chains.next[before] != keypoint:
                before = chains.next[before]
            chains.next[before] = chains.next[keypoint]
        chains.point_of[keypoint] = -1


@kernel
def _count(chains, points):
    """How many keypoints see some points."""
    count = 0
    for k in range(len(points)):
        keypoint = chains.head[points[k]]
        while keypoint >= 0:
            count += 1
            keypoint = chains.next[keypoint]
    return count


@kernel
def _gather(chains, points, keypoints):
    """Write the keypoints that see some points."""
    count = 0
    for k in range(len(points)):
        keypoint = chains.head[points[k]]
        while keypoint >= 0:
            keypoints[count] = keypoint
            count += 1
            keypoint = chains.next[keypoint]


def errors_px(views: Views, keypoints: IndexArray, places: Array) -> Array:
    """True pixel errors (n,) of keypoints at world points (n, 3); inf if invalid."""
    errors = np.empty(len(keypoints))
    keypoints = np.ascontiguousarray(keypoints)
    _errors_batch(views, keypoints, np.ascontiguousarray(places), errors)
    return errors


@kernel
def _errors_batch(views, keypoints, places, errors):
    """Loop over keypoints: errors (n,), written."""
    for k in range(len(keypoints)):
        x, y, z = places[k, 0], places[k, 1], places[k, 2]
        errors[k] = math.sqrt(squared_error(views, keypoints[k], x, y, z))
