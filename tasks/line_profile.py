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
from scipy.optimize import nnls

from .sheet_search import Arms, Piece, linear_light

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]
# Variance of pixels beside the line, and what a line's height and its square multiply that by.
Noise = tuple[float, float, float]

_CLIPPED: Final = 250
# Half the window, where its ground begins and where the fit ends; sigmas of the line.
_WINDOW, _GROUND, _FIT = 4.5, 3.2, 3.0
_APART: Final = 4.5
_STEPS: Final = 4
# Rows over which ground, width and noise are averaged.
_GROUND_ROWS, _WIDTH_ROWS, _NOISE_ROWS = 9, 41, 31
# Bands of height, of the usual line's, in which the noise is measured.
_SHARES: Final = ((0.1, 0.35), (0.35, 0.65), (0.65, 1.0), (1.0, 2.0))
_LEAST_SNR: Final = 4.0
_LAG_ROWS: Final = 4
_TINY: Final = np.float32(1e-15)


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

    def take(self, keep: NDArray) -> "Line":
        """The points that a mask or an index array (N,) selects."""
        return Line(*(field[keep] for field in self))


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
    rows = [_centred(image, _rows_of(pieces, factor, arms.box_px, image.shape), arms.box_px, factor) for pieces in arms.pieces]
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
    uv = np.column_stack([fit.u, v])[keep]
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
    """Green levels (N, 2 half + 1) around a column in each row, and which of them are in the image.

    Those that are not repeat the row's last pixel.
    """
    width, size = image.shape[1], 2 * half + 1
    green = image[..., 1] if image.ndim == 3 else image
    step = green.strides[1]
    # windows of consecutive pixels, of any start: the rows of an image lie one behind the other
    windows = as_strided(green, (green.size - size + 1, size), (step, step), writeable=False)
    level = windows[np.clip(v * width + centre - half, 0, len(windows) - 1)]
    inside = np.ones(level.shape, bool)
    cut = np.flatnonzero((centre < half) | (centre >= width - half))
    column = centre[cut, None] + np.arange(-half, half + 1)
    inside[cut] = (column >= 0) & (column < width)
    level[cut] = green[v[cut, None], np.clip(column, 0, width - 1)]
    return level, inside


def _centred(image: NDArray[np.uint8], rows: _Rows, box_px: float, factor: int) -> _Rows:
    """Rough columns improved at full resolution: the strongest peak near them, of five rows together."""
    if not len(rows.v):
        return rows
    reach = factor + 1
    wide = int(np.ceil(1.5 * box_px)) + 1
    centre = np.round(rows.u).astype(np.intp)
    level = _strip(image, rows.v, centre, reach + wide)[0].astype(np.float32)
    sigma = max(0.4 * box_px, 0.8)
    narrow = cv2.GaussianBlur(cv2.blur(level, (1, 5)), (0, 0), sigmaX=sigma, sigmaY=1e-3)
    broad = cv2.blur(narrow, (2 * wide + 1, 1))
    near = slice(wide, wide + 2 * reach + 1)
    return rows._replace(u=centre + np.argmax(narrow[:, near] - broad[:, near], axis=1) - float(reach))


# -------------------------------------------------------------------------------------------- profiles


