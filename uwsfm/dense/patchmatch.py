"""PatchMatch: hypotheses spread over the image and are refined by chance, compiled.

Each pixel keeps the hypothesis, depth and slope, under which the patch around it looks
alike in a few neighbours. Pixels of one colour of a chessboard try those of the other
(Galliani et al., ICCV 2015), of each direction the best within reach; neighbours count
by how well they show what the pixels around hold, so that hidden ones drop out (Xu and
Tao, CVPR 2019). Chance is a function of pixel, round and seed: runs repeat exactly.
"""

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.dense.patch import WORST, affine, take_patch, view_cost

NUM_CHOSEN = 3
"""Neighbours that count for a pixel."""
REACH = np.array(
    [
        [(1, 0), (2, 1), (2, -1), (3, 0), (5, 0), (11, 0)],
        [(-1, 0), (-2, 1), (-2, -1), (-3, 0), (-5, 0), (-11, 0)],
        [(0, 1), (1, 2), (-1, 2), (0, 3), (0, 5), (0, 11)],
        [(0, -1), (1, -2), (-1, -2), (0, -3), (0, -5), (0, -11)],
    ],
    dtype=np.int64,
)
"""(4, 6, 2): x and y of pixels of the other colour, in four directions."""
_F = np.float32
_ZERO, _HALF, _ONE, _TWO = _F(0.0), _F(0.5), _F(1.0), _F(2.0)
_GOOD, _BAD = _F(0.8), _F(1.2)
"""Costs below which a neighbour shows the same, and above which something else."""
_MAX_SLOPE = _F(5.0)
"""Tangent between a surface and the plane across the camera's axis."""
_MIX = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLY = np.uint64(0xBF58476D1CE4E5B9)
_S1, _S2 = np.uint64(30), np.uint64(27)
_PER_UNIT = _F(1.0 / 2**24)
_DOWN = np.uint64(40)


@inner
def _random(state):
    """The next state and a number in [-1, 1) (SplitMix, Steele et al. 2014)."""
    state = state + _MIX
    mixed = (state ^ (state >> _S1)) * _MULTIPLY
    mixed = (mixed ^ (mixed >> _S2)) * _MIX
    return state, _TWO * _F(mixed >> _DOWN) * _PER_UNIT - _ONE


@inner
def _all_costs(seen, x, y, planes, offsets, patch, deviation, costs):
    w, gx, gy = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
    for s in range(costs.shape[2] - 1):
        costs[y, x, s] = view_cost(seen, s, x, y, w, gx, gy, offsets, patch, deviation)


@kernel
def rate(image, seen, planes, costs, tables, scratch):
    """Costs of the hypotheses there are, in every neighbour.

    Args:
        image: (h, w) float32.
        seen: of `uwsfm.dense.patch`.
        planes: (h, w, 3) hypotheses.
        costs: (h, w, S + 1), written: of each neighbour, and of the best two together.
        tables: `patch_offsets`, `color_weights`.
        scratch: (2, K) float32.
    """
    offsets, weights = tables
    num = costs.shape[2] - 1
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            _, deviation = take_patch(image, x, y, offsets, weights, scratch)
            _all_costs(seen, x, y, planes, offsets, scratch, deviation, costs)
            costs[y, x, num] = _best_two(costs, x, y, num)


@inner
def _best_two(costs, x, y, num):
    best, second = WORST, WORST
    for s in range(num):
        cost = costs[y, x, s]
        if cost < best:
            best, second = cost, best
        elif cost < second:
            second = cost
    return _HALF * (best + second)


@inner
def choose(costs, x, y, reach, share, chosen, nearby):
    """The neighbours that count at a pixel; how many.

    Args:
        costs: (h, w, S + 1).
        reach: `REACH`.
        share: (S + 9,), written: from S on the shares of the three chosen. What
            hypotheses cost there follows: of the last one, and of the best.
        chosen: (3,), written.
        nearby: (4, 2), written: the pixels with the best hypothesis of each direction.
            They have a say beside the pixel itself.
    """
    num = costs.shape[2] - 1
    _nearby(costs, x, y, reach, nearby)
    for s in range(num):
        share[s] = _worth(costs, x, y, nearby, s)
    count, total = 0, _ZERO
    for n in range(NUM_CHOSEN):
        best = -1
        for s in range(num):
            if share[s] > _ZERO and (best < 0 or share[s] > share[best]):
                best = s
        if best < 0:
            break
        chosen[n] = best
        share[num + n] = share[best]
        total += share[best]
        share[best] = _ZERO
        count += 1
    for n in range(count):
        share[num + n] /= total
    if count == 0:
        # Nobody shows this: the two that show it best may be right.
        count = _least(costs, x, y, num, chosen, share)
    return count


