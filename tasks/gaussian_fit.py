"""Gaussians fitted to many profiles of a line side by side, each pixel weighed by its noise.

Least squares with weights from each pixel's variance is the maximum likelihood; a line's place is then known to the
bound of Cramér and Rao. The noise is learnt from the residuals: it grows with light (photons) and with its square
(speckle). Each profile has its own place and height; width and noise are shared between neighbours. Profiles stand
side by side as columns, so that every sum over a profile runs over all of them at once.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from .medians import median

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
# Half the window, where the ground beside the line begins, where the fit ends; sigmas of the line.
WINDOW: Final = 4.5
GROUND: Final = 3.2
FIT: Final = 3.0
# Where the crest is clipped, height and width are told by the flanks, and slowly.
_STEPS, _STEPS_CLIPPED = 2, 4
# Light, of the brightest that is not clipped, that tells of the flanks.
_FLANK: Final = 0.15
# Rows over which ground, width and noise are averaged.
_GROUND_ROWS, _WIDTH_ROWS, _NOISE_ROWS = 9, 41, 31
# Bands of height, of the usual line's, in which the noise is measured, in so many profiles.
_SHARES: Final = ((0.1, 0.35), (0.35, 0.65), (0.65, 1.0), (1.0, 2.0))
_SAMPLES: Final = 110
# Heights, of the usual one, beyond which the noise is thought to grow no more.
_BRIGHTEST: Final = np.float32(4)
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


class _Noise(NamedTuple):
    """How pixels' variances grow with the line's light.

    Attributes
    ----------
    beside : variance of pixels beside the line.
    linear, square : what light, as a share of the usual height, and its square add, of that.
    usual : height of most lines.
    """

    beside: float
    linear: float
    square: float
    usual: float


class _State(NamedTuple):
    """Of each profile (N,): place, width, height; normal equations of height and place."""

    place: NDArray
    width: NDArray
    height: NDArray
    normals: tuple[NDArray, NDArray, NDArray]


def fit(light: Floats, mask: Floats, width: float, floor: float) -> Fit:
    """Fit a Gaussian to each profile, nearly in its middle already and on no ground.

    Parameters
    ----------
    light : (M, N) profiles, M odd; neighbours in N are neighbours on the line.
    mask : (M, N) 1 for pixels to use, 0 for others.
    width : standard deviation of most, pixels.
    floor : variance that pixels have at least: that of rounding to levels.
    """
    half = len(light) // 2
    x = np.arange(-half, half + 1, dtype=np.float32)[:, None]
    reach = min(int(1.2 * FIT * width) + 1, half)
    core = slice(half - reach, half + reach + 1)
    state = _first(light[core], x[core], width)
    noise = _Noise(floor, 0.0, 0.0, max(median(state.height), 1e-9))
    steps = _STEPS
    if np.count_nonzero(mask[half]) < 0.5 * mask.shape[1]:
        steps, state = _STEPS_CLIPPED, _by_flanks(state, light[core], mask[core], x[core])
    for k in range(steps):
        state = _improved(state, light[core], mask[core], x[core], noise, last=k == steps - 1)
        if k == steps - 2:
            noise = _noise(state, light, mask, x, noise)
    level, misfit = _noise_level(state, light, mask, x, noise)
    gg, gd, dd = state.normals
    determinant = np.maximum(gg * dd - gd**2, _TINY)
    snr = state.height * np.sqrt(determinant / np.maximum(dd, _TINY)) / level
    sigma = level * np.sqrt(gg / determinant) / np.maximum(state.height, 1e-9)
    return Fit(*(np.asarray(part, float) for part in (state.place, sigma, state.width, snr, state.height, misfit)))


def misfit(light: Floats, mask: Floats, found: Fit, width: Array, floor: float) -> NDArray:
    """Scatter squared (N,) of what Gaussians of given widths (N,) leave of profiles, over that of noise.

    Parameters
    ----------
    light, mask, floor : as in `fit`.
    found : what that gave.
    """
    half = len(light) // 2
    x = np.arange(-half, half + 1, dtype=np.float32)[:, None]
    place, free, height = (np.asarray(part, np.float32) for part in (found.place, found.width, found.height))
    normals = height, height, height
    noise = _Noise(floor, 0.0, 0.0, max(median(height), 1e-9))
    noise = _noise(_State(place, free, height, normals), light, mask, x, noise)
    state = _State(place, np.asarray(width, np.float32), height, normals)
    for _ in range(_STEPS):
        state = _improved(state, light, mask, x, noise, last=True)
    up, down = _residuals(state, light, mask, x, noise)
    return up / down


def ground(light: Floats, mask: Floats, width: float) -> Floats:
    """Straight lines (M, N) through what lies to both sides of each profile (M, N), averaged over some of them.

    mask : (M, N) 1 for pixels to use, 0 for others.
    """
    half = len(light) // 2
    x = np.arange(-half, half + 1, dtype=np.float32)
    mean, place = [], []
    for side in (x < -GROUND * width, x > GROUND * width):
        part = slice(*np.flatnonzero(side)[[0, -1]] + [0, 1])
        count = _along(mask[part].sum(axis=0), _GROUND_ROWS)
        total = _along(_dot(light[part], mask[part]), _GROUND_ROWS)
        mean.append((total / np.maximum(count, np.float32(1e-3)), count > 1e-3))
        place.append(float(x[side].mean()))
    (left, seen_left), (right, seen_right) = mean
    # a side that is not seen is thought to be as the other; where neither is there is no ground
    left, right = np.where(seen_left, left, right * seen_right), np.where(seen_right, right, left * seen_left)
    share = (x[:, None] - np.float32(place[0])) / np.float32(place[1] - place[0])
    return np.asarray((right - left) * share + left, np.float32)


def _dot(a: NDArray, b: NDArray) -> NDArray:
    """Sums (N,) over the profiles of a * b, (M, N) each."""
    return np.einsum("ij,ij->j", a, b)


def _along(values: NDArray, rows: int) -> Floats:
    """Means (N,) of so many neighbours."""
    smooth = cv2.blur(values.reshape(1, -1), (rows, 1), borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth, np.float32).ravel()


def _first(light: Floats, x: Floats, width: float) -> _State:
    """The first step from the middle, all pixels used: the same weights for all profiles."""
    t = x / np.float32(width)
    g = np.exp(np.float32(-0.5) * t * t) * (np.abs(t) < FIT)
    gg, dd, ss = ((g * g * t**power).sum(axis=0) for power in (0, 2, 4))
    gp, dp, sp = np.hstack([g, g * t, g * t * t]).T @ light
    height = np.maximum(gp / gg, np.float32(1e-7))
    sums = _Sums(gg, np.zeros_like(gg), dd, ss, gp, dp, sp)
    start = np.full(light.shape[1], np.float32(width))
    step = np.clip(dp / dd / height, -1, 1)
    place = np.clip(start * step, x[0], x[-1])
    return _State(place, _wider(start, height, sums), height, (gp, gp, gp))


def _by_flanks(state: _State, light: Floats, mask: Floats, x: Floats) -> _State:
    """Width and height, one for all, of a line whose crest is clipped: a Gaussian's logarithm is a parabola."""
    some = slice(None, None, max(1, mask.shape[1] // (4 * _SAMPLES)))
    part, square = light[:, some], (x - state.place[some]) ** 2
    seen = (mask[:, some] > 0) & (square < (FIT * state.width[some]) ** 2)
    seen &= part > _FLANK * max(float(part[seen].max(initial=0)), 1e-6)
    weight, square = part[seen], square[seen]
    if len(weight) < 20:
        return state
    # the logarithm's sigma is the light's over the light
    slope, top = np.polyfit(square, np.log(weight), 1, w=weight)
    width = np.sqrt(-0.5 / slope) if slope < 0 else np.inf
    width = np.clip(width, 0.4 * state.width, state.width)
    height = np.full_like(state.height, np.exp(min(top, 5.0)))
    return state._replace(width=width.astype(np.float32), height=height)


class _Sums(NamedTuple):
    """Over each profile (N,), t the distance from the place in widths: of w g^2 t^k, k 0, 1, 2, 4; w g light t^k."""

    a0: NDArray
    a1: NDArray
    a2: NDArray
    a4: NDArray
    b0: Floats
    b1: Floats
    b2: Floats


def _improved(state: _State, light: Floats, mask: Floats, x: Floats, noise: _Noise, last: bool) -> _State:
    """One step of Gauss and Newton's for place, height and, but in the last, width."""
    width = state.width
    t, square, g = _gaussian(state, x)
    wg = mask * (square < np.float32(FIT**2))
    wg *= g
    if noise.linear or noise.square:
        wg /= _variance(state.height, g, noise)
    a, b = wg * g, wg * light
    a2, b1 = a * square, b * t
    bent = (_dot(a2, square), _dot(b1, t)) if not last else (t[0], t[0])
    sums = _Sums(a.sum(axis=0), _dot(a, t), a2.sum(axis=0), bent[0], b.sum(axis=0), b1.sum(axis=0), bent[1])
    determinant = np.maximum(sums.a0 * sums.a2 - sums.a1 * sums.a1, _TINY)
    height = np.maximum((sums.a2 * sums.b0 - sums.a1 * sums.b1) / determinant, np.float32(1e-7))
    step = np.clip((sums.a0 * sums.b1 - sums.a1 * sums.b0) / determinant / height, -1, 1)
    place = np.clip(state.place + width * step, x[0], x[-1])
    beside = np.float32(noise.beside)
    normals = sums.a0 / beside, sums.a1 / width / beside, sums.a2 / width**2 / beside
    return _State(place, width if last else _wider(width, height, sums), height, normals)


def _gaussian(state: _State, x: Floats) -> tuple[NDArray, NDArray, NDArray]:
    """Distance from the place in widths (M, N), its square, and the Gaussian."""
    t = x - state.place
    t *= 1 / state.width
    square = t * t
    return t, square, np.asarray(cv2.exp(np.float32(-0.5) * square), np.float32)


def _wider(width: Floats, height: Floats, sums: _Sums) -> Floats:
    """Widths that fit better, each for some profiles together."""
    # a wider line looks higher, too: what of its change is like a change of height does not count
    alike = sums.a2 / np.maximum(sums.a0, _TINY)
    up = height * (sums.b2 - height * sums.a2 - alike * (sums.b0 - height * sums.a0)) / width
    down = height**2 * (sums.a4 - alike * sums.a2) / width**2
    up, down = (_along(part, _WIDTH_ROWS) for part in (up, down))
    change = np.clip(up / np.maximum(down, np.float32(1e-12)), -0.2 * width, 0.2 * width)
    return np.maximum(width + change, np.float32(0.5))


def _noise(state: _State, light: Floats, mask: Floats, x: Floats, before: _Noise) -> _Noise:
    """What pixels' variances are beside the line and on it, from the residuals of some profiles."""
    some = slice(None, None, max(1, mask.shape[1] // _SAMPLES))
    part = _State(state.place[some], state.width[some], state.height[some], state.normals)
    seen, (_, square, gaussian) = mask[:, some] > 0, _gaussian(part, x)
    share = (_share(part.height, before) * gaussian)[seen]
    residual = np.abs(light[:, some] - part.height * gaussian)[seen]
    outer, floor = (square > GROUND**2)[seen], before.beside
    if np.count_nonzero(outer) < 20:
        return before
    size, places = [residual[outer]], [0.0]
    for low, high in _SHARES:
        band = ~outer & (share > low) & (share < high)
        if np.count_nonzero(band) > 20:
            size.append(residual[band])
            places.append(float(share[band].mean()))
    variance = np.array([max((1.4826 * median(band)) ** 2, floor) for band in size])
    # height and place, fitted, take two of the pixels on the line
    pixels = max(3.0 * median(part.width), 3.0)
    variance[1:] *= pixels / (pixels - 1.5)
    place = np.array(places)
    design = np.column_stack([np.ones_like(place), place, place**2]) / variance[:, None]
    beside, linear, square = nnls(design, np.ones(len(place)))[0]
    beside = max(beside, 0.5 * variance[0], floor)
    return before._replace(beside=float(beside), linear=float(linear / beside), square=float(square / beside))


def _share(height: NDArray, noise: _Noise) -> NDArray:
    """Height of each line (N,) over that of most."""
    return np.minimum(height / np.float32(noise.usual), _BRIGHTEST)


def _variance(height: NDArray, gaussian: NDArray, noise: _Noise) -> NDArray:
    """Of each pixel (M, N), over that beside the line."""
    on = _share(height, noise) * gaussian
    variance = np.float32(noise.square) * on
    variance += np.float32(noise.linear)
    variance *= on
    variance += np.float32(1)
    return variance


def _noise_level(state: _State, light: Floats, mask: Floats, x: Floats, noise: _Noise) -> tuple[NDArray, NDArray]:
    """Scatter of the residuals (N,) over what was expected, of some rows together; its square in each row to that."""
    up, down = _residuals(state, light, mask, x, noise)
    around = np.clip(_along(up, _NOISE_ROWS) / _along(down, _NOISE_ROWS), np.float32(0.3), np.float32(30))
    return np.sqrt(around), up / down / around


def _residuals(state: _State, light: Floats, mask: Floats, x: Floats, noise: _Noise) -> tuple[NDArray, NDArray]:
    """Sums (N,) of the squares of the residuals over what was expected, and how many there are, two fitted less."""
    gaussian = _gaussian(state, x)[2]
    squares = light - state.height * gaussian
    squares *= squares
    squares /= _variance(state.height, gaussian, noise)
    beside = np.float32(noise.beside)
    up = _dot(np.minimum(squares, np.float32(16) * beside), mask) / beside
    return up, np.maximum(mask.sum(axis=0) - 2, np.float32(0.5))
