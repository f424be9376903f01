"""SIFT features of an image and their matches between two images (paper III.E)."""

import itertools
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.parameters import FeatureParameters
from . import interest

_SMALLEST_TILE_PX = 100.0


class Features(NamedTuple):
    """Interest points of one image.

    Attributes
    ----------
    uv : (N, 2) float32 pixels at full resolution.
    descriptors : (N, 128) uint8 SIFT.
    """

    uv: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def detect(
    grey: NDArray[np.uint8],
    ignore: NDArray[np.bool_],
    parameters: FeatureParameters,
    north_rad: float | None = None,
) -> Features:
    """SIFT descriptors at interest points of a grey image (H, W), none on pixels to ignore (H, W), such as the laser.

    Images with more than `max_pixels` are scaled down to that; the strongest features are kept evenly over the
    image, so that a bright corner does not take them all. They come strongest first.

    north_rad : direction of north in the image, from u towards v. All descriptors are taken along it, which tells
        features apart better than the direction of the gradient around each, and is as good in every image that a
        compass was near. None: along the gradients, for images whose headings are not known.
    """
    height, width = grey.shape
    scale = min(1.0, (parameters.max_pixels / grey.size) ** 0.5)
    if scale < 1:
        size = round(width * scale), round(height * scale)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    mask = np.asarray(cv2.resize(ignore.view(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)).view(bool)
    threshold = parameters.contrast_threshold * 255 / interest.LAYERS
    found = interest.find(grey, mask, threshold, parameters.max_features, north_rad is None)
    if not len(found.uv):
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    # pixel centres at integers: it is the corners of the images that coincide
    full = (found.uv + 0.5) * [width / grey.shape[1], height / grey.shape[0]] - 0.5
    return Features(full.astype(np.float32), _describe(grey, found, north_rad))


def _describe(grey: NDArray[np.uint8], found: interest.Points, north_rad: float | None) -> NDArray[np.uint8]:
    direction = found.gradient_rad if north_rad is None else np.full(len(found.uv), north_rad)
    columns = (
        *found.uv.T,
        2 * found.sigma_px,
        np.degrees(direction) % 360,
        found.response,
        found.octave | np.minimum(found.layer, interest.LAYERS) << 8,  # as OpenCV packs them
    )
    keypoints = [cv2.KeyPoint(*one) for one in zip(*(c.tolist() for c in columns), strict=True)]
    sift = cv2.SIFT_create(nOctaveLayers=interest.LAYERS, sigma=interest.FIRST_SIGMA_PX)
    return sift.compute(grey, keypoints)[1].astype(np.uint8)


def half_turned(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The descriptors (N, 128) that the image would have the other way round: 4 by 4 cells of 8 directions."""
    cells = descriptors.reshape(-1, 4, 4, 8)[:, ::-1, ::-1]
    return np.roll(cells, 4, axis=3).reshape(-1, 128)


class Expected(NamedTuple):
    """Where navigation expects the features of image a in image b: (N, 2) pixels, and how far off they may be."""

    uv: NDArray[np.floating]
    reach_px: float


def match(a: Features, b: Features, ratio: float, expected: Expected | None = None) -> NDArray[np.intp]:
    """Mutual nearest neighbours (M, 2) that pass Lowe's ratio test, by the Hellinger distance (RootSIFT).

    expected : of features of image b that are farther off, none is asked.
    """
    if len(a.uv) < 2 or len(b.uv) < 2:
        return np.zeros((0, 2), np.intp)
    root_a, root_b = unit_root(a.descriptors), unit_root(b.descriptors)
    best, first = np.zeros(len(root_a), np.intp), np.full(len(root_a), -1.0, np.float32)
    second, of_b = first.copy(), np.full(len(root_b), -1.0, np.float32)
    for rows, columns in _tiles(len(root_a), b.uv, expected):
        similarity = root_a[rows] @ root_b[columns].T
        of_b[columns] = np.maximum(of_b[columns], similarity.max(0))
        chosen, each = similarity.argmax(1), np.arange(len(rows))
        best[rows], first[rows] = columns[chosen], similarity[each, chosen]
        similarity[each, chosen] = -1
        second[rows] = similarity.max(1)
    # |a - b|^2 = 2 - 2 a.b for unit vectors
    keep = np.flatnonzero((1 - first < ratio**2 * (1 - second)) & (first >= of_b[best]) & (first > 0))
    return np.column_stack([keep, best[keep]])


def _tiles(
    count: int, uv_b: NDArray[np.float32], expected: Expected | None
) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Features of image a, each once, with those of image b that may match them: two at least."""
    if expected is None:
        return [(np.arange(count), np.arange(len(uv_b)))]
    side = max(expected.reach_px, _SMALLEST_TILE_PX)
    tile = np.floor(expected.uv / side).astype(int)
    code = tile[:, 0] * (1 << 20) + tile[:, 1]
    members = np.argsort(code, kind="stable")
    starts = np.flatnonzero(np.diff(code[members], prepend=code.min(initial=0) - 1))
    by_u = np.argsort(uv_b[:, 0], kind="stable")
    u = uv_b[by_u, 0]
    found = []
    for start, end in itertools.pairwise([*starts.tolist(), len(code)]):
        rows = members[start:end]
        low = tile[rows[0]] * side - expected.reach_px
        high = low + side + 2 * expected.reach_px
        near = np.sort(by_u[np.searchsorted(u, low[0]) : np.searchsorted(u, high[0], "right")])
        near = near[(uv_b[near, 1] >= low[1]) & (uv_b[near, 1] <= high[1])]
        if len(near) >= 2:
            found.append((rows, near))
    return found


def unit_root(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = descriptors.astype(np.float32)
    return np.sqrt(values / np.maximum(values.sum(1, keepdims=True), 1))
