"""Simulated seabed colour: an image of albedo over the terrain's square, row 0 north."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.scene import TextureScene
from .simulation_terrain import fractal_noise

Array32 = NDArray[np.float32]

MEAN_ALBEDO = 0.4
_SUBPIXEL_BITS = 4
# Colour of sediment relative to its grey level, red, green, blue.
_SEDIMENT = (1.08, 1.0, 0.9)
# Mottling longer than this many texels is made on a coarser grid.
_COARSE = 4


def make_texture(
    scene: TextureScene, half_m: float, rng: np.random.Generator, period_m: float = 0.0
) -> NDArray[np.uint8]:
    """Albedo (n, n, 3), red green blue, 0..255 for 0..1, over the square from -half_m to +half_m.

    Sediment mottled at every scale down to a texel, under stones and shells with sharp outlines and colours
    of their own.

    period_m : it repeats itself after this, as with the scene's own period_m. 0: never.
    """
    whole = round(2 * half_m / scene.cell_m)
    period = round((period_m or scene.period_m) / scene.cell_m)
    size = period if 0 < period < whole else whole
    coarse = fractal_noise(-(-size // _COARSE), _COARSE * scene.cell_m, 2.0, 1.3, rng).astype(np.float32)
    grey = 0.8 * cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    grain = rng.standard_normal((size, size), np.float32)
    grey += 0.25 * grain + 0.6 * cv2.GaussianBlur(grain, (0, 0), 1.2) / np.float32(0.235)
    grey = np.float32(MEAN_ALBEDO * 255) * (1 + np.float32(scene.contrast) * grey)
    albedo = np.dstack([np.clip(tint * grey, 8, 247).astype(np.uint8) for tint in _SEDIMENT])
    for _ in range(rng.poisson(scene.spots_per_m2 * (size * scene.cell_m) ** 2)):
        _add_spot(albedo, scene, rng)
    if size == whole:
        return albedo
    index = np.arange(whole) % period
    return albedo[np.ix_(index, index)]


def _add_spot(albedo: NDArray[np.uint8], scene: TextureScene, rng: np.random.Generator) -> None:
    """Draws one ellipse, in place: most are a centimetre across, few a decimetre."""
    radius = min(0.004 * (1 - rng.uniform()) ** -0.7, 0.05) / scene.cell_m
    centre = rng.uniform(0, len(albedo), 2)
    axes = radius * np.array([1, rng.uniform(0.45, 1.0)])
    level = MEAN_ALBEDO * np.exp(3 * scene.contrast * rng.standard_normal())
    colour = np.clip(255 * level * np.array(_SEDIMENT) * rng.normal(1, 0.15, 3), 5, 250)
    fixed = [tuple(int(v * (1 << _SUBPIXEL_BITS)) for v in pair) for pair in (centre, axes)]
    angle = rng.uniform(0, 180)
    cv2.ellipse(albedo, fixed[0], fixed[1], angle, 0, 360, colour.tolist(), -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def blurred(texture: NDArray[np.uint8], texel_m: float, pixel_m: float) -> NDArray[np.uint8]:
    """The texture as pixels larger than its texels average it, so that it can be sampled at points."""
    excess = (pixel_m / texel_m) ** 2 - 1
    if excess <= 0:
        return texture
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), 0.5 * float(np.sqrt(excess))), np.uint8)


def sample(texture: NDArray[np.uint8], half_m: float, x: NDArray, y: NDArray) -> Array32:
    """Albedo (H, W, 3), 0..1, at local positions x, y (H, W)."""
    per_m = texture.shape[0] / (2 * half_m)
    column, row = (np.asarray(v, np.float32) for v in ((x + half_m) * per_m - 0.5, (half_m - y) * per_m - 0.5))
    albedo = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(albedo, np.float32) / np.float32(255)
