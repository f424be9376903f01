"""Gaussians fitted to many profiles of a line side by side, each pixel weighed by its noise.

Least squares with weights from each pixel's variance is the maximum likelihood; a line's place is then known to the
bound of Cramér and Rao. The noise is learnt from the residuals: it grows with light (photons) and with its square
(speckle). Each profile has its own place and height; width and noise are shared between neighbours.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
# Variance of pixels beside the line, and what a line's height and its square multiply that by.
Noise = tuple[float, float, float]

# Half the window, where the ground beside the line begins, where the fit ends; sigmas of the line.
WINDOW: Final = 4.5
GROUND: Final = 3.2
FIT: Final = 3.0
# Where the crest is clipped, height and width are told by the flanks, and slowly.
_STEPS, _STEPS_CLIPPED = 3, 7
# Rows over which ground, width and noise are averaged.
_GROUND_ROWS, _WIDTH_ROWS, _NOISE_ROWS = 9, 41, 31
# Bands of height, of the usual line's, in which the noise is measured, in so many rows.
_SHARES: Final = ((0.1, 0.35), (0.35, 0.65), (0.65, 1.0), (1.0, 2.0))
_SAMPLE_ROWS: Final = 500
_TINY: Final = np.float32(1e-15)


class Fit(NamedTuple):
    """What was fitted to each profile, (N,) each.

    Attributes
    ----------
    place : from the middle of the profile, pixels.
    sigma : its 1-sigma for the noise of pixels, pixels.
    width : standard deviation of the Gaussian, pixels.
    signal_to_noise : its height over that height's 1-sigma.
    height : in the unit of the light.
    misfit : scatter of the residuals squared, over that of the profiles around.
    """

    place: Array
    sigma: Array
    width: Array
    signal_to_noise: Array
    height: Array
    misfit: Array


class _State(NamedTuple):
    """Of each profile (N, 1): place, width, height; residuals and Gaussians (N, M); normal equations."""

    place: Floats
    width: Floats
    height: Floats
    residual: Floats
    gaussian: Floats
    normals: tuple[Floats, Floats, Floats]


def fit(light: Floats, used: NDArray[np.bool_], width: float, floor: float) -> Fit:
    """Fit a Gaussian to each profile, nearly in its middle already and on no ground.

    Parameters
    ----------
    light : (N, M) profiles, M odd; neighbours in N are neighbours on the line.
    used : (N, M) pixels to use.
    width : standard deviation of most, pixels.
    floor : variance that pixels have at least: that of rounding to levels.
    """
    half = light.shape[1] // 2
    x, mask = np.arange(-half, half + 1, dtype=np.float32), used.astype(np.float32)
    zero = np.zeros((len(light), 1), np.float32)
    state = _State(zero, zero + np.float32(width), zero, light, light, (zero, zero, zero))
    noise = (floor, 0.0, 0.0)
    steps = _STEPS if used[:, half].mean() > 0.5 else _STEPS_CLIPPED
    for k in range(steps):
        state = _improved(state, light, mask, x, noise, last=k == steps - 1)
        if k == steps - 2:
            noise = _noise(state, mask, x, floor)
    level, misfit = _noise_level(state, mask, x, noise)
    gg, gd, dd = state.normals
    determinant = np.maximum(gg * dd - gd**2, _TINY)
    snr = state.height * np.sqrt(determinant / np.maximum(dd, _TINY)) / level
    sigma = level * np.sqrt(gg / determinant) / np.maximum(state.height, 1e-9)
    return Fit(
        *(np.asarray(field, float).ravel() for field in (state.place, sigma, state.width, snr, state.height, misfit))
    )


def ground(light: Floats, used: NDArray[np.bool_], width: float) -> Floats:
    """Straight lines (N, M) through what lies to both sides of each profile (N, M), averaged over some rows."""
    half = light.shape[1] // 2
    x = np.arange(-half, half + 1, dtype=np.float32)
    mean, place = [], []
    for side in (x < -GROUND * width, x > GROUND * width):
        part, seen = np.ascontiguousarray(light[:, side]), used[:, side].astype(np.float32)
        count, total = (_along(values, _GROUND_ROWS) for values in (_dot(seen, seen), _dot(part, seen)))
        mean.append(np.where(count > 1e-3, total / np.maximum(count, 1e-3), np.nan))
        place.append(float(x[side].mean()))
    left, right = (np.where(np.isnan(a), np.where(np.isnan(b), 0, b), a) for a, b in (mean, mean[::-1]))
    return (left + (right - left) * ((x - place[0]) / (place[1] - place[0]))).astype(np.float32)


def _dot(a: NDArray, b: NDArray) -> Floats:
    """Sums (N, 1) over the rows of a * b."""
    return np.asarray(np.einsum("ij,ij->i", a, b), np.float32)[:, None]


def _along(values: NDArray, rows: int) -> Floats:
    """Means (N, 1) of so many neighbours."""
    smooth = cv2.blur(values.reshape(1, -1), (rows, 1), borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth, np.float32).reshape(-1, 1)


def _improved(state: _State, light: Floats, mask: Floats, x: Floats, noise: Noise, last: bool) -> _State:
    """One step of Gauss and Newton's for place, height and, but in the last, width."""
    t = (x - state.place) / state.width
    g = np.exp(-0.5 * t * t)
    weight = mask * (np.abs(t) < FIT) / _variance(state.height, g, noise)
    slope = g * t / state.width
    wg, ws = weight * g, weight * slope
    gg, gd, dd, gp, dp = _dot(wg, g), _dot(wg, slope), _dot(ws, slope), _dot(wg, light), _dot(ws, light)
    determinant = np.maximum(gg * dd - gd * gd, _TINY)
    height = np.maximum((dd * gp - gd * dp) / determinant, 1e-7)
    step = (gg * dp - gd * gp) / determinant / height
    residual = light - height * g
    width = state.width
    if not last:
        width = _wider(width, residual, height, (t, g, wg, gg))
    place = state.place + np.clip(step, -state.width, state.width)
    place = np.asarray(np.clip(place, x[0], x[-1]), np.float32)
    return _State(place, width, height, residual, g, (gg, gd, dd))