@inner
def _worth(costs, x, y, nearby, s):
    """How well neighbour s shows what is held here and nearby; zero if hidden."""
    good, bad, worth = 0, 0, _ZERO
    for n in range(5):
        i = y if n == 4 else nearby[n, 1]
        j = x if n == 4 else nearby[n, 0]
        cost = costs[i, j, s]
        if cost < _GOOD:
            good += 1
            worth += (_GOOD - cost) * (_GOOD - cost)
        elif cost > _BAD:
            bad += 1
    return worth / _F(good) if good >= 2 and bad <= 2 else _ZERO


@inner
def _score(seen, x, y, w, gx, gy, num, choice, offsets, patch, deviation, limit):
    """Cost of a hypothesis over the neighbours that count; more than limit: any.

    The cost in each of them is left behind their shares.
    """
    chosen, share, count = choice
    total, tried = _ZERO, num + NUM_CHOSEN
    for n in range(count):
        cost = view_cost(seen, chosen[n], x, y, w, gx, gy, offsets, patch, deviation)
        share[tried + n] = cost
        total += share[num + n] * cost
        if total >= limit:
            break
    return total


@inner
def _nearby(costs, x, y, reach, found):
    """Of each direction the pixel whose hypothesis costs least (4, 2)."""
    height, width, num = costs.shape
    for n in range(4):
        best, found[n, 0], found[n, 1] = _F(9.0), x, y
        for m in range(reach.shape[1]):
            j, i = x + reach[n, m, 0], y + reach[n, m, 1]
            if 0 <= i < height and 0 <= j < width and costs[i, j, num - 1] < best:
                best = costs[i, j, num - 1]
                found[n, 0], found[n, 1] = j, i


@kernel
def spread(images, seen, planes, costs, tables, chance, limits, scratch):
    """One round: all pixels of one colour try hypotheses, then those of the other.

    Args:
        images: (h, w) float32, and (h, w) bool of pixels that keep what they have.
        seen: of `uwsfm.dense.patch`.
        planes: (h, w, 3) hypotheses, improved.
        costs: (h, w, S + 1) of each neighbour and of those that count; kept with them.
        tables: `patch_offsets`, `color_weights`, `REACH`.
        chance: (2,) uint64, seed and number of the round.
        limits: (6,) float32: least and largest inverse depth, focal length in pixels,
            and how far chance goes: pixels in the neighbours, tangent of the slope;
            share of pixels that try any depth.
        scratch: (2, K) float32, (S + 9,) float32, (3,) and (4, 2) int64.
    """
    image, held = images
    height, width = image.shape
    offsets, weights, reach = tables
    patch, share, chosen, nearby = scratch
    for color in range(2):
        for y in range(height):
            for x in range((y + color) % 2, width, 2):
                if held[y, x]:
                    continue
                count = choose(costs, x, y, reach, share, chosen, nearby)
                _, deviation = take_patch(image, x, y, offsets, weights, patch)
                state = (chance[0] * _MIX) ^ (
                    (chance[1] * np.uint64(height) + np.uint64(y)) * np.uint64(width)
                    + np.uint64(x)
                ) * _MULTIPLY
                _improve(
                    seen, x, y, planes, costs, (chosen, share, count), nearby,
                    (offsets, patch, deviation), limits, state,
                )  # fmt: skip


@inner
def _least(costs, x, y, num, chosen, share):
    first, second = 0, -1
    for s in range(1, num):
        if costs[y, x, s] < costs[y, x, first]:
            first, second = s, first
        elif second < 0 or costs[y, x, s] < costs[y, x, second]:
            second = s
    chosen[0], chosen[1] = first, max(second, 0)
    share[num], share[num + 1] = _HALF, _HALF
    return 2


