"""In-air lenses over lanes: see `uwsfm.models.lens` for the models."""

import math
from typing import Final

from uwsfm._base.jit import inner, lane
from uwsfm.models.lanes import (
    BLOCK,
    LENS_U,
    LENS_V,
    OK,
    PX,
    PY,
    STRIDE,
    VX,
    VY,
    VZ,
)
from uwsfm.models.lens import (
    BROWN,
    FISHEYE,
    PINHOLE,
    brown,
    coefficients,
    fisheye_angle,
)
from uwsfm.models.lens_row import CX, CY, FX, FY, KIND, LIMIT

# Newton is quadratic: a step of 1e-8 was the last but rounding.
LAST_STEP2: Final = 1e-16


@lane
def _half_slope(x):
    """tan(a / 2) of x = tan(a), without cancellation."""
    return x / (1.0 + math.sqrt(1.0 + x * x))


@lane
def arctangent(x):
    """atan(x), x >= 0, to rounding: three halvings leave a short series."""
    x = _half_slope(_half_slope(_half_slope(x)))
    z = -x * x  # x <= tan(pi / 16): the last term is below 1e-17
    tail = 1.0 / 19.0 + z * (1.0 / 21.0 + z * (1.0 / 23.0))
    tail = 1.0 / 13.0 + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * tail))
    tail = 1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0 + z * tail))
    return 8.0 * x * (1.0 + z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * tail)))


@lane
def sine_and_cosine(angle):
    """Of 0 to 90 degrees, to rounding: the series of the half angle."""
    h = 0.5 * angle
    z = -h * h
    tail = 1.0 / 132.0 * (1.0 + z / 182.0 * (1.0 + z / 240.0))  # z^5 and beyond
    even = 1.0 + z / 56.0 * (1.0 + z / 90.0 * (1.0 + z * tail))
    cosine = 1.0 + z / 2.0 * (1.0 + z / 12.0 * (1.0 + z / 30.0 * even))
    tail = 1.0 / 156.0 * (1.0 + z / 210.0 * (1.0 + z / 272.0))
    odd = 1.0 + z / 72.0 * (1.0 + z / 110.0 * (1.0 + z * tail))
    sine = h * (1.0 + z / 6.0 * (1.0 + z / 20.0 * (1.0 + z / 42.0 * odd)))
    return 2.0 * sine * cosine, 1.0 - 2.0 * sine * sine


@lane
def _store(lens_fx, lens_fy, lens_cx, lens_cy, i, u, v, inv_z, distorted, ok, buffer):
    """Pixel and d(pixel) / dv of a lane; a lane that is not OK is to be done again."""
    x, y, xu, xv, yv = distorted
    fx, fy = lens_fx * inv_z, lens_fy * inv_z
    buffer[PX * STRIDE + i] = lens_fx * x + lens_cx
    buffer[PY * STRIDE + i] = lens_fy * y + lens_cy
    buffer[LENS_U * STRIDE + i] = fx * xu
    buffer[(LENS_U + 1) * STRIDE + i] = fx * xv
    buffer[(LENS_U + 2) * STRIDE + i] = -fx * (xu * u + xv * v)
    buffer[LENS_V * STRIDE + i] = fy * xv
    buffer[(LENS_V + 1) * STRIDE + i] = fy * yv
    buffer[(LENS_V + 2) * STRIDE + i] = -fy * (xv * u + yv * v)
    buffer[OK * STRIDE + i] *= 1.0 if ok > 0.0 else 0.0


@lane
def _none(buffer):
    """No lane is OK."""
    for i in range(BLOCK):
        buffer[OK * STRIDE + i] = 0.0


