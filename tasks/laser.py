"""Laser points in an image (paper III.B): where each row crosses a line of light, to a fraction of a pixel.

The paper's structure is kept: green channel stretched to 0-255, second derivative along the rows by a kernel
applied twice, one threshold on intensity and one on the derivative, the positive-negative-positive sequence, orphans
rejected. Four things are added, because a strobe-lit bottom breaks global statistics:

- the image is first reduced, by averaging, to the scale at which the kernel answers to the line that is there, so
  that 3600 px and 1200 px wide images are treated alike and large ones cost little more than small ones;
- intensity is measured above the local background (a median of the reduced image): the mean of the paper's
  "mean + k sigma" is the mean of the place, and vignetting does not hide the line in dark corners;
- sigma is robust (median absolute deviation), for the line itself would otherwise raise it;
- orphans are judged by the chain of points from row to row that they belong to, and in colour images by its colour.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.parameters import LaserParameters

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

KERNEL: Final = np.array([-1, -1, -1, 0, 1, 1, 1], np.float32)
_TWICE: Final = np.convolve(KERNEL, KERNEL).astype(np.float32)[None]
_NOISE_GAIN: Final = float(np.sqrt((_TWICE**2).sum()))
_REDUCTIONS: Final = (1, 2, 3, 4, 6, 8, 12, 16)
_SMALLEST_PX: Final = 160
# The positive peaks beside a line's negative one lie 3 to 9 px from it.
_LOBE_OFFSET, _LOBE_HALFWIDTH = 6, 3
_LOBE_SHARE: Final = 0.2
_WINDOW_PX: Final = 12
_SPECKLE_PX: Final = 0.25
# Glow is no farther from the line than so many times what its light reaches.
_GLOW_REACHES: Final = 8.0


class LaserPoints(NamedTuple):
    """Points of laser lines in one image, sorted by row.

    Attributes
    ----------
    uv : (N, 2) pixels of the full image; v is the middle of the rows that were averaged.
    prominence : (N,) height of the line above the background beside it, grey levels.
    sigma_px : (N,) 1-sigma of u, pixels.
    width_px : (N,) standard deviation of the line's profile along the row, pixels.
    step_px : distance between rows, pixels: the reduction at which the line was found.
    """

    uv: Array
    prominence: Array
    sigma_px: Array
    width_px: Array
    step_px: int

    def take(self, keep: NDArray) -> "LaserPoints":
        """The points that a mask or an index array (N,) selects."""
        uv, prominence, sigma_px, width_px = (field[keep] for field in self[:4])
        return LaserPoints(uv, prominence, sigma_px, width_px, self.step_px)


def no_points(step_px: int = 1) -> LaserPoints:
    """Nothing found."""
    none = np.zeros(0)
    return LaserPoints(np.zeros((0, 2)), none, none, none, step_px)


def detect(image_bgr: NDArray[np.uint8], parameters: LaserParameters) -> LaserPoints:
    """Points where the rows of an image cross a laser line (paper III.B).

    Rows are scanned, so a line has to run across them: give the transposed image for a line along the rows.

    Parameters
    ----------
    image_bgr : (H, W, 3) colour or (H, W) grey, uint8
    parameters : thresholds

    Returns
    -------
    LaserPoints, without any point where an image has no line.
    """
    if min(image_bgr.shape[:2]) < _SMALLEST_PX:
        return no_points()
    step = reduction(image_bgr)
    height, width = (side // step for side in image_bgr.shape[:2])
    size = (width, height)
    whole = image_bgr[: height * step, : width * step]
    small = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)
    green = _green(small).astype(np.float32)
    low, high = float(green.min()), float(green.max())
    if high - low < 4:
        return no_points(step)
    stretch = 255 / (high - low)
    stretched = (green - low) * stretch
    second = np.asarray(cv2.filter2D(stretched, -1, _TWICE, borderType=cv2.BORDER_REPLICATE), np.float32)
    noise = _noise(second, stretch)
    rows, columns, strong = candidates(stretched, second, noise, parameters)
    keep = strong if small.ndim == 2 else _green_light(small, rows, columns, parameters.colour_share)
    rows, columns, strong = rows[keep], columns[keep], strong[keep]
    chain = linked(rows, columns, (height, width))
    keep = np.bincount(chain, strong)[chain] >= parameters.chain_min_points
    rows, columns = rows[keep], columns[keep]
    u, sigma, prominence = _peaks(stretched, rows, columns)
    keep = _foremost(rows, u, prominence, 3 * float(np.median(sigma)) if len(sigma) else 0)
    rows, (u, sigma, prominence) = rows[keep], (field[keep] for field in (u, sigma, prominence))
    uncertainty = _uncertainty(u, rows, sigma, prominence * _NOISE_GAIN / noise)
    middle = 0.5 * (step - 1)
    uv = np.column_stack([u, rows]).astype(np.float64) * step + middle
    return LaserPoints(uv, prominence / stretch, uncertainty * step, sigma * step, step)


def _green(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 2 else np.asarray(cv2.extractChannel(image, 1), np.uint8)


def reduction(image_bgr: NDArray[np.uint8]) -> int:
    """By how much to reduce an image (H, W[, 3]) so that its line is as narrow as the kernel: a whole number.

    The kernel applied twice answers best to a line of 1.5 px (1 sigma) and with half of that to one of 4 px. In
    some rows, spread over the image, the strongest complete sequence (both positive peaks and the negative one
    between them) is measured at each reduction; the finest that has half of the best is taken. In colour images it
    is measured on what green has beyond the other two, so that grey texture does not count.
    """
    every = max(1, image_bgr.shape[0] // 96)
    rows = _greener(image_bgr[every // 2 :: every])
    strength = []
    for factor in _REDUCTIONS:
        width = image_bgr.shape[1] // factor
        if min(width, image_bgr.shape[0] // factor) < _SMALLEST_PX:
            break
        reduced = cv2.resize(rows, (width, len(rows)), interpolation=cv2.INTER_AREA).astype(np.float32)
        second = cv2.filter2D(reduced, -1, _TWICE, borderType=cv2.BORDER_REPLICATE)
        lobes = cv2.dilate(second, np.ones((1, 2 * _LOBE_HALFWIDTH + 1), np.uint8))
        middle = slice(_LOBE_OFFSET, width - _LOBE_OFFSET)
        beside = np.minimum(lobes[:, : -2 * _LOBE_OFFSET], lobes[:, 2 * _LOBE_OFFSET :])
        strength.append(float(np.median(np.minimum(-second[:, middle], 2 * beside).max(axis=1))))
    enough = [factor for factor, s in zip(_REDUCTIONS, strength, strict=False) if s >= 0.5 * max(strength)]
    return enough[0]


def _greener(image_bgr: NDArray[np.uint8]) -> Floats:
    """What green (H, W) has beyond blue and red; the grey level itself where there is no colour."""
    if image_bgr.ndim == 2:
        return image_bgr.astype(np.float32)
    blue, green, red = (image_bgr[..., k].astype(np.float32) for k in range(3))
    excess = green - 0.5 * (blue + red)
    if np.abs(excess).mean() <= 1:
        return green
    # the core of an overexposed line is white between green edges
    width = image_bgr.shape[1] // 40 | 1
    closed = cv2.morphologyEx(excess, cv2.MORPH_CLOSE, np.ones((1, width), np.uint8))
    return np.where(green >= 250, closed, excess).astype(np.float32)


def _noise(second: Floats, stretch: float) -> float:
    """Robust sigma of the second derivative, not below that of rounding to whole grey levels."""
    return max(1.4826 * float(np.median(np.abs(second[::3, ::5]))), _NOISE_GAIN * stretch / np.sqrt(12))


def candidates(
    green: Floats, second: Floats, noise: float, parameters: LaserParameters
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Rows and columns of the pixels that pass both thresholds and the sequence of peaks (paper III.B).

    Also those that pass at half the thresholds; the third array says which are strong. A faint stretch (a face turned
    away, a dark stone) is kept for the strong line that it continues.
    """
    contrast = green - _background(green)
    floor = parameters.intensity_sigmas * 1.4826 * float(np.median(np.abs(contrast[::3, ::5])))
    ceiling = -parameters.curvature_sigmas * noise
    valley = cv2.erode(second, np.ones((1, 5), np.uint8))
    mask = (second < 0.5 * ceiling) & (second <= valley) & (contrast > 0.5 * floor)
    reach = _WINDOW_PX + 1
    mask[:, :reach] = mask[:, -reach:] = False
    rows, columns = np.nonzero(mask)
    span = np.arange(-_LOBE_HALFWIDTH, _LOBE_HALFWIDTH + 1)
    for side in (-_LOBE_OFFSET, _LOBE_OFFSET):
        lobe = second[rows[:, None], columns[:, None] + side + span].max(axis=1)
        keep = lobe > -_LOBE_SHARE * second[rows, columns]
        rows, columns = rows[keep], columns[keep]
    return rows, columns, (second[rows, columns] < ceiling) & (contrast[rows, columns] > floor)


