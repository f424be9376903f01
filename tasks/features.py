"""SIFT features of an image and their matches between two images (paper III.E)."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.parameters import FeatureParameters

_CELLS_PER_SIDE = 8


class Features(NamedTuple):
    """Interest points of one image.

    Attributes
    ----------
    uv : (N, 2) float32 pixels at full resolution.
    descriptors : (N, 128) uint8 SIFT.
    """

    uv: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def detect(grey: NDArray[np.uint8], ignore: NDArray[np.bool_], parameters: FeatureParameters) -> Features:
    """SIFT features of a grey image (H, W), none of them on pixels to ignore (H, W), such as the laser.

    Images with more than `max_pixels` are scaled down to that; the strongest features are kept evenly over the
    image, so that a bright corner does not take them all. They come strongest first.
    """
    height, width = grey.shape
    scale = min(1.0, (parameters.max_pixels / grey.size) ** 0.5)
    if scale < 1:
        size = round(width * scale), round(height * scale)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    mask = cv2.resize((~ignore).astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    # without precise upscaling all features lie a quarter of a pixel off, which bends surveys with opposite headings
    sift = cv2.SIFT_create(contrastThreshold=parameters.contrast_threshold, enable_precise_upscale=True)
    found = sift.detect(grey, mask)
    if not found:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    places, response = np.array([k.pt for k in found], np.float32), np.array([k.response for k in found])
    # descriptors cost most: only of those that are kept
    keep = _strongest_everywhere(places, response, grey.shape, parameters.max_features)
    keypoints, descriptors = sift.compute(grey, [found[k] for k in keep])
    uv = np.array([k.pt for k in keypoints], np.float32)
    # pixel centres at integers: it is the corners of the images that coincide
    full = (uv + 0.5) * [width / grey.shape[1], height / grey.shape[0]] - 0.5
    return Features(full.astype(np.float32), descriptors.astype(np.uint8))


def _strongest_everywhere(uv: NDArray, response: NDArray, shape: tuple[int, ...], count: int) -> NDArray[np.intp]:
    """Indices of at most `count` features: by rank of their response within their cell of the image."""
    column = np.minimum(uv[:, 0] * _CELLS_PER_SIDE / shape[1], _CELLS_PER_SIDE - 1).astype(int)
    row = np.minimum(uv[:, 1] * _CELLS_PER_SIDE / shape[0], _CELLS_PER_SIDE - 1).astype(int)
    cell = row * _CELLS_PER_SIDE + column
    order = np.lexsort((-response, cell))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(cell[order])) + 1])
    rank = np.arange(len(uv)) - np.repeat(starts, np.diff([*starts, len(uv)]))
    return order[np.argsort(rank, kind="stable")[:count]]


def match(descriptors_a: NDArray[np.uint8], descriptors_b: NDArray[np.uint8], ratio: float) -> NDArray[np.intp]:
    """Mutual nearest neighbours (M, 2) that pass Lowe's ratio test, by the Hellinger distance (RootSIFT)."""
    if len(descriptors_a) < 2 or len(descriptors_b) < 2:
        return np.zeros((0, 2), np.intp)
    a, b = unit_root(descriptors_a), unit_root(descriptors_b)
    similarity = a @ b.T
    rows = np.arange(len(a))
    best = similarity.argmax(1)
    first = similarity[rows, best]
    similarity[rows, best] = -1
    # |a - b|^2 = 2 - 2 a.b for unit vectors
    distinct = np.flatnonzero((1 - first) < ratio**2 * (1 - similarity.max(1)))
    back = (b[best[distinct]] @ a.T).argmax(1)  # of the few that are left: looking down columns is slow
    keep = distinct[back == distinct]
    return np.column_stack([keep, best[keep]])


def unit_root(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = descriptors.astype(np.float32)
    return np.sqrt(values / np.maximum(values.sum(1, keepdims=True), 1))