def _typical_width(light: Floats) -> float:
    """Standard deviation in pixels of the median profile of strips (N, M) centred on the line to a pixel or so."""
    half = light.shape[1] // 2
    some = light[:: max(1, len(light) // 300)]
    ends = max(1, half // 4)
    ground = 0.5 * (some[:, :ends].mean(axis=1) + some[:, -ends:].mean(axis=1))
    profile = np.median(some - ground[:, None], axis=0).astype(float)
    x = np.arange(-half, half + 1)
    sigma = half / 3
    for _ in range(12):
        wide = 1.5 * sigma
        weight = np.maximum(profile, 0) * np.exp(-0.5 * (x / wide) ** 2)
        spread = float((weight * x**2).sum() / max(weight.sum(), 1e-12))
        # the weight narrows a Gaussian profile: 1/spread = 1/sigma^2 + 1/wide^2
        sigma = np.sqrt(1 / max(1 / max(spread, 0.05) - 1 / wide**2, (1.5 / half) ** 2))
    return float(np.clip(sigma, 0.6, half / 1.5))


def _fit(image: NDArray[np.uint8], rows: _Rows, box_px: float, linear: Floats) -> _Fit:
    """Gaussians of all rows of an arm by Gauss and Newton's steps, side by side."""
    centre = np.round(rows.u).astype(np.intp)
    width = _typical_width(linear[_strip(image, rows.v, centre, int(np.ceil(1.7 * box_px)) + 2)[0]])
    # columns of a wide line are averaged: nothing is lost as long as they are narrower than the line
    columns = 1 + 2 * int(width / 4)
    half = int(np.ceil(_WINDOW * 1.1 * width / columns)) + 1
    level, inside = _strip(image, rows.v, centre, half * columns + columns // 2)
    light = np.asarray(cv2.LUT(level, linear), np.float32)
    size = (2 * half + 1, len(light))
    if columns > 1:
        light = np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_AREA), np.float32)
    x = np.arange(-half, half + 1, dtype=np.float32)
    used, unclipped = (part.reshape(*size[::-1], columns).all(axis=2) for part in (inside, level < _CLIPPED))
    apart, width = (rows.other - centre).astype(np.float32)[:, None] / columns, width / columns
    if (np.abs(apart) < half + _FIT * width).any():
        used &= ~(np.abs(x - apart) < _FIT * width)
    light -= _ground(light, used, x, _GROUND * width)
    used &= unclipped
    typical = int(np.median(level[::7, ::3]))
    floor = max(float(linear[min(typical + 1, 255)] - linear[min(typical, 254)]) ** 2 / 12 / columns, 1e-10)
    fit = _gauss_newton(light, used.astype(np.float32), x, width, floor)
    return _accepted(fit._replace(u=centre + columns * fit.u, sigma=columns * fit.sigma, width=columns * fit.width), rows, image.shape[1])


def _accepted(fit: _Fit, rows: _Rows, columns: int) -> _Fit:
    """Columns set to NaN where nothing is sure to have been measured, or only half of it could be seen."""
    bad = (fit.signal_to_noise < _LEAST_SNR) | (np.abs(fit.u - rows.u) > 2 * fit.width + 1)
    bad |= (fit.u < 0.7 * fit.width) | (fit.u > columns - 1 - 0.7 * fit.width)
    bad |= np.abs(rows.other - fit.u) < _APART * fit.width
    return fit._replace(u=np.where(bad, np.nan, fit.u))


def _ground(light: Floats, used: NDArray[np.bool_], x: Floats, begin: float) -> Floats:
    """Straight line through what lies to both sides of each profile, averaged over some rows."""
    mean, place = [], []
    for side in (x < -begin, x > begin):
        count = used[:, side].sum(axis=1, dtype=np.float32)[:, None]
        total = (light[:, side] * used[:, side]).sum(axis=1, dtype=np.float32)[:, None]
        count, total = (cv2.blur(part, (1, _GROUND_ROWS), borderType=cv2.BORDER_REFLECT) for part in (count, total))
        mean.append(np.where(count > 1e-3, total / np.maximum(count, 1e-3), np.nan).reshape(-1, 1))
        place.append(float(x[side].mean()))
    left, right = (np.where(np.isnan(a), np.where(np.isnan(b), 0, b), a) for a, b in (mean, mean[::-1]))
    return (left + (right - left) * ((x - place[0]) / (place[1] - place[0]))).astype(np.float32)


class _State(NamedTuple):
    """Of each row (N, 1): offset of the line from the strip's middle, width, height, residuals (N, M) and normals."""

    offset: Floats
    width: Floats
    height: Floats
    residual: Floats
    normals: tuple[Floats, Floats, Floats]


def _gauss_newton(light: Floats, used: Floats, x: Floats, width: float, floor: float) -> _Fit:
    """Fits profiles (N, M), in pixels from their middle."""
    zero = np.zeros((len(light), 1), np.float32)
    state = _State(zero, zero + np.float32(width), zero, light, (zero, zero, zero))
    noise = (floor, 0.0, 0.0)
    for k in range(_STEPS):
        state = _improved(state, light, used, x, noise, last=k == _STEPS - 1)
        if k < _STEPS - 1:
            noise = _noise(state, used, x, floor)
    level = _noise_level(state, used / _variance(state, x, noise), x)
    gg, gd, dd = state.normals
    determinant = np.maximum(gg * dd - gd**2, _TINY)
    snr = state.height * np.sqrt(determinant / np.maximum(dd, _TINY)) / level
    sigma = level * np.sqrt(gg / determinant) / np.maximum(state.height, 1e-9)
    return _Fit(*(np.asarray(field, float).ravel() for field in (state.offset, sigma, state.width, snr)))


def _improved(state: _State, light: Floats, used: Floats, x: Floats, noise: Noise, last: bool) -> _State:
    """One step for offset, height and, but in the last, width."""
    t = (x - state.offset) / state.width
    g = np.exp(-0.5 * t * t)
    weight = used * (np.abs(t) < _FIT) / _variance(state, x, noise)
    slope = g * t / state.width
    wg = weight * g
    gg, gd, dd = _sum(wg * g), _sum(wg * slope), _sum(weight * slope * slope)
    gp, dp = _sum(wg * light), _sum(weight * slope * light)
    determinant = np.maximum(gg * dd - gd * gd, _TINY)
    height = np.maximum((dd * gp - gd * dp) / determinant, 1e-7)
    step = (gg * dp - gd * gp) / determinant / height
    residual = light - height * g
    width = state.width
    if not last:
        width = _wider(state, residual, weight, g, t, height, wg, gg)
    offset = state.offset + np.clip(step, -state.width, state.width)
    return _State(np.clip(offset, x[0], x[-1]), width, height, residual, (gg, gd, dd))


def _wider(
    state: _State, residual: Floats, weight: Floats, g: Floats, t: Floats, height: Floats, wg: Floats, gg: Floats
) -> Floats:
    """Widths that fit better, one for some rows together."""
    bulge = g * t * t / state.width
    bulge -= g * (_sum(wg * bulge) / np.maximum(gg, _TINY))
    bulge *= weight
    up, down = height * _sum(bulge * residual), height**2 * _sum(bulge * g * t * t / state.width)
    up, down = (cv2.blur(part, (1, _WIDTH_ROWS), borderType=cv2.BORDER_REFLECT).reshape(-1, 1) for part in (up, down))
    change = np.clip(up / np.maximum(down, _TINY), -0.2 * state.width, 0.2 * state.width)
    return np.maximum(state.width + change, 0.5)


def _sum(values: Floats) -> Floats:
    return values.sum(axis=1, keepdims=True)


def _noise(state: _State, used: Floats, x: Floats, floor: float) -> Noise:
    """What pixels' variances are beside the line and on it, from the residuals of every third row."""
    t = (x - state.offset)[::3] / state.width[::3]
    share = (_share(state)[::3] * np.exp(-0.5 * t * t))[used[::3] > 0]
    residual, outer = state.residual[::3][used[::3] > 0], np.abs(t)[used[::3] > 0] > _GROUND
    if outer.sum() < 20:
        return floor, 0.0, 0.0
    size, places = [residual[outer]], [0.0]
    for low, high in _SHARES:
        part = ~outer & (share > low) & (share < high)
        if part.sum() > 20:
            size.append(residual[part])
            places.append(float(share[part].mean()))
    variance = np.array([max((1.4826 * float(np.median(np.abs(part)))) ** 2, floor) for part in size])
    # height and place, fitted, take two of the pixels on the line
    pixels = max(3.0 * float(np.median(state.width)), 3.0)
    variance[1:] *= pixels / (pixels - 1.5)
    place = np.array(places)
    design = np.column_stack([np.ones_like(place), place, place**2]) / variance[:, None]
    beside, linear, square = nnls(design, np.ones(len(place)))[0]
    beside = max(beside, 0.5 * variance[0], floor)
    return float(beside), float(linear / beside), float(square / beside)


def _share(state: _State) -> Floats:
    """Height of each row's line (N, 1) over that of most."""
    return np.minimum(state.height / max(float(np.median(state.height)), 1e-9), 4)


def _variance(state: _State, x: Floats, noise: Noise) -> Floats | float:
    beside, linear, square = (np.float32(part) for part in noise)
    if linear == 0 and square == 0:
        return beside
    t = (x - state.offset) / state.width
    on = _share(state) * np.exp(-0.5 * t * t)
    return beside * (1 + on * (linear + square * on))


def _noise_level(state: _State, weight: Floats, x: Floats) -> Floats:
    """Scatter of the residuals (N, 1) over what the weights expect, of some rows together."""
    inside = np.abs((x - state.offset) / state.width) < _WINDOW
    squares = np.minimum(weight * state.residual**2, 16) * inside
    count = np.maximum(_sum((weight > 0) * inside.astype(np.float32)) - 2, 0.5)
    up, down = (cv2.blur(part, (1, _NOISE_ROWS), borderType=cv2.BORDER_REFLECT) for part in (_sum(squares), count))
    return np.sqrt(np.clip(up / down, 0.3, 30)).reshape(-1, 1)


def _scatter_over_sigma(line: Line) -> float:
    """By how much points scatter about their neighbours on the line, over their sigmas: speckle is not in these."""
    u, v, variance, lag = line.uv[:, 0], line.uv[:, 1], line.sigma_px**2, _LAG_ROWS
    # farther than speckle and stones as wide as the line reach
    lag = max(lag, round(2 * float(np.median(line.width_px)))) if len(u) else lag
    if len(u) <= 4 * lag + 20:
        return 1.0
    # a fourth difference: curved bottom is no scatter
    at = [slice(k * lag, len(u) - (4 - k) * lag) for k in range(5)]
    weight = (1 / 6, -4 / 6, 1.0, -4 / 6, 1 / 6)
    even = np.logical_and.reduce([v[at[k + 1]] - v[at[k]] == lag for k in range(4)])
    if even.sum() < 20:
        return 1.0
    off = sum(w * u[part] for w, part in zip(weight, at, strict=True))
    expected = sum(w**2 * variance[part] for w, part in zip(weight, at, strict=True))
    # median of a squared normal variable: 0.4549 of its variance
    return float(np.clip(np.sqrt(np.median(off[even] ** 2 / expected[even]) / 0.4549), 0.7, 20))