@inner
def img_lanes(lens, buffer):
    """Pixels and d(pixel) / dv of the rays in air VX, VY, VZ."""
    fx, fy, cx, cy, limit = lens[FX], lens[FY], lens[CX], lens[CY], lens[LIMIT]
    params = coefficients(lens)
    if lens[KIND] == PINHOLE:
        for i in range(BLOCK):
            z = buffer[VZ * STRIDE + i]
            inv_z = 1.0 / z
            u, v = buffer[VX * STRIDE + i] * inv_z, buffer[VY * STRIDE + i] * inv_z
            plain = (u, v, 1.0, 0.0, 1.0)
            _store(fx, fy, cx, cy, i, u, v, inv_z, plain, z, buffer)
    elif lens[KIND] == BROWN:
        for i in range(BLOCK):
            z = buffer[VZ * STRIDE + i]
            inv_z = 1.0 / z
            u, v = buffer[VX * STRIDE + i] * inv_z, buffer[VY * STRIDE + i] * inv_z
            x, y, xu, xv, yv, det = brown(u, v, params)
            ok = min(z, min(det, limit - (u * u + v * v)))
            _store(fx, fy, cx, cy, i, u, v, inv_z, (x, y, xu, xv, yv), ok, buffer)
    elif lens[KIND] != FISHEYE:  # left to the scalar kernels
        _none(buffer)
    else:
        for i in range(BLOCK):
            z = buffer[VZ * STRIDE + i]
            inv_z = 1.0 / z
            u, v = buffer[VX * STRIDE + i] * inv_z, buffer[VY * STRIDE + i] * inv_z
            s = u * u + v * v
            radius = math.sqrt(s)
            theta = arctangent(radius)
            value, slope = fisheye_angle(theta, params)
            inv_r = 1.0 / radius
            scale = value * inv_r
            scale_r = (slope / (1.0 + s) - scale) * (inv_r * inv_r)
            xu, xv, yv = (
                scale + u * u * scale_r,
                u * v * scale_r,
                scale + v * v * scale_r,
            )
            # Near the axis the quotients cancel: left to the scalar kernel.
            ok = min(z, min(limit - theta, s - 1e-8))
            bent = (u * scale, v * scale, xu, xv, yv)
            _store(fx, fy, cx, cy, i, u, v, inv_z, bent, ok, buffer)


@lane
def _undistort_step(u, v, xd, yd, params):
    """A Newton step on Brown's distortion: (u, v, squared length of the step)."""
    x, y, xu, xv, yv, det = brown(u, v, params)
    ex, ey, inv_det = x - xd, y - yd, 1.0 / det
    du, dv = (yv * ex - xv * ey) * inv_det, (xu * ey - xv * ex) * inv_det
    return u - du, v - dv, du * du + dv * dv


@lane
def _fisheye_step(theta, target, params):
    """A Newton step on the fisheye's angle: (theta, squared step)."""
    value, slope = fisheye_angle(theta, params)
    step = (value - target) / slope
    return theta - step, step * step


@inner
def dir_lanes(lens, buffer):
    """Unit directions in air VX, VY, VZ and OK of the pixels PX, PY."""
    inv_fx, inv_fy, cx, cy = 1.0 / lens[FX], 1.0 / lens[FY], lens[CX], lens[CY]
    limit, params = lens[LIMIT], coefficients(lens)
    for i in range(BLOCK):
        buffer[VX * STRIDE + i] = (buffer[PX * STRIDE + i] - cx) * inv_fx
        buffer[VY * STRIDE + i] = (buffer[PY * STRIDE + i] - cy) * inv_fy
        buffer[OK * STRIDE + i] = 1.0
    if lens[KIND] == FISHEYE:
        for i in range(BLOCK):
            xd, yd = buffer[VX * STRIDE + i], buffer[VY * STRIDE + i]
            target = math.sqrt(xd * xd + yd * yd)
            theta = min(target, 0.5 * limit)
            theta, _ = _fisheye_step(theta, target, params)
            theta, _ = _fisheye_step(theta, target, params)
            theta, _ = _fisheye_step(theta, target, params)
            theta, step2 = _fisheye_step(theta, target, params)
            sine, cosine = sine_and_cosine(theta)
            scale = sine / target
            ok = min(min(limit - theta, theta), min(LAST_STEP2 - step2, target - 1e-4))
            buffer[VX * STRIDE + i] = xd * scale
            buffer[VY * STRIDE + i] = yd * scale
            buffer[VZ * STRIDE + i] = cosine
            buffer[OK * STRIDE + i] = 1.0 if ok > 0.0 else 0.0
        return
    if lens[KIND] > FISHEYE:
        _none(buffer)
    if lens[KIND] == BROWN:
        for i in range(BLOCK):
            xd, yd = buffer[VX * STRIDE + i], buffer[VY * STRIDE + i]
            u, v, _ = _undistort_step(xd, yd, xd, yd, params)
            u, v, _ = _undistort_step(u, v, xd, yd, params)
            u, v, _ = _undistort_step(u, v, xd, yd, params)
            u, v, step2 = _undistort_step(u, v, xd, yd, params)
            # Newton may jump over the limit and back, to a false root beyond a fold.
            ok = min(
                0.81 * limit - max(xd * xd + yd * yd, u * u + v * v), LAST_STEP2 - step2
            )
            buffer[VX * STRIDE + i] = u
            buffer[VY * STRIDE + i] = v
            buffer[OK * STRIDE + i] = 1.0 if ok > 0.0 else 0.0
    for i in range(BLOCK):
        u, v = buffer[VX * STRIDE + i], buffer[VY * STRIDE + i]
        z = 1.0 / math.sqrt(1.0 + u * u + v * v)
        buffer[VX * STRIDE + i] = u * z
        buffer[VY * STRIDE + i] = v * z
        buffer[VZ * STRIDE + i] = z
