"""What lamps and water do to colours, estimated over a mission and taken out again.

The light of a pixel is J * L(u, v) * S(r) + B(r): J of the seabed, L the lighting pattern of lamps that travel with
the camera, S what spreading and attenuation leave at range r, B the backscatter of the water before it. The pattern
is the median over images, for the seabed differs from image to image. The laws of range are fitted to the means over
bins of range, which tell S, and to the contrast, which the veil B lowers (as Akkaynak and Treibitz 2019, whose dark
pixels are the other end of the same distribution). Ratios of channels are known far better than levels, for they do
not change with the brightness of the seabed.
"""

import warnings
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_GREEN: Final = 1
_DARKEST: Final = 1e-4
_GREY: Final = 1e-3  # channels that differ by no more have no colour
_MOST_GAIN: Final = 24.0
_SMOOTH_CELLS: Final = 1.0
_FEW_IMAGES: Final = 4
_ROUNDS: Final = 4
_BINS: Final = 12
_LEAST_IN_BIN: Final = 20
_BUILDS_UP: Final = 0.6  # backscatter reaches 1 - 1/e of its most at the median range over this
_LEAST_SIGNAL: Final = 0.2
# sigmas of what is believed without data: attenuation over the median range, exponent of spreading, the veil's share
_PRIOR_ATTENUATION, _PRIOR_SPREADING, _PRIOR_VEIL = 3.0, 1.0, 0.2
_LEAST_SIGMA, _LEAST_SIGMA_RATIO, _LEAST_SIGMA_CONTRAST = 0.02, 0.003, 0.05
_DARK_SHARE: Final = 0.08
_SIGMA_DARK: Final = 0.005
_SIGMA_SEABED: Final = 0.12  # of the logarithm of a seabed's red or blue over its green
_SIGMA_CAMERA: Final = 0.06  # of a camera's own white balance
_SIGMA_WAY: Final = 0.4  # share of the attenuation, because the veil over it is not known well
_RED_LOST: Final = (0.5, 0.9)  # logarithm of green or blue over red in air, and from where on it must be water


class Water(NamedTuple):
    """The fitted model.

    Attributes
    ----------
    light : (rows, columns, 3) lighting pattern, mean of the logarithm 0.
    attenuation : (3,) over the median range.
    spreading : exponent.
    veil : (3,) backscatter at the median range.
    range_m : median range.
    balance : (3,) what the seabed's light is multiplied with for white to be white.
    """

    light: Array32
    attenuation: NDArray[np.floating]
    spreading: float
    veil: NDArray[np.floating]
    range_m: float
    balance: NDArray[np.floating]


class _Law(NamedTuple):
    """Of a round: colour (3,) of the seabed at the median range, log; the others as in Water; sigma_ratio (2,)."""

    colour: Array
    attenuation: Array
    spreading: float
    veil: Array
    sigma_ratio: Array


def fit(light: Array32, range_m: Array32, exact: Mask) -> Water:
    """The model of a mission.

    Parameters
    ----------
    light : (n, rows, columns, 3) means of cells of n images, linear, 0..1, red green blue; NaN for unknown.
    range_m : (n, rows, columns) distance of the cells.
    exact : (n, rows, columns) where it is known well enough to tell how light changes with it.
    """
    typical = float(np.median(range_m))
    share = range_m / typical
    law = _Law(np.zeros(3), np.zeros(3), 0.0, np.zeros(3), np.ones(2))
    pattern = np.zeros(light.shape[1:])
    grey = not (np.abs(light - light[..., [_GREEN]]) > _GREY).any()  # no red to tell by whether there is water
    for _ in range(_ROUNDS):
        pattern = _pattern(light, share, law)
        law = _fit_law(light, pattern, share, exact)
        law = _without_colour(law) if grey else law
    wet = 1.0 if grey else _in_water(law.colour)
    balance = np.exp(wet * _white(law))
    balance *= np.exp(law.colour).mean() / (np.exp(law.colour) * balance).mean()
    return Water(
        np.exp(wet * pattern).astype(np.float32),
        wet * law.attenuation,
        wet * law.spreading,
        wet * law.veil,
        typical,
        balance,
    )


def tone(water: Water, light: Array32, range_m: Array32) -> tuple[Array32, Array32]:
    """Gain and veil (..., 3): a pixel's light is multiplied with the one, less the other.

    light (..., 3) the lighting pattern at the pixels; range_m (...) their distance.
    """
    share = np.maximum(range_m / water.range_m, 0.1)
    signal = _signal(share[..., None], water.attenuation, water.spreading) * light
    gain = np.minimum(water.balance / np.maximum(signal, 1e-6), _MOST_GAIN)
    return gain.astype(np.float32), (gain * _veil(share[..., None], water.veil)).astype(np.float32)


