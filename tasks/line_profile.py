"""Where a line of light is in each row, to the bound that the pixels' noise sets.

Around a roughly known line each row's profile, in linear light, is fitted by a Gaussian on a sloping ground: least
squares with each pixel's weight from its noise, which is the maximum likelihood. Clipped pixels, those outside the
image and those that the other arm lights have no weight. Rows are measured one by one, so that steps stay sharp;
only what changes slowly along the line (ground, width, noise) is shared between neighbours.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from . import gaussian_fit
from .laser_colour import laser_light, linear_light, white_pixels
from .medians import median, running_median
from .sheet_search import Arms, Piece

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]

_CLIPPED: Final = 250
# Columns are not averaged where the crest is clipped in more than this share of rows.
_GLARING: Final = 0.5
# Arms nearer than so many widths of the line are not told apart.
APART: Final = 4.5
# A point less sure than this share of the width is none; nor is one so many times as bright as its neighbours.
_VAGUE: Final = 0.5
_BRIGHT: Final = 3.0
# Nor, near an end of the line, one that has less than this share of its neighbours' brightness.
_FADING: Final = 0.5
# What the light of the other side of a step adds to sigma there, widths.
_EDGE: Final = 0.19
# Nor one whose profile is so much less like a line than those around it.
_MISFIT: Final = 4.0
# The same in grey images, of the usual misfit and brightness along an arm; and the share of such rows, of so many
# side by side, that makes none of them believed.
_ODD, _GREY_BRIGHT, _GREY_STOPS = 2.0, 4.0, 0.6
_CROWD, _CROWD_ROWS = 0.2, 17
# A stretch of line in a grey image ends where it steps aside, in widths and columns a row; shorter ones, in widths, are
# not believed.
_STEP_WIDTHS, _STEEPEST, _SHORT_WIDTHS = 0.7, 1.5, 12.0
# Nor is an arm of which less than this share is seen, of the rows from its first to its last point.
_COVERED: Final = 0.4
# How far from the line's rough place, in widths, it may be found.
_ASTRAY: Final = 1.2
_LEAST_SNR: Final = 4.0
# Neighbours that scatter is measured by, rows; at least, and in widths.
_LAG_ROWS, _LAG_WIDTHS = 4, 2.0


class Line(NamedTuple):
    """Points of both arms, by arm, then piece, then row.

    Attributes
    ----------
    uv : (N, 2) pixels; v is a whole row.
    arm : (N,) uint8, index of the sheet.
    sigma_px : (N,) 1-sigma of u, pixels.
    width_px : (N,) standard deviation of the line's profile along the row, pixels.
    signal_to_noise : (N,) height of the line over that height's 1-sigma.
    """

    uv: Array
    arm: NDArray[np.uint8]
    sigma_px: Array
    width_px: Array
    signal_to_noise: Array


class _Rows(NamedTuple):
    """Rows to measure, one entry each: row, rough column, column of the other arm there (NaN: none)."""

    v: Indices
    u: Array
    other: Array


class _Fit(NamedTuple):
    """Result for each row: column, its sigma for noise alone, width and signal to noise; NaN where it failed."""

    u: Array
    sigma: Array
    width: Array
    signal_to_noise: Array


def no_line() -> Line:
    """Nothing measured."""
    none = np.zeros(0)
    return Line(np.zeros((0, 2)), np.zeros(0, np.uint8), none, none, none)


def measure(image_bgr: NDArray[np.uint8], arms: Arms, factor: int, gamma: float) -> Line:
    """Sub-pixel points of the arms that were found.

    Parameters
    ----------
    image_bgr : (H, W, 3) or (H, W), the full image.
    arms : where to look.
    factor : pixels of the full image to one of the reduced image in which the arms were found.
    gamma : the camera's.
    """
    image = np.ascontiguousarray(image_bgr)
    rows = [
        _centred(image, _rows_of(pieces, factor, arms.box_px, image.shape), arms.box_px, factor)
        for pieces in arms.pieces
    ]
    found = []
    for arm, (own, other) in enumerate([(rows[0], rows[1]), (rows[1], rows[0])]):
        if len(own.v) < _LAG_ROWS:
            continue
        beside = own._replace(other=_column_at(other, own.v))
        found.append(_points(_fit(image, beside, arms.box_px, linear_light(gamma)), own.v, arm))
    if not found:
        return no_line()
    line = Line(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    return line._replace(sigma_px=line.sigma_px * _scatter_over_sigma(line))


def _points(fit: _Fit, v: Indices, arm: int) -> Line:
    keep = np.flatnonzero(np.isfinite(fit.u))
    uv = np.column_stack([fit.u, v]).astype(np.float64)[keep]
    return Line(uv, np.full(len(keep), arm, np.uint8), fit.sigma[keep], fit.width[keep], fit.signal_to_noise[keep])


# -------------------------------------------------------------------------------------------- where to look


def _rows_of(pieces: list[Piece], factor: int, box_px: float, shape: tuple[int, ...]) -> _Rows:
    """Every row of the pieces and a little beyond their ends, half way to the next piece at most."""
    found_v, found_u = [np.zeros(0, np.intp)], [np.zeros(0)]
    edges = [(piece.v[0], piece.v[-1]) for piece in pieces]
    for k, piece in enumerate(pieces):
        up = _beyond(piece.u[0], _slope(piece.u, piece.v, 0), factor, box_px, shape[1])
        down = _beyond(piece.u[-1], -_slope(piece.u, piece.v, -1), factor, box_px, shape[1])
        if k:
            up = min(up, max(0.5 * (edges[k][0] - edges[k - 1][1]), 0))
        if k + 1 < len(pieces):
            down = min(down, max(0.5 * (edges[k + 1][0] - edges[k][1]) - 0.5, 0))
        first, last = max(0, int(np.ceil(piece.v[0] - up))), min(shape[0] - 1, int(np.floor(piece.v[-1] + down)))
        v = np.arange(first, last + 1)
        u = np.interp(v, piece.v, piece.u)
        u += np.minimum(v - piece.v[0], 0) * _slope(piece.u, piece.v, 0)
        u += np.maximum(v - piece.v[-1], 0) * _slope(piece.u, piece.v, -1)
        inside = (u > -0.5) & (u < shape[1] - 0.5)
        found_v.append(v[inside])
        found_u.append(u[inside])
    u = np.concatenate(found_u)
    return _Rows(np.concatenate(found_v), u, np.full(len(u), np.nan))


def _slope(u: Array, v: Array, end: int) -> float:
    """Columns a row at one end (0 or -1) of a piece."""
    part = slice(0, 9) if end == 0 else slice(-9, None)
    u, v = u[part], v[part]
    return float((u[-1] - u[0]) / (v[-1] - v[0]))


def _beyond(u: float, outward: float, factor: int, box_px: float, width: int) -> float:
    """Rows to look beyond an end: two of the reduced image, and to the border of the image where that is near.

    Parameters
    ----------
    outward : columns a row, negative where the line comes nearer to u = 0 with each row outward times -1.
    """
    border = u if -outward < 0 else width - u
    return max(2.0 * factor, 3 * box_px if border < 3 * box_px else 0.0)


def _column_at(rows: _Rows, v: Indices) -> Array:
    """Column (N,) of an arm in given rows, NaN above and below it."""
    if not len(rows.v):
        return np.full(len(v), np.nan)
    order = np.argsort(rows.v, kind="stable")
    return np.interp(v, rows.v[order], rows.u[order], left=np.nan, right=np.nan)


def _strip(
    image: NDArray[np.uint8], v: Indices, centre: Indices, half: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Pixels (N, 2 half + 1[, 3]) around a column in each row, and which of them are in the image.

    Those that are not repeat the row's last pixel.
    """
    width, size, depth = image.shape[1], 2 * half + 1, image.shape[2] if image.ndim == 3 else 1
    # windows of consecutive pixels, of any start: the rows of an image lie one behind the other
    windows = as_strided(image, (image.size - size * depth + 1, size * depth), (1, 1), writeable=False)
    level = windows[np.clip((v * width + centre - half) * depth, 0, len(windows) - 1)]
    level = level.reshape(len(v), size, *image.shape[2:])
    inside = np.ones(level.shape[:2], bool)
    cut = np.flatnonzero((centre < half) | (centre >= width - half))
    column = centre[cut, None] + np.arange(-half, half + 1)
    inside[cut] = (column >= 0) & (column < width)
    level[cut] = image[v[cut, None], np.clip(column, 0, width - 1)]
    return level, inside


