"""Flat-fielding: the mission's mean lighting is measured on small pictures of its images and divided out.

Lamps that travel with the camera, falloff towards the corners and water between lamp, seabed and lens light every
image in the same pattern; the seabed differs from image to image. So the median over images is the light.
"""

import warnings
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]

THUMBNAIL: Final = (24, 32)  # rows, columns
_MOST_GAIN: Final = 4.0
_BALANCE: Final = 0.5  # share of the way, in logarithms, from the light's own colour to grey
_SMOOTH_CELLS: Final = 1.0
_DARKEST: Final = 1.0


def thumbnail(image: Pixels, mask: NDArray[np.bool_]) -> Array32:
    """Means (24, 32, 3) of an image (H, W, 3) over its unmasked pixels; NaN where nearly all are masked."""
    size = THUMBNAIL[::-1]
    kept = (~mask).astype(np.float32)
    weight = cv2.resize(kept, size, interpolation=cv2.INTER_AREA)[..., None]
    total = cv2.resize(image.astype(np.float32) * kept[..., None], size, interpolation=cv2.INTER_AREA)
    return np.where(weight > 0.1, total / np.maximum(weight, 0.1), np.nan).astype(np.float32)


def lighting(thumbnails: Array32) -> Array32:
    """Gain (24, 32, 3) that makes the mission evenly lit, from thumbnails (n, 24, 32, 3) of its images.

    Each image's own brightness is taken out before the median over images, so a dark seabed under half of the
    images leaves no trace. The gain keeps the mission's mean brightness; its colour goes half of the way to grey,
    for full grey would raise the noise of the red that water takes.
    """
    light = np.log(np.maximum(thumbnails, _DARKEST))
    level = _median(light, axis=(1, 2), keepdims=True)
    pattern = _without_holes(_median(light - level, axis=0))
    pattern = cv2.GaussianBlur(pattern, (0, 0), _SMOOTH_CELLS, borderType=cv2.BORDER_REPLICATE)
    colour = _median(level, axis=0).reshape(3)
    target = colour + _BALANCE * (np.log(np.exp(colour).mean()) - colour)
    brightness = np.log(np.exp(pattern).mean((0, 1)))
    return np.exp(target - colour + brightness - pattern).astype(np.float32)


def _median(values: Array32, axis: int | tuple[int, ...], keepdims: bool = False) -> Array32:
    """Median of what is not NaN; NaN where all is."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        return np.nanmedian(values, axis=axis, keepdims=keepdims)


def _without_holes(pattern: Array32) -> Array32:
    """NaN of a (24, 32, 3) pattern, where the laser stands in every image, filled from around."""
    known = np.isfinite(pattern).astype(np.float32)
    filled, sigma = np.nan_to_num(pattern), 1.0
    while not known.all() and sigma < max(THUMBNAIL):
        weight = cv2.GaussianBlur(known, (0, 0), sigma)
        mean = cv2.GaussianBlur(filled * known, (0, 0), sigma) / np.maximum(weight, 1e-6)
        reached = (known == 0) & (weight > 1e-3)
        filled, known = np.where(reached, mean, filled), np.maximum(known, reached)
        sigma *= 2
    return filled.astype(np.float32)


def flatten(image: Pixels, gain: Array32) -> Pixels:
    """The image (H, W, 3) evenly lit by a gain (24, 32, 3) of `lighting`, at most fourfold."""
    full = cv2.resize(np.minimum(gain, _MOST_GAIN), image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(np.rint(image * full), 0, 255).astype(np.uint8)
