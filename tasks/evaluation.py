"""How far products are from a truth or a reference: trajectories, surfaces, uncertainties, coverage.

Everything is in one right-handed metric frame, z up: the truth's local frame, or the reference's.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

Array = NDArray[np.float64]
Surface = Callable[[Array, Array], Array]

# The fit of a surface to its truth: scale of the soft L1 loss, cells used for the search and for the result,
# shifts tried each way, and how many of the best are followed to their minimum.
_SOFT_M = 0.02
_SEARCH_CELLS, _FIT_CELLS = 3000, 20_000
_SEARCH_M = np.linspace(-1, 1, 21)
_FOLLOWED = 4
# A camera that is not quite upright sees farther than its footprint on level ground
_ASKEW = 1.6


class Similarity(NamedTuple):
    """B = scale * R @ A + t.

    Attributes
    ----------
    scale : 1 for a rigid motion.
    R : (3, 3) rotation.
    t : (3,) metres.
    """

    scale: float
    R: Array
    t: Array

    def apply(self, X: Array) -> Array:
        return self.scale * X @ self.R.T + self.t


class TrajectoryErrors(NamedTuple):
    """Camera centres against the truth.

    Attributes
    ----------
    rigid_rms_m : after the rigid motion that fits best.
    similarity_rms_m : after the similarity that fits best.
    scale_error_pct : how much larger than the estimate the truth is, percent.
    absolute_rms_m : with no alignment.
    """

    rigid_rms_m: float
    similarity_rms_m: float
    scale_error_pct: float
    absolute_rms_m: float


class Shift(NamedTuple):
    """How a surface must be moved to lie on its truth: turned about the mean of its cells, then shifted.

    Attributes
    ----------
    east_m, north_m, up_m : shift.
    yaw_deg : turn about the vertical, counter-clockwise.
    tilt_east_deg, tilt_north_deg : slopes added towards east and north.
    centre : (2,) mean x, y of the cells, about which it turns.
    """

    east_m: float
    north_m: float
    up_m: float
    yaw_deg: float
    tilt_east_deg: float
    tilt_north_deg: float
    centre: Array


class Spread(NamedTuple):
    """Sizes of differences, metres."""

    rmse_m: float
    median_abs_m: float
    p95_abs_m: float


class Agreement(NamedTuple):
    """A surface against a reference of the same place.

    Attributes
    ----------
    cells : cells compared.
    vertical_shift_m : median of surface minus reference.
    median_abs_m, p95_abs_m : of what is left after that shift.
    """

    cells: int
    vertical_shift_m: float
    median_abs_m: float
    p95_abs_m: float


class Coverage(NamedTuple):
    """Share of the seabed, in squares of 5 cm, that has a cell in the map.

    Attributes
    ----------
    seen : of what some camera saw.
    seen_twice : of what two or more cameras saw.
    Either is None if there is none.
    """

    seen: float | None
    seen_twice: float | None


def align(A: Array, B: Array, scale: bool = False) -> Similarity:
    """The rigid motion, or similarity, that takes points A (N, 3) to B (N, 3) with least squares (Umeyama 1991)."""
    mean_a, mean_b = A.mean(axis=0), B.mean(axis=0)
    U, singular, Vt = np.linalg.svd((B - mean_b).T @ (A - mean_a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(signs) @ Vt
    spread = ((A - mean_a) ** 2).sum()
    factor = float(singular @ signs / spread) if scale and spread > 0 else 1.0
    return Similarity(factor, R, mean_b - factor * R @ mean_a)


def rms(difference: Array) -> float:
    """Root mean square length of vectors (N, 3)."""
    return float(np.sqrt((difference**2).sum(axis=-1).mean()))


def trajectory_errors(C: Array, C_true: Array) -> TrajectoryErrors:
    """Compares camera centres (N, 3) with their truth (N, 3)."""
    rigid, similar = align(C, C_true), align(C, C_true, scale=True)
    return TrajectoryErrors(
        rms(rigid.apply(C) - C_true), rms(similar.apply(C) - C_true), 100 * (similar.scale - 1), rms(C - C_true)
    )


def grid_surface(h: NDArray, half_m: float, cell_m: float, depth_m: float) -> Surface:
    """Bilinear elevation of a square grid of heights above the level -depth_m; row 0 south, column 0 west."""

    def height(x: Array, y: Array) -> Array:
        at = [(np.asarray(y) + half_m) / cell_m, (np.asarray(x) + half_m) / cell_m]
        return np.asarray(map_coordinates(h, at, order=1, mode="nearest", output=np.float64)) - depth_m

    return height


def repeated(surface: Surface, period_m: float) -> Surface:
    """A surface known around the origin that repeats itself east and north."""

    def height(x: Array, y: Array) -> Array:
        return surface(*(v - period_m * np.round(np.asarray(v) / period_m) for v in (x, y)))

    return height


def fit_shift(X: Array, surface: Surface) -> Shift:
    """Finds how cells X (N, 3) must be moved to lie on a surface.

    Six unknowns by robust least squares (soft L1). Relief has many minima, so shifts of up to a metre each way are
    tried first.
    """
    centre = X[:, :2].mean(axis=0)
    order = np.random.default_rng(0).permutation(len(X))
    some, more = X[order[:_SEARCH_CELLS]], X[order[:_FIT_CELLS]]

    def solve(start: Array, cells: Array):
        def residual(p: Array) -> Array:
            return _residual(p, cells, centre, surface)

        return least_squares(residual, start, loss="soft_l1", f_scale=_SOFT_M, max_nfev=40)

    tried = []
    for east, north in itertools.product(_SEARCH_M, _SEARCH_M):
        start = np.array([east, north, 0, 0, 0, 0])
        left = _residual(start, some, centre, surface)
        start[2] = -np.median(left)
        tried.append((float(np.hypot((left + start[2]) / _SOFT_M, 1).sum()), start))
    # of equals, as over a plane, the smallest shift
    tried.sort(key=lambda t: (round(t[0], 6), np.hypot(*t[1][:2])))
    best = min((solve(start, some) for _, start in tried[:_FOLLOWED]), key=lambda t: t.cost)
    p = solve(best.x, more).x
    yaw, tilt_east, tilt_north = np.degrees(p[3:]).tolist()
    return Shift(float(p[0]), float(p[1]), float(p[2]), yaw, tilt_east, tilt_north, centre)


def _residual(p: Array, X: Array, centre: Array, surface: Surface) -> Array:
    """Elevation differences (N,) of cells moved by east, north, up (metres), yaw and two tilts (radians)."""
    x, y = (X[:, :2] - centre).T
    cosine, sine = np.cos(p[3]), np.sin(p[3])
    moved_x = centre[0] + cosine * x - sine * y + p[0]
    moved_y = centre[1] + sine * x + cosine * y + p[1]
    return X[:, 2] + p[2] + p[4] * x + p[5] * y - surface(moved_x, moved_y)


def residuals(X: Array, shift: Shift, surface: Surface) -> Array:
    """Elevation differences (N,) of cells X (N, 3) to a surface after a shift, metres."""
    angles = np.radians([shift.yaw_deg, shift.tilt_east_deg, shift.tilt_north_deg])
    return _residual(np.array([shift.east_m, shift.north_m, shift.up_m, *angles]), X, shift.centre, surface)


def spread(difference: Array) -> Spread:
    """Root mean square, median and 95th percentile of the size of differences (N,)."""
    size = abs(difference)
    return Spread(float(np.sqrt((size**2).mean())), float(np.median(size)), float(np.percentile(size, 95)))


def honesty(difference: Array, sigma: Array) -> tuple[float | None, float | None]:
    """Shares of differences (N,) smaller than 1 and 2 of their stated sigma (N,); about 0.68 and 0.95 if honest.

    None where no cell states a sigma.
    """
    stated = np.isfinite(sigma) & (sigma > 0)
    if not stated.any():
        return None, None
    ratio = abs(difference[stated]) / sigma[stated]
    return float((ratio < 1).mean()), float((ratio < 2).mean())


def agreement(z: Array, z_reference: Array) -> Agreement:
    """Compares elevations (N,) with a reference's (N,), after the median vertical shift between them."""
    difference = z - z_reference
    shift = float(np.median(difference))
    left = spread(difference - shift)
    return Agreement(len(z), shift, left.median_abs_m, left.p95_abs_m)