def _signal(share: NDArray, attenuation: NDArray, spreading: float) -> NDArray:
    return np.exp(-attenuation * (share - 1)) * share**-spreading


def _veil(share: NDArray, veil: NDArray) -> NDArray:
    return veil * np.expm1(-_BUILDS_UP * share) / np.expm1(-_BUILDS_UP)


def _pattern(light: Array32, share: Array32, law: _Law) -> Array:
    """Logarithm (rows, columns, 3) of the lighting, mean 0; less of it the fewer the images."""
    clear = np.maximum(light - _veil(share[..., None], law.veil), _LEAST_SIGNAL * light)
    seabed = np.log(np.maximum(clear, _DARKEST) / _signal(share[..., None], law.attenuation, law.spreading))
    level = _median(seabed, axis=(1, 2), keepdims=True)
    pattern = without_holes(_median(seabed - level, axis=0).astype(np.float32))
    pattern = cv2.GaussianBlur(pattern, (0, 0), _SMOOTH_CELLS, borderType=cv2.BORDER_REPLICATE)
    few = len(light) / (len(light) + _FEW_IMAGES)
    return few * (pattern - pattern.mean((0, 1))).astype(np.float64)


def _fit_law(light: Array32, pattern: Array, share: Array32, exact: Mask) -> _Law:
    """How light (n, rows, columns, 3) without its pattern changes with the range."""
    even, dim = light / np.exp(pattern), np.broadcast_to(np.exp(-pattern), light.shape)
    known = exact & np.isfinite(even).all(-1)
    x, y = share[known].astype(float), np.log(np.maximum(even[known], _DARKEST))
    image = np.nonzero(known)[0]
    members = _members(x)
    if not members:
        colour = _median(np.log(np.maximum(even, _DARKEST)), axis=(0, 1, 2))
        return _Law(colour, np.zeros(3), 0.0, np.zeros(3), np.full(2, _PRIOR_ATTENUATION))
    bins = [_bin(x[here], y[here], dim[known][here], image[here]) for here in members]
    at, level, ratio, contrast, dimmed, dark, count = (np.array(column) for column in zip(*bins, strict=True))
    sigma = [_spread(values, count, least) for values, least in ((level, _LEAST_SIGMA), (ratio, _LEAST_SIGMA_RATIO))]
    mean = _median(y, axis=0)

    def off(p: Array) -> Array:
        colour, attenuation, spreading, veil, clarity = p[:3], p[3:6], p[6], np.exp(mean) * p[7:10], p[10]
        signal = np.exp(colour) * _signal(at[:, None], attenuation, spreading)
        both = np.log(np.maximum(signal + _veil(at[:, None], veil) * dimmed, 1e-9))
        parts = [
            (level[:, 0] - both[:, _GREEN]) / sigma[0],
            (ratio[..., 0] - (both[:, (0, 2)] - both[:, [_GREEN]])) / sigma[1],
            (contrast - clarity - np.log(np.maximum(signal, 1e-9)) + both) / (_LEAST_SIGMA_CONTRAST),
            _off_dark(dark, signal, _veil(at[:, None], veil) * dimmed) / _SIGMA_DARK,
            attenuation / _PRIOR_ATTENUATION,
            np.array([(spreading - 1) / _PRIOR_SPREADING]),
            p[7:10] / _PRIOR_VEIL,
        ]
        return np.concatenate([part.ravel() for part in parts])

    low = np.concatenate([np.full(3, -20), np.full(3, -0.5), [0.0], np.zeros(3), [-20.0]])
    high = np.concatenate([np.full(3, 5), np.full(3, 10.0), [3.0], np.full(3, 0.6), [5.0]])
    start = np.concatenate([mean, np.full(3, 0.1), [1.0], np.full(3, 0.05), [float(np.median(contrast))]])
    found = least_squares(off, start, bounds=(low, high))
    p, covariance = found.x, np.linalg.inv(found.jac.T @ found.jac)
    pick = np.zeros((2, len(p)))
    for row, channel in enumerate((0, 2)):
        pick[row, 3 + channel], pick[row, 3 + _GREEN] = 1, -1
    sigma_ratio = np.sqrt(np.diag(pick @ covariance @ pick.T))
    return _Law(p[:3], p[3:6], float(p[6]), np.exp(mean) * p[7:10], sigma_ratio)