def _green(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 2 else np.asarray(cv2.extractChannel(image, 1), np.uint8)


def _centred(image: NDArray[np.uint8], rows: _Rows, box_px: float, factor: int) -> _Rows:
    """Rough columns improved at full resolution: the strongest peak near them, of some rows together."""
    if not len(rows.v):
        return rows
    every, columns = max(1, 2 * factor // 3), 1 + 2 * int(box_px / 8)
    reach, wide = factor // columns + 1, int(np.ceil(1.5 * box_px / columns)) + 1
    v, centre = rows.v[::every], np.round(rows.u[::every]).astype(np.intp)
    half = reach + wide
    level = _averaged(_green(_strip(image, v, centre, half * columns + columns // 2)[0]), columns)
    sigma = max(0.4 * box_px / columns, 0.8)
    narrow = cv2.GaussianBlur(cv2.blur(level, (1, 7 if every == 1 else 5)), (2 * int(2.5 * sigma) + 1, 1), sigma)
    broad = cv2.blur(narrow, (2 * wide + 1, 1))
    near = slice(wide, wide + 2 * reach + 1)
    best = np.argmax(narrow[:, near] - broad[:, near], axis=1)
    # a stone outshines the line here and there
    best = cv2.medianBlur(best.astype(np.uint8)[:, None], 9).ravel().astype(float) - reach
    off = centre + columns * best - rows.u[::every]
    return rows._replace(u=rows.u + np.interp(np.arange(len(rows.v)), np.arange(len(v)) * every, off))


def _averaged(values: NDArray, columns: int) -> Floats:
    """Means (N, M) of so many columns of (N, columns M)."""
    values = values.astype(np.float32, copy=False)
    if columns == 1:
        return values
    size = (values.shape[1] // columns, len(values))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


# -------------------------------------------------------------------------------------------- profiles


def _typical_width(image: NDArray[np.uint8], v: Indices, centre: Indices, box_px: float, linear: Floats) -> float:
    """Standard deviation in pixels of the median profile of rows in which the line's column is known to a pixel."""
    half, some = int(np.ceil(1.7 * box_px)) + 2, slice(None, None, max(1, len(v) // 80))
    light = linear[_green(_strip(image, v[some], centre[some], half)[0])]
    ends = max(1, half // 4)
    ground = 0.5 * (light[:, :ends].mean(axis=1) + light[:, -ends:].mean(axis=1))
    profile = np.sort((light - ground[:, None]).T, axis=1)[:, len(light) // 2].astype(float)
    x, profile = np.arange(-half, half + 1), np.maximum(profile, 0)
    square, sigma = x**2, half / 3
    for _ in range(12):
        before, wide = sigma, 1.5 * sigma
        weight = profile * np.exp(-0.5 * (x / wide) ** 2)
        spread = float((weight @ square) / max(weight.sum(), 1e-12))
        # the weight narrows a Gaussian profile: 1/spread = 1/sigma^2 + 1/wide^2
        sigma = float(np.sqrt(1 / max(1 / max(spread, 0.05) - 1 / wide**2, (1.5 / half) ** 2)))
        if abs(sigma - before) < 0.01 * sigma:
            break
    return float(np.clip(sigma, 0.6, half / 1.5))


def _fit(image: NDArray[np.uint8], rows: _Rows, box_px: float, linear: Floats) -> _Fit:
    """Gaussians of all rows of an arm."""
    centre = np.round(rows.u).astype(np.intp)
    width = _typical_width(image, rows.v, centre, box_px, linear)
    # columns of a wide line are averaged: nothing is lost as long as they are narrower than the line
    columns = 1 + 2 * int(width / 3)
    crest = image[rows.v[::16], np.clip(centre[::16], 0, image.shape[1] - 1)]
    if (crest.reshape(len(crest), -1).max(axis=1) >= _CLIPPED).mean() > _GLARING:
        # the flanks of a clipped line are narrow
        columns = 1
    half = int(np.ceil(gaussian_fit.WINDOW * width / columns)) + 1
    level, inside = _strip(image, rows.v, centre, half * columns + columns // 2)
    green, shine = _green(level), np.asarray(cv2.LUT(level, linear), np.float32)
    mask, unclipped = _all(inside, columns).astype(np.float32), _all(green < _CLIPPED, columns)
    mask[_lit_by_other((rows.other - centre) / columns, half, gaussian_fit.FIT * width / columns)] = 0
    light = laser_light(shine, gaussian_fit.GROUND * width, columns)
    light -= gaussian_fit.ground(light, mask, width / columns)
    if image.ndim == 3:
        mask *= ~white_pixels(shine, light, columns)
    typical = int(median(green[::7, ::3]))
    floor = max(float(linear[min(typical + 1, 255)] - linear[min(typical, 254)]) ** 2 / 12 / columns, 1e-10)
    found = gaussian_fit.fit(light, mask * unclipped, width / columns, floor)
    u, sigma, width = centre + columns * found.place, columns * found.sigma, columns * found.width
    share = found.height / running_median(found.height)
    strange = (share > _BRIGHT) | (found.misfit > _MISFIT)
    to_end = _rows_to_end(rows, np.where(strange, np.nan, u), width)
    # light that a line leaves within a width of its end is half a line
    strange |= (share < _FADING) & unclipped[half] & (to_end <= width)
    sigma = np.hypot(sigma, _EDGE * width * np.exp(-0.5 * to_end / width))
    if image.ndim == 2:
        usual = running_median(found.width, max(len(found.width) // 3, 33))
        strange |= _unlike_the_rest(found, gaussian_fit.misfit(light, mask * unclipped, found, usual, floor))
    fit = _accepted(_Fit(np.where(strange, np.nan, u), sigma, width, found.signal_to_noise), rows, image.shape[1])
    return fit if image.ndim == 3 else fit._replace(u=np.where(_short(rows.v, fit), np.nan, fit.u))


def _unlike_the_rest(found: gaussian_fit.Fit, misfit: NDArray) -> NDArray[np.bool_]:
    """Which profiles (N,) are not the line's, told by their shape, as a grey image has no colour to tell by.

    A line is as wide as along much of its arm, as the range changes slowly; what bubbles and shells leave on it or
    beside it is narrower, broader, brighter or double. Where there is much of it the rest is not believed either.

    misfit : (N,) scatter squared that Gaussians of the usual width leave.
    """
    rows = len(misfit)
    stops = np.log2(misfit / running_median(misfit, max(rows // 3, 33)) + 1e-3)
    # bubbles are in the upper half only
    odd = stops > _ODD * (median(stops) - float(np.quantile(stops, 0.16)))
    stops = np.abs(np.log2(np.maximum(found.height / median(found.height), 1e-3)))
    odd |= stops > np.maximum(_GREY_BRIGHT * median(stops), _GREY_STOPS)
    return cv2.blur(odd.astype(np.float32)[None], (_CROWD_ROWS, 1)).ravel() > _CROWD


def _short(v: Indices, fit: _Fit) -> NDArray[np.bool_]:
    """Points (N,) on stretches of line so short that a bubble may be all there is to them."""
    seen = np.flatnonzero(np.isfinite(fit.u))
    if not len(seen):
        return np.zeros(len(v), bool)
    width, gap = median(fit.width[seen]), np.diff(v[seen])
    broken = (gap > _CROWD_ROWS) | (gap < 1) | (np.abs(np.diff(fit.u[seen])) > _STEP_WIDTHS * width + _STEEPEST * gap)
    stretch = np.concatenate([[0], np.cumsum(broken)])
    long = np.bincount(stretch)[stretch] >= _SHORT_WIDTHS * width
    short = np.ones(len(v), bool)
    # pieces here and there are no line
    if long.any() and np.count_nonzero(long) > _COVERED * np.ptp(v[seen[long]]):
        short[seen] = ~long
    return short


def _rows_to_end(rows: _Rows, u: Array, width: Array) -> Indices:
    """How many rows (N,) each point is from where the line ends or jumps.

    u : (N,) columns measured, NaN where none was.
    """
    broken = ~(np.abs(np.diff(u)) < 3 * width[1:]) | (np.diff(rows.v) != 1)
    edge = np.flatnonzero(np.concatenate([[True], broken, [True]]))
    point = np.arange(len(u))
    after = np.searchsorted(edge, point, side="right")
    return np.minimum(point - edge[after - 1], edge[after] - 1 - point)


def _all(pixels: NDArray[np.bool_], columns: int) -> NDArray[np.bool_]:
    """Which groups (M, N) of columns of (N, columns M) are true in every column."""
    upright = cv2.transpose(pixels.view(np.uint8))
    if columns > 1:
        upright = upright.reshape(-1, columns, len(pixels)).min(axis=1)
    return np.asarray(upright).view(bool)


def _lit_by_other(apart: Array, half: int, reach: float) -> NDArray[np.bool_]:
    """Pixels (2 half + 1, N) on which the other arm, so far from the middle (N,), shines."""
    lit = np.zeros((2 * half + 1, len(apart)), bool)
    near = np.flatnonzero(np.abs(apart) < half + reach)
    lit[:, near] = np.abs(np.arange(-half, half + 1)[:, None] - apart[near]) < reach
    return lit


def _accepted(fit: _Fit, rows: _Rows, columns: int) -> _Fit:
    """Columns set to NaN where nothing is sure to have been measured, or only half of it could be seen."""
    bad = (fit.signal_to_noise < _LEAST_SNR) | (np.abs(fit.u - rows.u) > _ASTRAY * fit.width + 1)
    bad |= fit.sigma > _VAGUE * fit.width
    bad |= (fit.u < 0.7 * fit.width) | (fit.u > columns - 1 - 0.7 * fit.width)
    bad |= np.abs(rows.other - fit.u) < APART * fit.width
    return fit._replace(u=np.where(bad, np.nan, fit.u))


def _scatter_over_sigma(line: Line) -> float:
    """By how much points scatter about their neighbours on the line, over their sigmas: speckle is not in these."""
    u, v, variance = line.uv[:, 0], line.uv[:, 1], line.sigma_px**2
    # farther apart than speckle and stones reach
    lag = max(_LAG_ROWS, round(_LAG_WIDTHS * median(line.width_px))) if len(u) else _LAG_ROWS
    if len(u) <= 4 * lag + 20:
        return 1.0
    # a fourth difference: curved bottom is no scatter
    at = [slice(k * lag, len(u) - (4 - k) * lag) for k in range(5)]
    weight = (1 / 6, -4 / 6, 1.0, -4 / 6, 1 / 6)
    even = np.logical_and.reduce([v[at[k + 1]] - v[at[k]] == lag for k in range(4)])
    if even.sum() < 20:
        return 1.0
    off = np.sum([w * u[part] for w, part in zip(weight, at, strict=True)], axis=0)
    expected = np.sum([w**2 * variance[part] for w, part in zip(weight, at, strict=True)], axis=0)
    square = off[even] ** 2 / expected[even]
    # median of a squared normal variable: 0.4549 of its variance; speckle has longer tails, which count up to 3 sigma
    usual = median(square) / 0.4549
    return float(np.clip(np.sqrt(np.minimum(square, 9 * usual).mean() / 0.991), 0.7, 20))