def altitude_bias_pct(above_map: Array, above_truth: Array) -> float:
    """Median error of the cameras' altitudes (N,) above the map, percent of those above the truth (N,).

    What is wrong here is the laser's or the scale's error, not the navigation's.
    """
    return float(np.median(above_map / above_truth - 1) * 100)


def coverage(
    X: Array, surface: Surface, half_m: float, R: Array, C: Array, K: Array, square_m: float = 0.05
) -> Coverage:
    """How much of what cameras saw has a cell.

    Parameters
    ----------
    X : (N, 3) the map's cells.
    surface : the true seabed, from -half_m to half_m east and north.
    R, C : (n, 3, 3) R_local_camera and (n, 3) centres of the cameras.
    K : (3, 3) camera matrix; the image is taken to be twice the principal point wide and high.
    """
    axis = np.arange(-half_m, half_m, square_m)
    x, y = np.meshgrid(axis, axis)
    ground = np.stack([x, y, surface(x, y)], -1)
    reach = K[:2, 2] / np.diag(K)[:2]
    farthest = _ASKEW * np.hypot(*reach) * (C[:, 2] - ground[..., 2].min())
    seen = np.zeros(x.shape, int)
    for rotation, centre, away in zip(R, C, farthest, strict=True):
        column, row = ((np.array([-away, away]) + v + half_m) / square_m for v in centre[:2])
        near = tuple(slice(max(0, int(low)), max(0, int(high) + 2)) for low, high in (row, column))
        point = (ground[near] - centre) @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = (abs(point[..., :2] / point[..., 2:]) < reach).all(axis=-1)
        seen[near] += inside & (point[..., 2] > 0)
    there = np.zeros(x.shape, bool)
    column, row = np.round((X[:, :2].T + half_m) / square_m).astype(int)
    within = (column >= 0) & (row >= 0) & (column < len(axis)) & (row < len(axis))
    there[row[within], column[within]] = True
    return Coverage(_share(there, seen > 0), _share(there, seen > 1))


def _share(there: NDArray[np.bool_], of: NDArray[np.bool_]) -> float | None:
    return float((there & of).sum() / of.sum()) if of.any() else None
