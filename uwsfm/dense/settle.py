"""The last fraction of a pixel: Gauss-Newton along each water ray, compiled.

Chance comes near the best depth but not to it. From there the grey values of the
slanted patch and of what the neighbours show, each normalised by mean and contrast, are
linear in the inverse depth. Residuals and slopes also tell how well it is known. Where
they tell little, the hypothesis itself counts: it spread there from where they did.
"""

import numpy as np

from uwsfm._base.jit import inner, inner_fused, kernel
from uwsfm.dense.patch import RADIUS, affine, objection, shows, take_patch
from uwsfm.dense.patchmatch import choose
from uwsfm.dense.planar_prior import plain_energy, slope_energy

NUM_STEPS = 2
STILL_PX = 0.03
"""A step so short ends them: what it leaves is its square."""
HYPOTHESIS_PX = 1.0
"""Standard deviation of a hypothesis, pixels in the neighbours."""
AGREES_PX = 1.5
"""Between a point and a neighbour's hypothesis there."""
NOISE_MARGIN = 1.5
"""Plain windows scatter: so much more than theirs may be noise."""
_F = np.float32
_ZERO, _ONE, _TINY = _F(0.0), _F(1.0), _F(1e-12)
_NEXT = np.uint32(1)


def rough(image):
    """Variance of a grey image's slopes that is noise, per pixel and axis, as the
    interpolation between pixels leaves it (two thirds, on average).

    Args:
        image: (h, w).
    """
    return NOISE_MARGIN * plain_energy(slope_energy(image)) * 2.0 / 3.0


@inner_fused
def _equations(images, place, at, moved, offsets, patch, deviation):
    """Normal equation of one neighbour: slope squared, slope by error, correlation.

    Args:
        images: as in `uwsfm.dense.patch`.
        place: where the neighbour's begins, its width, and its `rough`.
        at: u, v, a, b, c, d of the affine map.
        moved: du/dw and dv/dw.
    """
    begin, width, rough = place
    u, v, a, b, c, d = at
    mean, square, product = _ZERO, _ZERO, _ZERO
    slope, slopes, by_gray, by_patch = _ZERO, _ZERO, _ZERO, _ZERO
    for k in range(offsets.shape[1]):
        x, y = offsets[0, k], offsets[1, k]
        at_x, at_y = u + a * x + b * y, v + c * x + d * y
        j, i = np.int32(at_x), np.int32(at_y)
        fx, fy = at_x - _F(j), at_y - _F(i)
        here = np.uint32(begin + np.uint32(np.int32(i * width) + j))
        under = np.uint32(here + np.uint32(width))
        across_top = images[np.uint32(here + _NEXT)] - images[here]
        across_low = images[np.uint32(under + _NEXT)] - images[under]
        top, low = images[here] + fx * across_top, images[under] + fx * across_low
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
    h = slopes - slope * slope
    # Slopes that may all be noise tell nothing, twice as much are believed.
    noise = rough * (moved[0] * moved[0] + moved[1] * moved[1])
    told = min(max(h / max(noise, _TINY) - _ONE, _ZERO), _ONE)
    h *= told / (contrast * contrast)
    e = by_patch / (deviation * contrast)
    e -= (by_gray - slope * mean) / (contrast * contrast)
    e *= told
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
        tables: `patch_offsets` (every pixel), `color_weights`, `REACH`, and (S,)
            float32 `rough` of each neighbour.
        scratch: (2, K) float32, (S + 9,) float32, (3,) and (4, 2) int64.
        found: (h, w, 5), written: inverse depth; pixels that a point moves in the
            neighbours per inverse depth, root mean square; deviation in those pixels;
            correlation; how many neighbours have the surface there, too. NaN where no
            neighbour shows it.
    """
    offsets, weights, reach, roughs = tables
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
                seen, x, y, planes, (chosen, count),
                (offsets, roughs, patch, deviation, spread), found,
            )  # fmt: skip


@inner
def _settled(seen, x, y, planes, choice, own, found):
    """One pixel."""
    images, sizes = seen[0], seen[1]
    chosen, count = choice
    offsets, roughs, patch, deviation, spread = own
    w, gx, gy = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
    held = _ONE / _F(HYPOTHESIS_PX * HYPOTHESIS_PX)
    for step in range(NUM_STEPS + 1):
        h, e, correlation, moves, used = _ZERO, _ZERO, _ZERO, _ZERO, 0
        for n in range(count):
            s = chosen[n]
            u, v, a, b, c, d, uw, vw = affine(seen, s, x, y, w, gx, gy)
            if not shows(sizes, s, u, v, a, b, c, d, _F(RADIUS)):
                continue
            at, moved = (u, v, a, b, c, d), (uw, vw)
            place = np.uint32(sizes[s, 2]), np.int32(sizes[s, 1]), roughs[s]
            h_s, e_s, like = _equations(
                images, place, at, moved, offsets, patch, deviation
            )
            h += h_s
            e += e_s
            correlation += like
            moves += uw * uw + vw * vw
            used += 1
        if used == 0:
            return
        moves = np.sqrt(moves / _F(used))
        correlation /= _F(used)
        # Normalised errors of two images that correlate: twice what is not common.
        noise = _F(2.0) * max(_ONE - correlation, _F(1e-3)) * spread
        damping = noise * held * moves * moves
        if step < NUM_STEPS:
            change = (e - damping * (w - planes[y, x, 0])) / (h + damping)
            w += min(max(change, -_ONE / moves), _ONE / moves)
            if abs(change) * moves < _F(STILL_PX):
                break
    found[y, x, 0], found[y, x, 1], found[y, x, 3] = w, moves, correlation
    found[y, x, 2] = moves * np.sqrt(noise / (h + damping))
    found[y, x, 4] = _agreeing(seen, x, y, w, gx, gy)


@inner
def _agreeing(seen, x, y, w, gx, gy):
    """How many neighbours have the surface there, too."""
    count = _ZERO
    if seen[4].shape[1] == 0:
        return count
    for s in range(seen[1].shape[0]):
        u, v, a, b, c, d, uw, vw = affine(seen, s, x, y, w, gx, gy)
        if shows(seen[1], s, u, v, a, b, c, d, _F(RADIUS)) and (
            objection(seen, s, x, y, w, u, v, uw, vw) < _F(AGREES_PX)
        ):
            count += _ONE
    return count
