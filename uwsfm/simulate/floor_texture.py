"""A procedural sea floor seen from above: sand, pebbles, stones, growth, sea stars.

Detail at every scale from millimetres to a metre, and no repetition: features can be
matched wherever the camera is, and only with the right ones.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from uwsfm.simulate.texture import Image, Plane

TO_LIGHT = np.array([-0.47, -0.36, -0.81]) / np.linalg.norm([0.47, 0.36, 0.81])
"""From the floor to the light, in a frame with z down: fixed in the world, so that the
shading is part of the texture and no image sees it move."""

SAND = (192, 174, 140)
MUD = (130, 122, 106)
ROCK = (128, 120, 110)
GREEN_ALGAE = (96, 104, 60)
BROWN_ALGAE = (104, 88, 58)
CORALLINE = (160, 104, 112)
STONES = (
    (150, 140, 125),
    (120, 112, 100),
    (95, 90, 84),
    (175, 165, 148),
    (132, 112, 92),
    (112, 90, 76),
    (186, 178, 166),
    (72, 70, 68),
    (140, 128, 110),
    (118, 120, 112),
)
SEA_STARS = ((196, 96, 48), (176, 62, 52), (204, 150, 84))


@dataclass(frozen=True, kw_only=True)
class _Stones:
    """A population of stones; lengths in metres."""

    per_square_metre: float
    smallest: float
    largest: float
    exponent: float = 2.4
    """Of the power law of their radii: natural gravel has many more small ones."""
    brightness: float = 1.0


GRAVEL = _Stones(per_square_metre=1400, smallest=0.003, largest=0.009)
COBBLES = _Stones(per_square_metre=420, smallest=0.009, largest=0.055, exponent=2.6)
SHELLS = _Stones(per_square_metre=300, smallest=0.0025, largest=0.007, brightness=1.5)


@dataclass(frozen=True, eq=False)
class _Canvas:
    """Height above the mean, metres, and colour; changed in place while painting."""

    height: Plane
    """(H, W)"""
    color: Image
    """(H, W, 3)"""
    texel: float
    rng: np.random.Generator

    def noise(self, longest: float, shortest: float, gain: float) -> Plane:
        """Fractal noise (H, W) over wavelengths in metres."""
        return fractal_noise(
            self.height.shape,
            longest / self.texel,
            shortest / self.texel,
            gain,
            self.rng,
        )


def sea_floor_image(
    size: tuple[float, float], texel: float, rng: np.random.Generator
) -> Image:
    """Paint a sea floor (H, W, 3).

    Args:
        size: Extent along x and y, metres.
        texel: Side of a texel, metres.
        rng: Decides everything.
    """
    canvas = _empty_canvas(size, texel, rng)
    patches = canvas.noise(0.8, 0.05, 0.6)
    bumps = canvas.noise(0.12, 0.008, 0.6)
    canvas.height[:] = 0.004 * bumps + 0.010 * patches
    grain = 0.03 * bumps + 0.012 * canvas.noise(0.006, 0.0015, 0.8)
    _blend(canvas, SAND, grain, np.ones_like(bumps))
    _blend(canvas, MUD, grain, _step(patches, 0.0, 2.2))
    del bumps, grain
    # Stones gather where the mud is.
    density = 0.25 + 0.75 * _step(patches, 0.2, 3.0)
    ground = canvas.height.copy()
    for population in (GRAVEL, COBBLES, SHELLS):
        _scatter(canvas, population, ground, density)
    del density
    _grow(canvas, GREEN_ALGAE, patch=0.25, threshold=1.2, opacity=0.7)
    _grow(canvas, CORALLINE, patch=0.16, threshold=1.6, opacity=0.6)
    _sea_stars(canvas, per_square_metre=0.9)
    return _shaded(canvas)


def rock_image(side: float, texel: float, rng: np.random.Generator) -> Image:
    """Paint the overgrown surface of a boulder (H, W, 3); lengths in metres."""
    canvas = _empty_canvas((side, side), texel, rng)
    broad = canvas.noise(0.2, 0.01, 0.65)
    rough = canvas.noise(0.05, 0.003, 0.65)
    cracks = np.exp(-((canvas.noise(0.12, 0.01, 0.6) / 0.05) ** 2))
    canvas.height[:] = 0.004 * rough + 0.006 * broad - 0.004 * cracks
    _blend(canvas, ROCK, 0.08 * rough + 0.12 * broad, np.ones_like(rough))
    _grow(canvas, BROWN_ALGAE, patch=0.15, threshold=0.3, opacity=0.6)
    _grow(canvas, GREEN_ALGAE, patch=0.12, threshold=1.1, opacity=0.7)
    _grow(canvas, CORALLINE, patch=0.10, threshold=1.0, opacity=0.7)
    ground = canvas.height.copy()
    _scatter(canvas, SHELLS, ground, np.full_like(rough, 0.6))
    return _shaded(canvas)


def fractal_noise(
    shape: tuple[int, ...],
    longest: float,
    shortest: float,
    gain: float,
    rng: np.random.Generator,
) -> Plane:
    """Smooth noise (H, W) of about unit variance.

    Args:
        shape: (H, W).
        longest: Wavelength of the first octave, pixels; each next one is half as long.
        shortest: No octave is shorter than this, pixels.
        gain: Amplitude of an octave relative to the one before.
        rng: Decides everything.
    """
    total = np.zeros(shape, dtype=np.float32)
    amplitude, power, wavelength = 1.0, 0.0, longest
    while wavelength >= max(shortest, 1.0) or power == 0.0:
        grid_size = [int(np.ceil(side / wavelength)) + 5 for side in shape]
        grid = rng.standard_normal(grid_size, dtype=np.float32)
        size = [int(np.ceil(cells * wavelength)) for cells in grid_size]
        octave = cv2.resize(grid, size[::-1], interpolation=cv2.INTER_CUBIC)
        edge = int(2 * wavelength)
        total += amplitude * octave[edge : edge + shape[0], edge : edge + shape[1]]
        power += amplitude**2
        amplitude, wavelength = gain * amplitude, 0.5 * wavelength
    total /= 0.7 * np.sqrt(power)  # cubic interpolation leaves half of the variance
    return total


def _empty_canvas(
    size: tuple[float, float], texel: float, rng: np.random.Generator
) -> _Canvas:
    shape = round(size[1] / texel), round(size[0] / texel)
    height = np.zeros(shape, dtype=np.float32)
    return _Canvas(height, np.zeros((*shape, 3), dtype=np.uint8), texel, rng)


def _step(values: Plane, center: float, steepness: float) -> Plane:
    """A smooth step (H, W) from 0 to 1."""
    return 1.0 / (1.0 + np.exp(-steepness * (values - center)))


def _blend(canvas: _Canvas, color: tuple, mottle: Plane, alpha: Plane) -> None:
    """Paint a colour, made lighter and darker by ``mottle``, with opacity ``alpha``."""
    for start in range(0, len(canvas.color), 512):  # in strips, for memory's sake
        rows = slice(start, start + 512)
        weight = alpha[rows, :, None]
        paint = np.array(color, np.float32) * (1.0 + mottle[rows, :, None])
        mixed = (1.0 - weight) * canvas.color[rows] + weight * paint
        canvas.color[rows] = np.clip(mixed, 0, 255)


def _grow(
    canvas: _Canvas, color: tuple, *, patch: float, threshold: float, opacity: float
) -> None:
    """Cover where a fractal field exceeds a threshold, with a thin mat of growth."""
    mask = _step(canvas.noise(patch, 0.006, 0.72), threshold, 9.0)
    mat = canvas.noise(0.012, 0.002, 0.85)
    canvas.height[:] += 0.0006 * mask * mat
    _blend(canvas, color, 0.15 * mat, opacity * mask)


def _scatter(canvas: _Canvas, stones: _Stones, ground: Plane, density: Plane) -> None:
    """Lay stones on the ground, the largest first."""
    rng, shape = canvas.rng, canvas.height.shape
    area = shape[0] * shape[1] * canvas.texel**2
    power = 1.0 - stones.exponent
    low, high = stones.smallest**power, stones.largest**power
    share = rng.uniform(size=round(area * stones.per_square_metre))
    radii = np.sort((low + share * (high - low)) ** (1.0 / power))[::-1]
    side = int(4 * stones.largest / canvas.texel) + 64
    mottle = fractal_noise((side, side), 0.016 / canvas.texel, 2.0, 0.65, rng)
    palette = np.array(STONES) * stones.brightness
    for radius in radii:
        y, x = rng.uniform(size=2) * shape
        if rng.uniform() > density[int(y), int(x)]:
            continue
        color = palette[rng.integers(len(palette))] * rng.uniform(0.75, 1.2)
        outline = rng.uniform(0.0, 1.0, 3) * [0.28, 0.09, 0.05], rng.uniform(0, 6.3, 3)
        # Half of the flat stone stands out of the ground.
        lift = -0.12 * radius, radius * rng.uniform(0.3, 0.55)
        _lay(canvas, ground, (y, x), radius, color, outline, lift, mottle)


def _sea_stars(canvas: _Canvas, per_square_metre: float) -> None:
    rng, shape = canvas.rng, canvas.height.shape
    area = shape[0] * shape[1] * canvas.texel**2
    side = int(0.4 / canvas.texel) + 64
    mottle = fractal_noise((side, side), 6.0, 2.0, 0.9, rng)
    for _ in range(round(area * per_square_metre)):
        color = np.array(SEA_STARS[rng.integers(len(SEA_STARS))], dtype=np.float64)
        arms = np.array([0.0, 0.0, 0.55]), rng.uniform(0, 6.3, 3)
        radius = rng.uniform(0.025, 0.05)
        y, x = rng.uniform(size=2) * shape
        # On top of the stones, if there are any.
        _lay(canvas, canvas.height, (y, x), radius, color, arms, (0.003, 0.012), mottle)


def _lay(
    canvas: _Canvas,
    ground: Plane,
    place: tuple[float, float],
    radius: float,
    color: np.ndarray,
    outline: tuple[np.ndarray, np.ndarray],
    lift: tuple[float, float],
    mottle: Plane,
) -> None:
    """Lay one rounded thing where it is higher than what is there already.

    Args:
        canvas: Changed in place.
        ground: What it lies on (H, W), under its centre.
        place: Row and column of its centre.
        radius: Metres.
        color: (3,)
        outline: Amplitudes (3,) and phases (3,) of 2, 3 and 5 lobes of its outline.
        lift: Height of its rim above the ground and of its top above the rim, metres.
        mottle: Noise, larger than twice the thing, that makes it lighter and darker.
    """
    rng, (y, x) = canvas.rng, place
    size = radius / canvas.texel
    reach = int(1.7 * size) + 2
    shape = canvas.height.shape
    rows = slice(max(int(y) - reach, 0), min(int(y) + reach + 1, shape[0]))
    columns = slice(max(int(x) - reach, 0), min(int(x) + reach + 1, shape[1]))
    dy = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None] - np.float32(y)
    dx = np.arange(columns.start, columns.stop, dtype=np.float32) - np.float32(x)
    angle = np.arctan2(dy, dx)
    edge = np.full_like(angle, size)
    for lobes, amplitude, phase in zip((2, 3, 5), *outline, strict=True):
        edge *= 1.0 + np.float32(amplitude) * np.cos(lobes * angle + np.float32(phase))
    profile = 1.0 - ((dx * dx + dy * dy) / (edge * edge)) ** 2
    top, left = rng.integers(0, np.array(mottle.shape) - profile.shape + 1)
    noise = mottle[top : top + profile.shape[0], left : left + profile.shape[1]]
    height = (
        np.sqrt(np.maximum(profile, 0.0)) * lift[1] + lift[0] + 0.016 * radius * noise
    )
    height += ground[int(y), int(x)]
    inside = (profile > 0.0) & (height > canvas.height[rows, columns])
    canvas.height[rows, columns][inside] = height[inside]
    paint = color * (1.0 + 0.15 * noise[inside][:, None])
    canvas.color[rows, columns][inside] = np.clip(paint, 5, 255)


def _shaded(canvas: _Canvas) -> Image:
    """The colours under the light, darker in hollows and beside stones."""
    shaded = np.empty_like(canvas.color)
    reach = 2 * int(0.01 / canvas.texel) + 1
    hollow = np.maximum(cv2.blur(canvas.height, (reach, reach)) - canvas.height, 0.0)
    step = 1.0 / (8.0 * canvas.texel)
    for start in range(0, len(shaded), 512):
        rows = slice(max(start - 1, 0), start + 513)
        inner = slice(start - rows.start, start - rows.start + 512)
        block = canvas.height[rows]
        slope_x = cv2.Sobel(block, cv2.CV_32F, 1, 0, scale=step)[inner]
        slope_y = cv2.Sobel(block, cv2.CV_32F, 0, 1, scale=step)[inner]
        # With z down, height h is the surface z = -h; its normal is (-h_x, -h_y, -1).
        facing = -slope_x * TO_LIGHT[0] - slope_y * TO_LIGHT[1] - TO_LIGHT[2]
        facing /= np.sqrt(1.0 + slope_x**2 + slope_y**2)
        light = 0.35 + 0.65 * np.maximum(facing, 0.0) / -TO_LIGHT[2]
        light *= 0.45 + 0.55 * np.exp(-hollow[start : start + 512] / 0.006)
        bright = canvas.color[start : start + 512] * np.sqrt(light)[..., None]
        shaded[start : start + 512] = np.clip(bright, 0, 255)
    return shaded
