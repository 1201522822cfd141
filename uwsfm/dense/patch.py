"""How alike a slanted patch looks in an image and in a neighbour: compiled.

The patch around a pixel is taken for a plane. Its inverse depth is then linear in the
pixel, and what the exact warp table says at its middle gives an affine map from the
patch to the neighbour (its second order is below 0.05 px at the patch's corner). Alike
means the correlation weighted as in a bilateral filter: what has another brightness
than the middle is likely another surface (Schoenberger et al., ECCV 2016).

A hypothesis is (w, gx, gy): the inverse depth along the camera's axis of the point on
the pixel's water ray, and how it grows per pixel. Neighbours are one tuple ``seen``:

    images   (P,) float32 grey levels, one image after the other
    sizes    (S, 3) rows, columns and where the image begins, int64
    nodes    (S, rows, columns, levels, 3) of the `WarpTable`
    levels   (3,) of it
    planes   (S, H, W, 3) float32 hypotheses of the neighbours; (S, 0, 0, 3) if none
    scales   (2,) float32 pixels of the table per pixel here, and of those hypotheses
"""

import numpy as np

from uwsfm._base.jit import inner_fused, lane
from uwsfm.dense.warp import depth_there, warped

RADIUS, STRIDE = 4, 2
"""Pixels from the middle to the last sample, and between samples."""
NUM_SAMPLES = (2 * RADIUS // STRIDE + 1) ** 2
WORST = np.float32(2.0)
"""Cost where a neighbour does not show the patch: that of opposite patches."""
GEOMETRIC_WEIGHT, GEOMETRIC_LIMIT = np.float32(0.1), np.float32(3.0)
"""Cost per pixel between a point and what a neighbour's depth map has there (Xu and
Tao, CVPR 2019), and the pixels from where on it is no dearer: it may be hidden."""

_F = np.float32
_ZERO, _HALF, _ONE = _F(0.0), _F(0.5), _F(1.0)
_NEXT = np.uint32(1)
_SOFT = _F(1.0)
"""Grey levels squared that noise adds: plain patches are alike to no other."""
_MIN_ZOOM, _MAX_ZOOM = _F(0.05), _F(20.0)
"""Areas in the neighbour per area here."""
_SIGMA_PLACE, _SIGMA_COLOR = 4.0, 30.0


def color_weights():
    """(256,) weights of a difference of grey levels."""
    return np.exp(-0.5 * (np.arange(256) / _SIGMA_COLOR) ** 2).astype(np.float32)


def patch_offsets(radius: int = RADIUS, stride: int = STRIDE):
    """(3, K) float32: x, y and weight of the samples of a patch."""
    steps = np.arange(-radius, radius + 1, stride)
    y, x = (n.ravel() for n in np.meshgrid(steps, steps, indexing="ij"))
    weight = np.exp(-0.5 * (x * x + y * y) / _SIGMA_PLACE**2)
    return np.stack([x, y, weight]).astype(np.float32)


@inner_fused
def take_patch(image, x, y, offsets, weights, patch):
    """Write the samples around a pixel; their mean and deviation.

    Args:
        image: (h, w) float32.
        x, y: pixel.
        offsets: (3, K) of `patch_offsets`.
        weights: (256,) of `color_weights`.
        patch: (2, K), written: grey levels, less their mean, and weights that sum to 1.
    """
    middle = image[y, x]
    total, mean = _ZERO, _ZERO
    for k in range(offsets.shape[1]):
        j = min(max(x + int(offsets[0, k]), 0), image.shape[1] - 1)
        i = min(max(y + int(offsets[1, k]), 0), image.shape[0] - 1)
        gray = image[i, j]
        weight = offsets[2, k] * weights[min(int(abs(gray - middle)), 255)]
        patch[0, k], patch[1, k] = gray, weight
        total += weight
        mean += weight * gray
    mean /= total
    variance = _ZERO
    for k in range(offsets.shape[1]):
        patch[0, k] -= mean
        patch[1, k] /= total
        variance += patch[1, k] * patch[0, k] * patch[0, k]
    return mean, np.sqrt(variance + _SOFT)


@inner_fused
def _correlation(images, place, u, v, a, b, c, d, offsets, patch, deviation):
    """Of a patch with what a neighbour shows at (u + a x + b y, v + c x + d y).

    ``place`` is where its image begins, and its width, as uint32 and int32. Rows of
    offsets and unsigned indices of 32 bits: so it becomes SIMD, twice as fast.
    """
    begin, width = place
    mean, square, product = _ZERO, _ZERO, _ZERO
    for k in range(offsets.shape[1]):
        x, y = offsets[0, k], offsets[1, k]
        at_x, at_y = u + a * x + b * y, v + c * x + d * y
        j, i = np.int32(at_x), np.int32(at_y)
        fx, fy = at_x - _F(j), at_y - _F(i)
        at = np.uint32(begin + np.uint32(np.int32(i * width) + j))
        under = np.uint32(at + np.uint32(width))
        top = images[at] + fx * (images[np.uint32(at + _NEXT)] - images[at])
        low = images[under] + fx * (images[np.uint32(under + _NEXT)] - images[under])
        gray = top + fy * (low - top)
        weight = patch[1, k]
        mean += weight * gray
        square += weight * gray * gray
        product += weight * gray * patch[0, k]
    return product / (deviation * np.sqrt(max(square - mean * mean, _ZERO) + _SOFT))


@lane
def affine(seen, s, x, y, w, gx, gy):
    """The map of a patch into neighbour s, in its pixels at this scale.

    Returns:
        u, v, a, b, c, d, and how u and v change with the inverse depth.
    """
    scale = seen[5][0]
    shrink = _ONE / scale
    u, v, ux, vx, uy, vy, uw, vw = warped(
        seen[2], seen[3], s, _fine(x, scale), _fine(y, scale), w
    )
    uw, vw = uw * shrink, vw * shrink
    # A table's pixel per pixel here goes in and comes out: ux stays.
    return (
        (u + _HALF) * shrink - _HALF, (v + _HALF) * shrink - _HALF,
        ux + uw * gx, uy + uw * gy, vx + vw * gx, vy + vw * gy, uw, vw,
    )  # fmt: skip


@lane
def _fine(x, scale):
    return (_F(x) + _HALF) * scale - _HALF


@lane
def shows(sizes, s, u, v, a, b, c, d, radius):
    """Whether neighbour s shows a patch, neither squeezed nor torn."""
    across = (abs(a) + abs(b)) * radius
    down = (abs(c) + abs(d)) * radius
    zoom = a * d - b * c
    return (
        u - across >= _ZERO
        and v - down >= _ZERO
        and u + across < _F(sizes[s, 1] - 1)
        and v + down < _F(sizes[s, 0] - 1)
        and zoom > _MIN_ZOOM
        and zoom < _MAX_ZOOM
    )


@lane
def view_cost(seen, s, x, y, w, gx, gy, offsets, patch, deviation):
    """One minus the correlation with neighbour s, and what its own depths object."""
    u, v, a, b, c, d, uw, vw = affine(seen, s, x, y, w, gx, gy)
    if not shows(seen[1], s, u, v, a, b, c, d, _F(RADIUS)):
        return WORST
    place = np.uint32(seen[1][s, 2]), np.int32(seen[1][s, 1])
    cost = _ONE - _correlation(
        seen[0], place, u, v, a, b, c, d, offsets, patch, deviation
    )
    if seen[4].shape[1] > 0:
        apart = objection(seen, s, x, y, w, u, v, uw, vw)
        # Also where it is NaN: nothing is known there.
        apart = apart if apart < GEOMETRIC_LIMIT else GEOMETRIC_LIMIT
        cost += GEOMETRIC_WEIGHT * apart
    return min(cost, WORST)


@lane
def objection(seen, s, x, y, w, u, v, uw, vw):
    """How far neighbour s has the surface from a point that it sees at (u, v).

    Inverse depths are compared as the pixels that they are apart in the neighbour; NaN
    where it knows nothing.
    """
    scale, ratio = seen[5][0], seen[5][1]
    at_x, at_y = (u + _HALF) * ratio - _HALF, (v + _HALF) * ratio - _HALF
    j = min(max(int(at_x + _HALF), 0), seen[4].shape[2] - 1)
    i = min(max(int(at_y + _HALF), 0), seen[4].shape[1] - 1)
    there = seen[4][s, i, j, 0] + seen[4][s, i, j, 1] * (at_x - _F(j))
    there += seen[4][s, i, j, 2] * (at_y - _F(i))
    z, zw = depth_there(seen[2], seen[3], s, _fine(x, scale), _fine(y, scale), w)
    return abs(there - z) * np.sqrt(uw * uw + vw * vw) / max(abs(zw), _F(0.2))
