"""What tells the laser's light from that of the bottom: its colour, in linear light."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from .medians import median, running_median

Floats = NDArray[np.float32]

# What the laser adds to blue, green and red, of linear light; filters are never as narrow as that of the laser.
_LASER_BGR: Final = np.array([0.2, 1.0, 0.15])
# Noise, of that in green, that any mixture of colours is thought to have at least.
_COLOUR_DOUBT: Final = 0.003
# Channels that differ by no more than this share of the light have no colour.
_GREY: Final = 0.02
# Far less than the variance of rounding to levels.
_TINY: Final = 1e-12
_CLIPPED: Final = 252
# Blue and red, as a share of the line's green, that the laser does not have; and over their scatter.
_WHITE: Final = 0.4
_CLEARLY: Final = 6.0
_OTHER: Final = np.array([[0.5, 0, 0.5]], np.float32)
# The colour of the ground is learnt in so many rows, as it differs from the mean of some.
_SAMPLES, _GROUND_ROWS = 350, 9


@lru_cache(maxsize=4)
def linear_light(gamma: float) -> Floats:
    """Linear light (256,), 0..1, of the levels of an image."""
    return ((np.arange(256) / 255) ** gamma).astype(np.float32)


def without_grey_channels(image: NDArray[np.uint8], gamma: float) -> NDArray[np.uint8]:
    """An image (H, W[, 3]) with one channel (H, W) if all are the same: a grey image in colour."""
    if image.ndim == 2:
        return image
    some = np.ascontiguousarray(image[:: max(1, image.shape[0] // 40), :: max(1, image.shape[1] // 200)])
    blue, green, red = cv2.split(cv2.LUT(some, linear_light(gamma)))
    differ = cv2.norm(blue, green, cv2.NORM_L1) + cv2.norm(red, green, cv2.NORM_L1)
    if 1.5 * differ <= _GREY * sum(cv2.norm(channel, cv2.NORM_L1) for channel in (blue, green, red)):
        return np.asarray(cv2.extractChannel(image, 1), np.uint8)
    return image


def _weights(rough: NDArray) -> Floats:
    """Weights (3,) of blue, green and red that give the laser most over a scatter, and 1 for its own light.

    C^-1 s, with C the scatter's covariance and s the laser's colour.

    rough : (N, 3) samples of the scatter, around zero.
    """
    rough = np.ascontiguousarray(rough.T)
    limit = np.array([[4.5 * median(size) + 1e-5] for size in np.abs(rough)], np.float32)
    rough = np.minimum(np.maximum(rough, -limit), limit)
    scatter = (rough @ rough.T / rough.shape[1]).astype(float)
    scatter.ravel()[::4] += _COLOUR_DOUBT * scatter[1, 1] + _TINY
    weight = cv2.solve(scatter, _LASER_BGR[:, None], flags=cv2.DECOMP_CHOLESKY)[1].ravel()
    return (weight / (weight @ _LASER_BGR)).astype(np.float32)


def evidence(image: NDArray[np.uint8], gamma: float) -> Floats:
    """Light of the laser's colour (h, w), linear, 1 where it fills the sensor: the colour that texture least has.

    Channels are weighed by the scatter, texture and noise together, of the image from pixel to pixel.
    """
    light = np.asarray(cv2.LUT(image, linear_light(gamma)), np.float32)
    if image.ndim == 2:
        return light
    some = np.ascontiguousarray(light[2::20])
    rough = (some - cv2.blur(some, (15, 1)))[:, ::3].reshape(-1, 3)
    weight = _weights(rough)
    seen: Floats = np.asarray(cv2.transform(light, weight[None]), np.float32)
    if (image[::3, :, 1] >= _CLIPPED).mean() > 1e-4:
        # the core of an overexposed line is white between green edges
        closed = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((1, image.shape[1] // 40 | 1), np.uint8))
        np.copyto(seen, closed, where=image[..., 1] >= _CLIPPED)
    return seen


def _upright(light: NDArray, columns: int) -> Floats:
    """Means (M, N) of so many columns of light (N, columns M)."""
    upright = np.asarray(cv2.transpose(light), np.float32)
    if columns == 1:
        return upright
    part = upright.reshape(-1, columns, len(light))
    total = part[:, 0] + part[:, 1]
    for k in range(2, columns):
        total += part[:, k]
    return total / np.float32(columns)


def laser_light(shine: Floats, ground_px: float, columns: int) -> Floats:
    """Light of the laser's colour (M, N), of linear light (N, columns M[, 3]): that which varies least beside the line.

    Parameters
    ----------
    ground_px : where the ground begins, pixels from the middle.
    columns : how many to average.
    """
    if shine.ndim == 2:
        return _upright(shine, columns)
    ends = max(1, int(shine.shape[1] // 2 - ground_px))
    some = shine[:: max(1, len(shine) // _SAMPLES)]
    beside = np.concatenate([cv2.reduce(part, 1, cv2.REDUCE_AVG) for part in (some[:, :ends], some[:, -ends:])], axis=1)
    rough = (beside - cv2.blur(beside, (1, _GROUND_ROWS), borderType=cv2.BORDER_REFLECT)).reshape(-1, 3)
    return _upright(cv2.transform(shine, _weights(rough)[None]), columns)


def white_pixels(shine: Floats, light: Floats, columns: int) -> NDArray[np.bool_]:
    """Pixels (M, N) with more blue and red than the laser has: bubbles, shells, edges of pale stones.

    Parameters
    ----------
    shine : (N, columns M, 3) linear light.
    light : (M, N) that of the laser's colour, above the ground.
    columns : how many to average.
    """
    other = _upright(cv2.transform(shine, _OTHER), columns)
    usual = running_median(cv2.reduce(other, 0, cv2.REDUCE_AVG).ravel()).astype(np.float32)
    other -= usual
    middle = len(light) // 2
    height = running_median(light[middle - 1 : middle + 2].max(axis=0)).astype(np.float32)
    scatter = 1.4826 * median(np.abs(other[::3, ::16]))
    white = other > np.maximum(_WHITE * height, np.float32(_CLEARLY * scatter))
    if np.count_nonzero(white[middle]) > 0.5 * white.shape[1]:
        # where most of the line is white the image has no colour
        white[:] = False
    return white
