"""Alignment of many maps at once, from the places that neighbours share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import Similarity, align_robustly
from uwsfm.geometry.rigid3 import Array

MAX_PLACES = 300
"""Of a link that take part: more tell nothing new of six or seven numbers."""
MIN_PLACES = 20
MIN_SHARE = 0.4
"""Places of a link that must agree with one motion; else it joins nothing."""
NEAR = 3.0
"""Times the median miss: what agrees."""
EXACT = 1e-6
MAX_MISS = 0.05
"""Of the spread of a link's places: what misses each other by more is another scene."""
BELIEVED = 0.1
"""Of that spread: what a link may miss by once all maps are placed. Maps bend by less;
a link of two places that look alike is off by their distance."""
MAX_STEPS = 60
HARDER = 1.4
"""By which the loss comes nearer to the truncated one, from step to step."""


class Link(NamedTuple):
    """Places that two maps share."""

    a: int
    b: int
    in_a: Array
    """(n, 3)"""
    in_b: Array
    """(n, 3) the same places, some perhaps wrong."""


class Placement(NamedTuple):
    """Where K maps are: x_world = scale R x_map + t."""

    group: NDArray[np.int64]
    """(K,) maps of different groups have no common world."""
    scale: Array
    """(K,)"""
    world_from_map: Array
    """(K, 7) rotation, and the translation after scaling."""

    def apply(self, index: int, x: Array) -> Array:
        return rigid3.transform(self.world_from_map[index], self.scale[index] * x)

    def misses(self, link: Link) -> Array:
        """How far the places (n, 3) of a link are apart, in the world."""
        return self.apply(link.a, link.in_a) - self.apply(link.b, link.in_b)


def align_jointly(
    num_maps: int, links: Sequence[Link], *, with_scale: bool, seed: int = 0
) -> Placement:
    """Place maps so that what neighbours share coincides.

    First link by link, robustly; then along the strongest links from map to map; then
    all maps together, by least squares that spread what is left over at the end of a
    loop, and give up links that contradict the others.

    Args:
        num_maps: K.
        links: Between different maps.
        with_scale: Else all scales are 1.
        seed: Of the places and of the samples.
    """
    rng = np.random.default_rng(seed)
    sound: list[Link] = []
    motions: list[Similarity] = []
    for link in links:
        found = _sound(_thinned(link, rng), with_scale, seed)
        if found is not None:
            sound.append(found[0])
            motions.append(found[1])
    placement = _along_tree(num_maps, sound, motions)
    if not sound:
        return placement
    spreads = np.array([_spread(link.in_b) for link in sound])
    spreads *= placement.scale[[link.b for link in sound]]
    hardness = None
    for _ in range(MAX_STEPS):
        misses = [placement.misses(link) for link in sound]
        rms = np.array([np.sqrt(np.mean(np.sum(m**2, axis=1))) for m in misses])
        squares = (rms / (BELIEVED * spreads)) ** 2
        if hardness is None:
            hardness = 1.0 / max(2.0 * float(squares.max()) - 1.0, 1e-3)
        weights = _link_weights(squares, hardness)
        step = _step(placement, sound, misses, weights, with_scale)
        placement = _moved(placement, step)
        hardness *= HARDER
        if np.abs(step).max() < 1e-10 and np.all((weights == 0.0) | (weights == 1.0)):
            break
    return placement


def _link_weights(squares: Array, hardness: float) -> Array:
    """Weights of links by their squared misses over what is believed: those of a loss
    that begins as least squares, so that loops can close, and ends truncated (Yang et
    al., graduated non-convexity, RA-L 2020)."""
    weights = np.sqrt(hardness * (hardness + 1.0) / np.maximum(squares, 1e-300))
    return np.clip(weights - hardness, 0.0, 1.0)


def _spread(places: Array) -> float:
    return float(np.linalg.norm(np.std(places, axis=0)))


def _thinned(link: Link, rng: np.random.Generator) -> Link:
    if len(link.in_a) <= MAX_PLACES:
        return link
    chosen = np.sort(rng.choice(len(link.in_a), MAX_PLACES, replace=False))
    return link._replace(in_a=link.in_a[chosen], in_b=link.in_b[chosen])


