"""Medians of many small arrays, fast: robust levels, widths and scatters of an image."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def median(values: NDArray) -> float:
    """The upper median of all values, none of them NaN: as numpy's, without its preparations."""
    middle = values.size // 2
    return float(np.partition(values, middle, axis=None)[middle])


def running_median(height: NDArray, rows: int = 33) -> Array:
    """Running median (N,) of heights, over so many rows, to a sixteenth of a stop, eight stops around the median."""
    every, middle = max(1, rows // 8), max(median(height), 1e-9)
    stops = np.log2(np.maximum(height[::every] * (1 / middle), 1e-3))
    steps = np.clip(16 * stops + 128, 0, 255).astype(np.uint8)
    usual = cv2.medianBlur(steps[:, None], 9).ravel()
    return np.repeat(middle * 2 ** ((usual.astype(float) - 128) / 16), every)[: len(height)]