def _background(green: Floats) -> Floats:
    """What a pixel would be without the line: the median over about 1/20 of the image around it."""
    height, width = green.shape
    small = cv2.resize(green, (max(width // 8, 16), max(height // 8, 16)), interpolation=cv2.INTER_AREA)
    smooth = cv2.medianBlur(small.astype(np.uint8), 9)
    return cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32)


def _peaks(green: Floats, rows: Indices, columns: Indices) -> tuple[Array, Array, Array]:
    """Sub-pixel column, width (1 sigma) and prominence of each line crossing.

    The column is the fixed point of a centroid above the local background (a straight line between the two ends
    of the window) under a Gaussian weight 1.5 times as wide as the line: the peak of a matched filter. It uses the
    whole profile, so a saturated plateau or speckle on the crest does not draw it to one side.
    """
    offset = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
    profile = green[rows[:, None], columns[:, None] + offset].astype(np.float64)
    left, right = (np.median(profile[:, end], axis=1) for end in (slice(0, 4), slice(-4, None)))
    share = (offset + _WINDOW_PX) / (2 * _WINDOW_PX)
    profile = np.maximum(profile - left[:, None] - (right - left)[:, None] * share, 0)
    centre, sigma = np.zeros(len(rows)), np.full(len(rows), 2.0)
    for _ in range(8):
        wide = 1.5 * sigma
        weight = profile * np.exp(-0.5 * ((offset - centre[:, None]) / wide[:, None]) ** 2)
        total = np.maximum(weight.sum(axis=1), 1e-9)
        step = (weight * (offset - centre[:, None])).sum(axis=1) / total
        spread = (weight * (offset - centre[:, None]) ** 2).sum(axis=1) / total
        # the weight narrows a Gaussian profile: 1/spread = 1/sigma^2 + 1/wide^2
        sigma = np.clip(np.sqrt(1 / np.maximum(1 / np.maximum(spread, 1e-3) - 1 / wide**2, 0.03)), 0.5, 4.0)
        centre = np.clip(centre + 1.3 * step, -4, 4)
    return columns + centre, sigma, profile[:, _WINDOW_PX - 1 : _WINDOW_PX + 2].mean(axis=1)


def linked(rows: Indices, columns: Indices, shape: tuple[int, int]) -> NDArray[np.int32]:
    """Number of the line (N,) that each pixel is on: neighbours within 3 rows and 7 columns hang together."""
    mask = np.zeros(shape, np.uint8)
    mask[rows, columns] = 1
    grown = cv2.dilate(mask, np.ones((3, 7), np.uint8))
    number = np.asarray(cv2.connectedComponents(grown, connectivity=8, ltype=cv2.CV_32S)[1], np.int32)
    return number[rows, columns]


def _green_light(small: NDArray[np.uint8], rows: Indices, columns: Indices, share: float) -> NDArray[np.bool_]:
    """Which candidates have the laser's colour.

    A pale stone adds to blue and red what it adds to green, in proportion to the light that falls on it; the laser
    adds much less to them. Clipped pixels are left out. Nothing can be told in grey images, on wholly clipped lines,
    and where the line outshines all white light, beside it or in the middle of the image: no texture does that.
    """
    offset = np.arange(-_WINDOW_PX, _WINDOW_PX + 1)
    profile = small[rows[:, None], columns[:, None] + offset].astype(np.float32)
    if not len(rows) or np.abs(profile - profile[..., 1:2]).mean() < 1:
        return np.ones(len(rows), bool)
    beside = 0.5 * (np.median(profile[:, :4], axis=1) + np.median(profile[:, -4:], axis=1))
    crest = profile[:, np.abs(offset) <= 4]
    weight = (crest[..., 1] < 250)[..., None].astype(np.float32)
    added = (weight * (crest - beside[:, None])).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    other = (added[:, 0] + added[:, 2]) * beside[:, 1]
    expected = (beside[:, 0] + beside[:, 2]) * added[:, 1]
    white = np.minimum(beside[:, 1], np.median(small[::3, ::5, 1]))
    return (other < share * expected) | (added[:, 1] > white) | (weight.sum(axis=(1, 2)) < 3)


def _foremost(rows: Indices, u: Array, prominence: Array, apart_px: float) -> Indices:
    """Sorted by row and column, without the lesser of neighbours in a row nearer than apart_px.

    Speckle gives a broad crossing several peaks; the centroids of all of them measure the same line.
    """
    order = np.lexsort((u, rows))
    while len(order) > 1:
        near = (np.diff(rows[order]) == 0) & (np.diff(u[order]) < apart_px)
        if not near.any():
            break
        left_is_less = prominence[order][:-1] < prominence[order][1:]
        lesser = np.zeros(len(order), bool)
        lesser[:-1] |= near & left_is_less
        lesser[1:] |= near & ~left_is_less
        order = order[~lesser]
    return order


def _uncertainty(u: Array, rows: Indices, sigma: Array, signal_to_noise: Array) -> Array:
    """1-sigma of each point's column: pixel noise by its Cramér-Rao bound, 1.06 sqrt(sigma)/SNR, and speckle.

    Speckle is the same for all points of an image; it is what the scatter of the points about the straight line
    between their neighbours four rows above and below has beyond the pixel noise.
    """
    bound = 1.06 * np.sqrt(sigma) / np.maximum(signal_to_noise, 1)
    gap = 4
    above, below = _nearest_in_row(u, rows, rows - gap), _nearest_in_row(u, rows, rows + gap)
    paired = (rows[above] == rows - gap) & (rows[below] == rows + gap)
    paired &= (np.abs(u[above] - u) < 3 * gap) & (np.abs(u[below] - u) < 3 * gap)
    if paired.sum() < 20:
        return np.hypot(bound, _SPECKLE_PX)
    scatter = (u - 0.5 * (u[above] + u[below]))[paired]
    # median of a squared normal variable: 0.4549 of its variance; the scatter has 1 + 2/4 of a point's variance
    variance = np.median(scatter**2) / 0.4549 / 1.5 - np.median(bound[paired] ** 2)
    return np.sqrt(bound**2 + max(variance, (0.1 * _SPECKLE_PX) ** 2))


def _nearest_in_row(u: Array, rows: Indices, wanted: Indices) -> Indices:
    """For each point, which point of the wanted row is nearest to its column (any point where that row has none)."""
    if not len(u):
        return np.zeros(0, np.intp)
    scale = 4.0 * (u.max() + 1)
    key = rows * scale + u
    order = np.argsort(key, kind="stable")
    place = np.searchsorted(key[order], wanted * scale + u)
    right, left = (order[np.clip(place + shift, 0, len(u) - 1)] for shift in (0, -1))
    distance_right, distance_left = (np.abs(key[n] - wanted * scale - u) for n in (right, left))
    return np.where(distance_left < distance_right, left, right)


def distance_in_row(points: LaserPoints) -> Array:
    """Distance (N,) in pixels of each point from the nearest other one in its row; infinite where it is alone."""
    uv = points.uv
    order = np.lexsort((uv[:, 0], uv[:, 1]))
    gap = np.where(np.diff(uv[order, 1]) == 0, np.diff(uv[order, 0]), np.inf)
    distance = np.empty(len(uv))
    distance[order] = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf))
    return distance