def _sound(link: Link, with_scale: bool, seed: int) -> tuple[Link, Similarity] | None:
    """The places of a link that agree with one motion b from a; None: too few do."""
    if len(link.in_a) < MIN_PLACES:
        return None
    # Far better than they are: then the misses themselves tell what agrees.
    exact = np.broadcast_to(EXACT**2 * np.eye(3), (len(link.in_a), 3, 3))
    motion = align_robustly(
        link.in_a, link.in_b, exact, with_scale=with_scale, seed=seed
    )
    misses = np.linalg.norm(motion.apply(link.in_a) - link.in_b, axis=1)
    good = misses <= max(NEAR * float(np.median(misses)), 1e-9)
    if not np.median(misses[good]) <= MAX_MISS * _spread(link.in_b[good]):
        return None
    if np.count_nonzero(good) < max(MIN_PLACES, MIN_SHARE * len(good)):
        return None
    return link._replace(in_a=link.in_a[good], in_b=link.in_b[good]), motion


def _along_tree(
    num_maps: int, links: Sequence[Link], motions: Sequence[Similarity]
) -> Placement:
    """Carry the place of a group's first map along its strongest links."""
    ends = np.array([(link.a, link.b) for link in links], dtype=np.int64).reshape(-1, 2)
    graph = csr_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(num_maps, num_maps)
    )
    _, group = connected_components(graph, directed=False)
    placed = np.zeros(num_maps, dtype=bool)
    placed[np.unique(group, return_index=True)[1]] = True
    scale, poses = np.ones(num_maps), np.tile(rigid3.IDENTITY, (num_maps, 1))
    order = sorted(range(len(links)), key=lambda k: -len(links[k].in_a))
    while True:
        new = next((k for k in order if placed[ends[k, 0]] != placed[ends[k, 1]]), None)
        if new is None:
            return Placement(group.astype(np.int64), scale, poses)
        (a, b), motion = ends[new].tolist(), motions[new]
        if placed[a]:  # b's place follows from the inverse motion
            a_from_b = rigid3.inverse(motion.y_from_x)
            a_from_b[4:] /= motion.scale
            scale[b] = scale[a] / motion.scale
            a_from_b[4:] *= scale[a]
            poses[b] = rigid3.compose(poses[a], a_from_b)
        else:
            b_from_a = motion.y_from_x.copy()
            b_from_a[4:] *= scale[b]
            scale[a] = scale[b] * motion.scale
            poses[a] = rigid3.compose(poses[b], b_from_a)
        placed[[a, b]] = True


def _step(
    placement: Placement,
    links: Sequence[Link],
    misses: Sequence[Array],
    weights: Array,
    with_scale: bool,
) -> Array:
    """Gauss-Newton step (K, 7): turn, shift and log of the scale, about the world.

    The first map of each group stays where it is.
    """
    num_maps, size = len(placement.scale), 7
    hessian = np.zeros((num_maps, size, num_maps, size))
    gradient = np.zeros((num_maps, size))
    for link, miss, weight in zip(links, misses, weights, strict=True):
        slopes = []
        for index, places, sign in ((link.a, link.in_a, 1.0), (link.b, link.in_b, -1)):
            slope = sign * _slope(placement.apply(index, places))
            slopes.append((index, slope))
            gradient[index] += weight * np.einsum("nik,ni->k", slope, miss)
        for i, slope_i in slopes:
            for j, slope_j in slopes:
                hessian[i, :, j] += weight * np.einsum(
                    "nik,nil->kl", slope_i, slope_j, optimize=True
                )
    free = np.ones((num_maps, size), dtype=bool)
    free[np.unique(placement.group, return_index=True)[1]] = False
    free[:, 6] &= with_scale
    chosen = free.ravel()
    step = np.zeros(chosen.size)
    matrix = hessian.reshape(chosen.size, chosen.size)[np.ix_(chosen, chosen)]
    # Places on a line leave a turn about it open: the smallest one.
    step[chosen] = -np.linalg.lstsq(matrix, gradient.ravel()[chosen], rcond=1e-13)[0]
    return step.reshape(num_maps, size)


def _slope(places: Array) -> Array:
    """(n, 3, 7) how world places (n, 3) move with turn, shift and log of the scale."""
    slope = np.zeros((len(places), 3, 7))
    x, y, z = places.T
    slope[:, 0, 1], slope[:, 0, 2] = z, -y
    slope[:, 1, 0], slope[:, 1, 2] = -z, x
    slope[:, 2, 0], slope[:, 2, 1] = y, -x
    slope[:, :, 3:6] = np.eye(3)
    slope[:, :, 6] = places
    return slope


def _moved(placement: Placement, step: Array) -> Placement:
    larger = np.exp(step[:, 6])
    poses = placement.world_from_map.copy()
    poses[:, 4:] *= larger[:, None]
    return placement._replace(
        scale=placement.scale * larger,
        world_from_map=rigid3.perturb(poses, step[:, :6]),
    )