def _without_colour(law: _Law) -> _Law:
    """The law of green for all three."""
    colour, attenuation, veil = (np.full(3, values[_GREEN]) for values in (law.colour, law.attenuation, law.veil))
    return law._replace(colour=colour, attenuation=attenuation, veil=veil)


def _off_dark(dark: Array, signal: Array, veil: Array) -> Array:
    """What the ratios (bins, 2) of the darkest cells are off those of as dark a seabed that is as grey as the rest."""
    left = np.exp(dark[:, :1]) - veil[:, [_GREEN]]
    share = np.maximum(left / signal[:, [_GREEN]], 0.01)
    expected = np.log(np.maximum(share * signal + veil, 1e-9))
    return dark[:, 1:] - (expected[:, (0, 2)] - expected[:, [_GREEN]])


def _members(x: Array) -> list[NDArray[np.intp]]:
    """Which cells are in each bin of their range; without the bins that have too few."""
    if len(x) < _LEAST_IN_BIN:
        return []
    bins = np.digitize(x, np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1]))
    found = [np.flatnonzero(bins == k) for k in range(_BINS)]
    return [here for here in found if len(here) >= _LEAST_IN_BIN // 4]


def _bin(x: Array, y: Array, dim: Array, image: NDArray[np.intp]) -> tuple[Any, ...]:
    """Of a bin: range; green and its scatter; ratios (2, 2) and theirs; log contrast (3,); how much more the veil
    counts where the lamps give less (3,); green and the ratios of its darkest cells (3,); number of images."""
    green, ratio = y[:, _GREEN], y[:, (0, 2)] - y[:, [_GREEN]]
    level = np.array([np.median(green), _scatter(green)])
    darkest = green <= np.quantile(green, _DARK_SHARE)
    dark = np.append(np.median(green[darkest]), np.median(ratio[darkest], axis=0))
    ratios = np.stack([np.median(ratio, axis=0), _scatter(ratio)], axis=-1)
    return float(np.median(x)), level, ratios, np.log(_scatter(y) + 1e-6), dim.mean(0), dark, len(np.unique(image))


def _scatter(values: Array) -> Array:
    return 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def _spread(values: Array, count: Array, least: float) -> Array:
    """Sigma of bins' medians, from their scatter and how many images they are of."""
    per_image = count.reshape(-1, *[1] * (values.ndim - 2))
    return np.sqrt(values[..., 1] ** 2 / per_image + least**2)


def _in_water(colour: Array) -> float:
    """0 for photographs in air, 1 for those that lack the red that water takes."""
    lost, (dry, wet) = colour[1:].max() - colour[0], _RED_LOST
    return float(np.clip((lost - dry) / (wet - dry), 0, 1))


def _white(law: _Law) -> Array:
    """Logarithm (3,) of the white balance: a white lamp's light on its way, and a seabed that is likely grey."""
    way, seabed = (law.attenuation - law.attenuation[_GREEN])[[0, 2]], (law.colour[_GREEN] - law.colour)[[0, 2]]
    certain_way = 1 / (law.sigma_ratio**2 + _SIGMA_CAMERA**2 + (_SIGMA_WAY * way) ** 2)
    both = (way * certain_way + seabed / _SIGMA_SEABED**2) / (certain_way + 1 / _SIGMA_SEABED**2)
    return np.array([both[0], 0.0, both[1]])


def _median(values: NDArray, axis: int | tuple[int, ...], keepdims: bool = False) -> NDArray:
    """Median of what is not NaN; NaN where all is."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN slice")
        return np.nanmedian(values, axis=axis, keepdims=keepdims)


def without_holes(pattern: Array32) -> Array32:
    """NaN of a pattern (rows, columns, 3), where the laser stands in every image, filled from around."""
    known = np.isfinite(pattern).astype(np.float32)
    filled, sigma = np.nan_to_num(pattern), 1.0
    while not known.all() and sigma < max(pattern.shape):
        weight = cv2.GaussianBlur(known, (0, 0), sigma)
        mean = cv2.GaussianBlur(filled * known, (0, 0), sigma) / np.maximum(weight, 1e-6)
        reached = (known == 0) & (weight > 1e-3)
        filled, known = np.where(reached, mean, filled), np.maximum(known, reached)
        sigma *= 2
    return filled.astype(np.float32)
