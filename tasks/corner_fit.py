"""Corners of a chessboard to a few hundredths of a pixel: a model of the corner fitted to the brightness around it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import erf

Array = NDArray[np.float64]

_REACH: Final = 0.35  # of the side of a square
_REACH_PX: Final = (3, 40)
_FARTHEST_PX: Final = 3.0
_SATURATED: Final = 254
_BLUR_PX: Final = 1.5
_LEAST_PIXELS: Final = 30
_OFF_EDGE: Final = 0.9  # of the model's edges, -1 to 1: a pixel beyond is on one square only
_LEAST_NOISE: Final = 0.1  # of the one kind of square, as a share of the other's


def refined(grey: NDArray[np.uint8], uv: Array, size: tuple[int, int]) -> Array:
    """Corners (N, 2), pixels, fitted anew; one that cannot be is left where it was.

    Two blurred edges cross in each corner, under a light that may change linearly across it on bright and on dark
    squares by themselves. A gradient of light, as beside a laser's glare, moves the corners that look for orthogonal
    gradients (cv2.cornerSubPix) by half a pixel; this model has it. Saturated pixels are left out.

    Texture and speckle of a surface grow with the light that it throws back, so bright squares are much less even than
    dark ones. The scatter on both is measured, and pixels are weighed by it: that is the likelihood's maximum.

    Parameters
    ----------
    grey : (H, W) uint8.
    uv : (N, 2) to begin with, row by row. size : columns and rows of the grid.
    """
    grid = uv.reshape(size[1], size[0], 2)
    along, down = np.gradient(grid, axis=1).reshape(-1, 2), np.gradient(grid, axis=0).reshape(-1, 2)
    side = np.minimum(np.hypot(*along.T), np.hypot(*down.T))
    reach = np.clip(_REACH * side, *_REACH_PX).astype(int)
    return np.stack([_fitted(grey, *each) for each in zip(uv, along, down, reach, strict=True)])


def _fitted(grey: NDArray[np.uint8], uv: Array, along: Array, down: Array, reach: int) -> Array:
    """One corner (2,)."""
    u, v = np.round(uv).astype(int)
    patch = grey[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
    if patch.shape != (2 * reach + 1, 2 * reach + 1):
        return uv
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    use = (np.hypot(x, y) <= reach + 0.5) & (patch < _SATURATED)
    seen = patch[use].astype(float)
    if use.sum() < _LEAST_PIXELS or seen.std() < 1.0:
        return uv
    x, y, seen = x[use], y[use], (seen - seen.mean()) / seen.std()
    light = np.stack([np.ones_like(x), x / reach, y / reach], axis=1)

    def edges(p: Array) -> Array:
        return _edge(x - p[0], y - p[1], p[2], p[4]) * _edge(x - p[0], y - p[1], p[3], p[4])

    def misfit(p: Array, weight: Array) -> Array:
        model = np.concatenate([light, light * edges(p)[:, None]], axis=1) * weight[:, None]
        # brightness and contrast are linear: eliminated, so that five unknowns remain
        level = np.linalg.lstsq(model.T @ model, model.T @ (seen * weight), rcond=None)[0]
        return model @ level - seen * weight

    start = np.array([*(uv - [u, v]), np.arctan2(*along[::-1]), np.arctan2(*down[::-1]), _BLUR_PX])
    bounds = start - [4, 4, 0.5, 0.5, _BLUR_PX - 0.3], start + [4, 4, 0.5, 0.5, 6.0]
    scale = [0.5, 0.5, 0.05, 0.05, 0.5]
    weight, found = np.ones_like(x), start
    for _ in range(2):
        found = least_squares(misfit, found, bounds=bounds, x_scale=scale, max_nfev=30, args=(weight,)).x
        weight = _weight(misfit(found, np.ones_like(x)), edges(found))
    moved = found[:2] + [u, v]
    return moved if np.hypot(*(moved - uv)) < _FARTHEST_PX else uv


def _weight(residual: Array, edges: Array) -> Array:
    """Weights (N,) of pixels by the scatter on either kind of square, in between where an edge is blurred."""
    sides = [residual[side * edges > _OFF_EDGE] for side in (1, -1)]
    if min(len(side) for side in sides) < _LEAST_PIXELS:
        return np.ones_like(residual)
    variance = np.array([float(np.mean(side**2)) for side in sides])
    variance = np.maximum(variance / max(float(variance.max()), 1e-12), _LEAST_NOISE**2)
    return 1 / np.sqrt(variance[1] + (variance[0] - variance[1]) * 0.5 * (1 + edges))


def _edge(x: Array, y: Array, angle: float, blur: float) -> Array:
    """A blurred step, -1 to 1, across a line through the origin."""
    return np.asarray(erf((y * np.cos(angle) - x * np.sin(angle)) / (np.sqrt(2) * blur)), float)
