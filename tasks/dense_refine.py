"""Disparities to hundredths of a pixel: least squares on the grey levels themselves (Lucas & Kanade 1981).

Semi-global matching knows a cost at whole pixels; between them its parabola leans towards whole pixels, and on ground
that is not square to the camera it mixes what is near with what is far. Here each neighbourhood of the second image,
warped by the disparities as they are, is shifted along the row until it fits the first. Between rounds disparities are
averaged over the same neighbourhood: each is moved by the mean error around it, and where an error changes faster than
the neighbourhood is wide that mean has the other sign, so that it would grow from round to round (Le Besnerais &
Champagnat 2005).
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

WINDOW_PX = 9
_WINDOW = (WINDOW_PX, WINDOW_PX)
_ROUNDS = 2  # leave 0.005 pixels of the way
_FINER = np.float32(4)  # OpenCV looks up at 32nds of a pixel, and its cubic is a 25th of a pixel off between pixels
_LONGEST_STEP_PX = 0.5  # of a round
_FARTHEST_PX = 1.0  # from where semi-global matching put it; what goes farther found another place
_SAME_SURFACE_PX = 1.0  # neighbours that differ by more lie on another surface
_ALIKE_PX = 2.5  # pixels whose noise is alike: images are reduced, compressed and warped
_LEAST_GRADIENT = 4.0  # grey levels a pixel, rms along the row: less tells nothing of where it is


class Refined(NamedTuple):
    """Disparities (rows, columns) float32, NaN where there is none, and their 1-sigma by what still differs, pixels."""

    disparity: Array
    sigma_px: Array


def refine(found: Array, first: tuple[Pixels, Mask], second: tuple[Pixels, Mask]) -> Refined:
    """Disparities refined from `found` (rows, columns).

    first, second : evened images and where they can be used, by `dense.warp`.
    """
    # semi-global matching finds nothing at the left
    begin = max(int(np.isfinite(found).any(0).argmax()) - WINDOW_PX, 0)
    matched, one, other = found[:, begin:], first[0][:, begin:].astype(np.float32), second[0].astype(np.float32)
    start, weight = np.nan_to_num(matched).astype(np.float32), np.isfinite(matched).astype(np.float32)
    finer = cv2.resize(other, (int(_FINER) * other.shape[1], len(other)), interpolation=cv2.INTER_LANCZOS4)
    row, column = np.mgrid[: len(start), begin : found.shape[1]].astype(np.float32)
    share = np.maximum(cv2.blur(weight, _WINDOW), 1e-3)
    disparity, texture, mean_off, off = start, share, share, share
    for _ in range(_ROUNDS):
        disparity = _smoothed(disparity, weight, share)
        at = (column - disparity + 0.5) * _FINER - 0.5
        there = cv2.remap(finer, at, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        slope, off = _gradient(one + there) * weight, (there - one) * weight
        # without the window's mean: beside an image's rim the two are not evened alike
        mean, mean_off = cv2.blur(slope, _WINDOW) / share, cv2.blur(off, _WINDOW) / share
        texture = cv2.blur(slope * slope, _WINDOW) - mean * mean * share
        step = (cv2.blur(slope * off, _WINDOW) - mean * mean_off * share) / np.maximum(texture, 1e-3)
        disparity += np.clip(step, -_LONGEST_STEP_PX, _LONGEST_STEP_PX)
    left = np.maximum(cv2.blur(off * off, _WINDOW) - mean_off * mean_off * share, 0)
    sure = (texture > _LEAST_GRADIENT**2 * share) & (np.abs(disparity - start) < _FARTHEST_PX) & (weight > 0)
    variance = _ALIKE_PX * left / np.maximum(texture, 1e-3) / (WINDOW_PX**2 * share)
    refined = Refined(*(np.full(found.shape, np.nan, np.float32) for _ in range(2)))
    refined.disparity[:, begin:][sure], refined.sigma_px[:, begin:][sure] = disparity[sure], np.sqrt(variance[sure])
    return refined


def _gradient(doubled: Array) -> Array:
    """Central differences along the rows of an image that is twice as bright."""
    return np.asarray(cv2.filter2D(doubled, cv2.CV_32F, np.array([[-0.25, 0, 0.25]], np.float32)))


def _smoothed(disparity: Array, weight: Array, share: Array) -> Array:
    """Means over the window, where the surface goes on through it. share : of the window's pixels that have one."""
    mean = cv2.blur(disparity * weight, _WINDOW) / share
    return np.where(np.abs(mean - disparity) < _SAME_SURFACE_PX, mean, disparity)
