"""The last fraction of a pixel: Gauss-Newton along each water ray, compiled.

Chance comes near the best depth but not to it. From there the grey values of the
slanted patch and of what the neighbours show, each normalised by mean and contrast, are
linear in the inverse depth. Residuals and slopes also tell how well it is known.
"""

import numpy as np

from uwsfm._jit import inner, inner_fused, kernel
from uwsfm.dense.patch import RADIUS, affine, shows, take_patch
from uwsfm.dense.patchmatch import choose

NUM_STEPS = 3
MAX_MOVE_PX = 1.5
"""Farther from where it began a step has gone astray."""
_F = np.float32
_ZERO, _ONE = _F(0.0), _F(1.0)
_NEXT = np.uint32(1)


@inner_fused
def _equations(image, width, at, moved, offsets, patch, deviation):
    """Normal equation of one neighbour: slope squared, slope by error, error squared.

    Args:
        image: (H * W,) of the neighbour.
        at: u, v, a, b, c, d of the affine map.
        moved: du/dw and dv/dw.
    """
    u, v, a, b, c, d = at
    mean, square, product = _ZERO, _ZERO, _ZERO
    slope, slopes, by_gray, by_patch = _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(offsets.shape[1]):
        x, y = offsets[0, k], offsets[1, k]
        at_x, at_y = u + a * x + b * y, v + c * x + d * y
        j, i = np.int32(at_x), np.int32(at_y)
        fx, fy = at_x - _F(j), at_y - _F(i)
        here = np.uint32(np.int32(i * width) + j)
        under = np.uint32(here + np.uint32(width))
        across_top = image[np.uint32(here + _NEXT)] - image[here]
        across_low = image[np.uint32(under + _NEXT)] - image[under]
        top, low = image[here] + fx * across_top, image[under] + fx * across_low
        gray = top + fy * (low - top)
        change = (across_top + fy * (across_low - across_top)) * moved[0]
        change += (low - top) * moved[1]
        weight, own = patch[1, k], patch[0, k]
        mean += weight * gray
        square += weight * gray * gray
        product += weight * gray * own
        slope += weight * change
        slopes += weight * change * change
        by_gray += weight * change * gray
        by_patch += weight * change * own
    contrast = np.sqrt(max(square - mean * mean, _ZERO) + _ONE)
    # Errors are own / deviation - (gray - mean) / contrast, slopes less their mean.
    h = (slopes - slope * slope) / (contrast * contrast)
    e = by_patch / (deviation * contrast)
    e -= (by_gray - slope * mean) / (contrast * contrast)
    correlation = product / (deviation * contrast)
    return h, e, correlation


@kernel
def settle(image, seen, planes, costs, tables, scratch, found):
    """Gauss-Newton steps of the inverse depth, the slope held.

    Args:
        image: (h, w) float32.
        seen: of `uwsfm.dense.patch`.
        planes: (h, w, 3) hypotheses.
        costs: (h, w, S + 1) of them.
        tables: `patch_offsets` (every pixel), `color_weights`, `REACH`.
        scratch: (2, K) float32, (S + 3,) float32, (3,) and (4, 2) int64.
        found: (h, w, 4), written: inverse depth; pixels that a point moves in the
            neighbours per inverse depth, root mean square; deviation in those pixels
            by slopes and residuals; correlation. NaN where no neighbour shows it.
    """
    offsets, weights, reach = tables
    patch, share, chosen, nearby = scratch
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            found[y, x, :] = np.nan
            count = choose(costs, x, y, reach, share, chosen, nearby)
            _, deviation = take_patch(image, x, y, offsets, weights, patch)
            spread = _ZERO
            for k in range(offsets.shape[1]):
                spread += patch[1, k] * patch[1, k]
            _settled(
                seen, x, y, planes[y, x], (chosen, count),
                (offsets, patch, deviation, spread), found[y, x],
            )  # fmt: skip


@inner
def _settled(seen, x, y, plane, choice, own, found):
    """One pixel."""
    images, sizes = seen[0], seen[1]
    chosen, count = choice
    offsets, patch, deviation, spread = own
    w, gx, gy = plane[0], plane[1], plane[2]
    for step in range(NUM_STEPS + 1):
        h, e, correlation, moves, used = _ZERO, _ZERO, _ZERO, _ZERO, 0
        for n in range(count):
            s = chosen[n]
            u, v, _, a, b, c, d, uw, vw, _ = affine(seen, s, x, y, w, gx, gy)
            if not shows(sizes[s], u, v, a, b, c, d, _F(RADIUS)):
                continue
            at, moved = (u, v, a, b, c, d), (uw, vw)
            width = np.int32(sizes[s, 1])
            h_s, e_s, like = _equations(
                images[s], width, at, moved, offsets, patch, deviation
            )
            h += h_s
            e += e_s
            correlation += like
            moves += uw * uw + vw * vw
            used += 1
        if used == 0:
            return
        moves = np.sqrt(moves / _F(used))
        if step == NUM_STEPS or h <= _ZERO:
            break
        # A pixel at most, where the slopes are none.
        most = _ONE / moves
        w += min(max(e / (h + _F(1e-3) * moves * moves), -most), most)
    if not abs(w - plane[0]) * moves < _F(MAX_MOVE_PX):
        w = plane[0]
    correlation /= _F(used)
    # Normalised errors of two images that correlate: twice what is not common.
    noise = _F(2.0) * max(_ONE - correlation, _F(1e-3))
    found[0], found[1], found[3] = w, moves, correlation
    found[2] = moves * np.sqrt(noise * spread / max(h, _F(1e-12)))