def mask(shape: tuple[int, int], uv: Array, halfwidth_px: float) -> NDArray[np.bool_]:
    """The pixels (H, W) to take from an image's texture because the laser is on them.

    Parameters
    ----------
    shape : height and width of the image.
    uv : (N, 2) pixels along the line of light, without gaps (triangulation.ImageSoundings.line_uv).
    halfwidth_px : how far the light reaches to each side along a row.
    """
    drawn = np.zeros(shape, np.uint8)
    radius = max(1, round(halfwidth_px))
    fixed = np.round(np.asarray(uv).reshape(-1, 2)).astype(int)
    inside = ((fixed >= -radius) & (fixed < np.array(shape[::-1]) + radius)).all(axis=1)
    for u, v in fixed[inside].tolist():
        cv2.circle(drawn, (u, v), radius, 1, cv2.FILLED)
    return drawn.view(bool)


def glow(image_bgr: NDArray[np.uint8], line_uv: Array, halfwidth_px: float, patch_px: tuple[float, float]) -> Array:
    """Pixels (M, 2) of laser light that mask() would leave: faint or running along the rows, where no row has a peak.

    Patches greener, by 15 %, and brighter in green than what is around them, that hang together with the line found
    (line_uv) and are near it. Green leaves are no brighter than the sand around them.

    Parameters
    ----------
    image_bgr : (H, W, 3) or (H, W).
    line_uv : (N, 2) pixels of the image along the line found.
    halfwidth_px : how far its light reaches to each side along a row, columns of the image.
    patch_px : columns and rows that are averaged before colour is judged.
    """
    if image_bgr.ndim == 2 or not len(line_uv):
        return np.zeros((0, 2))
    scale = np.array(patch_px)
    width, height = (np.array(image_bgr.shape[1::-1]) / scale).astype(int).tolist()
    columns, rows = np.round(scale * (width, height)).astype(int)
    small = np.asarray(cv2.resize(image_bgr[:rows, :columns], (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    # eight grey levels keep the noise of a dark image from counting as colour; 64 makes no colour a quarter of 255
    blue, green, red = (small[..., k].astype(np.float32) + 8 for k in range(3))
    ratio = np.minimum(128 * green / (blue + red), 255).astype(np.uint8)
    drawn = _discs((height, width), (line_uv + 0.5) / scale - 0.5, halfwidth_px / scale[0])
    away = cv2.distanceTransform((~drawn).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    lit = (ratio > 1.15 * _around(ratio)) & (small[..., 1] > _around(small[..., 1]))
    lit &= away < (_GLOW_REACHES - 1) * halfwidth_px / scale[0]
    patch = np.asarray(cv2.connectedComponents(lit.view(np.uint8), connectivity=8)[1], np.intp)
    touched = np.zeros(int(patch.max()) + 1, bool)
    touched[patch[drawn]] = True
    touched[0] = False
    rows, columns = np.nonzero(touched[patch] & ~drawn)
    return (np.column_stack([columns, rows]).astype(np.float64) + 0.5) * scale - 0.5


def _around(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Medians (H, W) of a fifth of an image around, of every third pixel."""
    height, width = values.shape
    median = cv2.medianBlur(np.ascontiguousarray(values[::3, ::3]), min(width, height) // 15 | 1)
    return np.asarray(cv2.resize(median, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def _discs(shape: tuple[int, int], uv: Array, halfwidth_px: float) -> NDArray[np.bool_]:
    """What mask() gives, of a small image."""
    radius = max(1, round(halfwidth_px))
    height, width = shape
    drawn = np.zeros((height + 2 * radius, width + 2 * radius), np.uint8)
    column, row = (part + radius for part in np.round(uv).astype(np.intp).T)
    inside = (column >= 0) & (column < drawn.shape[1]) & (row >= 0) & (row < drawn.shape[0])
    drawn[row[inside], column[inside]] = 1
    disc = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    cv2.circle(disc, (radius, radius), radius, 1, cv2.FILLED)
    return np.asarray(cv2.dilate(drawn, disc), bool)[radius:-radius, radius:-radius]