@inner
def _improve(seen, x, y, planes, costs, choice, nearby, own, limits, state):
    """Try hypotheses at one pixel and keep the best."""
    offsets, patch, deviation = own
    chosen, share, count = choice
    num = costs.shape[2] - 1
    w, gx, gy = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
    best = _ZERO
    for n in range(count):
        best += share[num + n] * costs[y, x, chosen[n]]
    changed = False
    pixel = _pixel_of(seen, chosen[0], x, y, w)
    state, dice = _random(state)
    tries = 8 if _HALF * (dice + _ONE) < limits[5] else 7
    for n in range(tries):
        if n < 5:
            tw, tx, ty = _from_nearby(planes, x, y, w, nearby, n)
        else:
            state, tw, tx, ty = _by_chance(state, n, w, gx, gy, pixel, limits)
        # The same again: there is nothing to try.
        if abs(tw - w) < _F(0.02) * pixel and (
            abs(tx - gx) + abs(ty - gy) < _F(0.005) * pixel
        ):
            continue
        steep = _MAX_SLOPE * tw / limits[2]
        if not (limits[0] <= tw <= limits[1] and abs(tx) + abs(ty) < steep):
            continue
        score = _score(
            seen, x, y, tw, tx, ty, num, choice, offsets, patch, deviation, best
        )
        if score < best:
            best, w, gx, gy, changed = score, tw, tx, ty, True
            for m in range(count):
                share[num + 2 * NUM_CHOSEN + m] = share[num + NUM_CHOSEN + m]
    costs[y, x, num] = best
    if changed:
        planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, gx, gy
        _other_costs(seen, x, y, (w, gx, gy), choice, own, costs)


@inner
def _other_costs(seen, x, y, hypothesis, choice, own, costs):
    """Costs of a new hypothesis: known in those that count, found in the others."""
    (w, gx, gy), (chosen, share, count) = hypothesis, choice
    offsets, patch, deviation = own
    num = costs.shape[2] - 1
    for s in range(num):
        rated = False
        for n in range(count):
            if chosen[n] == s:
                costs[y, x, s], rated = share[num + 2 * NUM_CHOSEN + n], True
        if not rated:
            costs[y, x, s] = view_cost(
                seen, s, x, y, w, gx, gy, offsets, patch, deviation
            )


@inner
def _from_nearby(planes, x, y, w, nearby, n):
    """That of a pixel nearby, followed to here; fifth, the slope of those around."""
    if n < 4:
        j, i = nearby[n, 0], nearby[n, 1]
        tx, ty = planes[i, j, 1], planes[i, j, 2]
        return planes[i, j, 0] + tx * _F(x - j) + ty * _F(y - i), tx, ty
    if x < 1 or y < 1 or x >= planes.shape[1] - 1 or y >= planes.shape[0] - 1:
        return w, planes[y, x, 1], planes[y, x, 2]
    tx = _HALF * (planes[y, x + 1, 0] - planes[y, x - 1, 0])
    ty = _HALF * (planes[y + 1, x, 0] - planes[y - 1, x, 0])
    return w, tx, ty


@inner
def _by_chance(state, n, w, gx, gy, pixel, limits):
    """Another depth; another slope; or anything. The state and the hypothesis."""
    state, r0 = _random(state)
    state, r1 = _random(state)
    state, r2 = _random(state)
    if n == 5:
        return state, w + r0 * limits[3] * pixel, gx, gy
    if n == 6:
        tilt = limits[4] * w / limits[2]
        moved = w + _F(0.25) * r0 * limits[3] * pixel
        return state, moved, gx + r1 * tilt, gy + r2 * tilt
    any_w = limits[0] + _HALF * (r0 + _ONE) * (limits[1] - limits[0])
    return state, any_w, r1 * any_w / limits[2], r2 * any_w / limits[2]


@inner
def _pixel_of(seen, s, x, y, w):
    """Inverse depth that moves a point by a pixel in neighbour s."""
    out = affine(seen, s, x, y, w, _ZERO, _ZERO)
    moved = np.sqrt(out[6] * out[6] + out[7] * out[7])
    return _ONE / moved if moved > _ZERO else _ONE
