"""Places of an image that are not to be seen, filled from around them."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

_LEAST_KNOWN: Final = 1e-3  # of all pixels that a place is filled from


def paint_over(image: Pixels, erase: Mask) -> Pixels:
    """The image (H, W, 3) with erased pixels filled from around them, coarse to fine (push-pull, Gortler 1996).

    erase (h, w) may be of a smaller image.
    """
    if not erase.any():
        return image
    kept = (~erase).astype(np.uint8)
    full = np.asarray(cv2.resize(kept, image.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    levels: list[tuple[NDArray, NDArray]] = [_known_shrunk(image, erase, full)]
    while levels[-1][1].min() < _LEAST_KNOWN and min(levels[-1][1].shape) > 1:
        colour, weight = levels[-1]
        levels.append((cv2.pyrDown(colour), cv2.pyrDown(weight)))
    filled = levels[-1][0] / np.maximum(levels[-1][1], 1e-6)[..., None]
    for colour, weight in reversed(levels[:-1]):
        filled = cv2.pyrUp(filled, dstsize=weight.shape[::-1]) * (1 - weight)[..., None] + colour
    smooth = cv2.resize(np.clip(np.rint(filled), 0, 255).astype(np.uint8), image.shape[1::-1])
    return np.asarray(cv2.copyTo(image, full, smooth), np.uint8)


def _known_shrunk(image: Pixels, erase: Mask, full: Pixels) -> tuple[NDArray, NDArray]:
    """The image as small as erase, of its pixels that are kept (full) alone, and their share."""
    size = erase.shape[1], erase.shape[0]
    if image.shape[0] % erase.shape[0] == 0 and image.shape[1] * erase.shape[0] == image.shape[0] * erase.shape[1]:
        share = (~erase).astype(np.float32)  # a small pixel is kept whole or not at all
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) * share[..., None], share
    kept = np.asarray(cv2.copyTo(image, full, np.zeros_like(image)))
    share = cv2.resize(full * np.uint8(255), size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return cv2.resize(kept, size, interpolation=cv2.INTER_AREA).astype(np.float32), share