def _wider(width: Floats, residual: Floats, height: Floats, shape: tuple[Floats, Floats, Floats, Floats]) -> Floats:
    """Widths that fit better, each for some rows together."""
    t, g, wg, gg = shape
    square = t * t
    wgs = wg * square
    # a wider line looks higher, too: what of its change is like a change of height does not count
    alike = _dot(wgs, g) / np.maximum(gg, _TINY)
    up = height * (_dot(wgs, residual) - alike * _dot(wg, residual)) / width
    down = height**2 * (_dot(wgs, g * square) - alike * _dot(wgs, g)) / width**2
    up, down = (_along(part, _WIDTH_ROWS).astype(np.float64) for part in (up, down))
    change = np.clip(up / np.maximum(down, 1e-9), -0.2 * width, 0.2 * width)
    return np.maximum(width + change.astype(np.float32), np.float32(0.5))


def _noise(state: _State, mask: Floats, x: Floats, floor: float) -> Noise:
    """What pixels' variances are beside the line and on it, from the residuals of some rows."""
    some = slice(None, None, max(1, len(mask) // _SAMPLE_ROWS))
    seen = mask[some] > 0
    share = (_share(state.height)[some] * state.gaussian[some])[seen]
    residual = np.abs(state.residual[some][seen])
    outer = (np.abs(x - state.place[some]) > GROUND * state.width[some])[seen]
    if outer.sum() < 20:
        return floor, 0.0, 0.0
    size, places = [residual[outer]], [0.0]
    for low, high in _SHARES:
        part = ~outer & (share > low) & (share < high)
        if part.sum() > 20:
            size.append(residual[part])
            places.append(float(share[part].mean()))
    variance = np.array([max((1.4826 * float(np.median(part))) ** 2, floor) for part in size])
    # height and place, fitted, take two of the pixels on the line
    pixels = max(3.0 * float(np.median(state.width)), 3.0)
    variance[1:] *= pixels / (pixels - 1.5)
    place = np.array(places)
    design = np.column_stack([np.ones_like(place), place, place**2]) / variance[:, None]
    beside, linear, square = nnls(design, np.ones(len(place)))[0]
    beside = max(beside, 0.5 * variance[0], floor)
    return float(beside), float(linear / beside), float(square / beside)


def _share(height: Floats) -> Floats:
    """Height of each line (N, 1) over that of most."""
    return np.minimum(height / max(float(np.median(height)), 1e-9), 4)


def _variance(height: Floats, gaussian: Floats, noise: Noise) -> NDArray | np.float32:
    """Of each pixel (N, M)."""
    beside, linear, square = (np.float32(part) for part in noise)
    if linear == 0 and square == 0:
        return beside
    on = _share(height) * gaussian
    return beside * (1 + on * (linear + square * on))


def _noise_level(state: _State, mask: Floats, x: Floats, noise: Noise) -> tuple[NDArray, NDArray]:
    """Scatter of the residuals (N, 1) over what was expected, of some rows together; its square in each row to that."""
    inside = mask * (np.abs(x - state.place) < WINDOW * state.width)
    squares = state.residual**2 / _variance(state.height, state.gaussian, noise)
    up, down = _dot(np.minimum(squares, 16), inside), np.maximum(_dot(inside, inside) - 2, 0.5)
    around = np.clip(_along(up, _NOISE_ROWS) / _along(down, _NOISE_ROWS), 0.3, 30)
    return np.sqrt(around), up / down / around
