"""Soundings to cells: elevation, uncertainty, density and source of each cell that was sounded (paper V)."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .grids import Grid, index_of, inside

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LASER: Final = 1
MATCHING: Final = 2
INTERPOLATED: Final = 3

_OUTLIER_SIGMAS = 4.0
_TWO_THIRDS_OF_SIGMA = 0.967  # two thirds of a normal distribution lie within so many sigmas


class Cells(NamedTuple):
    """What the soundings say of each cell of a grid; arrays (height, width), row 0 north.

    Attributes
    ----------
    elevation : m, weighted mean of the accepted soundings; NaN where there are none.
    sigma : m, 1-sigma of elevation; NaN where there are none.
    density : number of accepted soundings.
    source : uint8, 0 none, 1 laser, 2 image matching.
    x, y : map position to which elevation belongs, the weighted mean of the soundings' positions, m; NaN where none.
    """

    elevation: Array
    sigma: Array
    density: NDArray[np.int32]
    source: NDArray[np.uint8]
    x: Array
    y: Array


class _Soundings(NamedTuple):
    """Soundings sorted by cell, then frame."""

    cell: Indices
    frame: Indices
    X: Array
    sigma: Array
    pose_sigma: Array
    source: NDArray[np.uint8]

    def take(self, index: Indices | NDArray[np.bool_]) -> "_Soundings":
        return _Soundings(
            self.cell[index],
            self.frame[index],
            self.X[index],
            self.sigma[index],
            self.pose_sigma[index],
            self.source[index],
        )


def grid_soundings(
    grid: Grid, X_map: Array, sigma_m: Array, source: NDArray[np.uint8], frame: NDArray[np.integer], pose_sigma_m: Array
) -> Cells:
    """Grid soundings. A cell depends on nothing but the soundings within it, in whatever order and tile they come.

    Where a cell has laser soundings only these count; image matching fills the others. Soundings more than four
    robust sigmas from the cell's median are outliers. The rest are averaged with inverse variances in two steps:
    within a frame, where the error of the frame's pose is common to all and does not average down, then over
    frames, where it does. A scatter larger than the sigmas explain enlarges the result (Birge's ratio).

    Parameters
    ----------
    grid : the cells wanted; soundings outside are passed over.
    X_map : (N, 3) soundings in map coordinates, m.
    sigma_m : (N,) 1-sigma of each sounding's elevation on its own, m; positive.
    source : (N,) 1 laser, 2 image matching.
    frame : (N,) number of the image that each sounding comes from.
    pose_sigma_m : (N,) 1-sigma of the elevation that all soundings of the frame have in common, m.
    """
    soundings = _sorted(grid, X_map, sigma_m, source, frame, pose_sigma_m)
    soundings = _laser_first(soundings)
    soundings = soundings.take(~_outliers(soundings))
    return _means(grid, soundings)


def _sorted(
    grid: Grid, X_map: Array, sigma: Array, source: NDArray[np.uint8], frame: NDArray[np.integer], pose_sigma: Array
) -> _Soundings:
    row, column = index_of(grid, X_map)
    usable = inside(grid, row, column) & np.isfinite(X_map).all(1) & (sigma > 0)
    row, column = row[usable], column[usable]
    everything = _Soundings(
        row * grid.width + column,
        np.asarray(frame)[usable].astype(np.int64),
        X_map[usable],
        sigma[usable],
        pose_sigma[usable],
        np.asarray(source)[usable].astype(np.uint8),
    )
    # within a cell the order is that of the values, so sums have the same bits however the soundings came
    X = everything.X
    return everything.take(np.lexsort((X[:, 1], X[:, 0], X[:, 2], everything.frame, everything.cell)))


def _laser_first(soundings: _Soundings) -> _Soundings:
    """Without the matched soundings of cells that the laser has seen."""
    group = _group(soundings.cell)
    has_laser = np.bincount(group, weights=soundings.source == LASER, minlength=1) > 0
    return soundings.take((soundings.source == LASER) | ~has_laser[group])


def _group(keys: Indices) -> Indices:
    """0, 0, 1, 2, 2, ... for sorted keys (N,)."""
    return np.concatenate([[0], np.cumsum(keys[1:] != keys[:-1])]).astype(np.int64)[: len(keys)]


def group_median(group: Indices, values: Array) -> Array:
    """Median (G,) of values (N,) in each group 0..G-1 (N,)."""
    ranked, start, count = _ranked(group, values)
    return (ranked[start + (count - 1) // 2] + ranked[start + count // 2]) / 2


def _ranked(group: Indices, values: Array) -> tuple[Array, Indices, Indices]:
    """Values (N,) in rising order group by group, and each group's start and count, (G,)."""
    count = np.bincount(group)
    return values[np.lexsort((values, group))], np.cumsum(count) - count, count


def _outliers(soundings: _Soundings) -> NDArray[np.bool_]:
    """Farther than four sigmas from the cell's median; sigma is the spread of the nearer two thirds.

    So up to a third can be outliers; two images of about equal weight that contradict each other both stay, and
    enlarge the cell's sigma. A sounding's own sigma is the least spread that counts.
    """
    if not len(soundings.cell):
        return np.zeros(0, bool)
    group, z = _group(soundings.cell), soundings.X[:, 2]
    departure = np.abs(z - group_median(group, z)[group])
    ranked, start, count = _ranked(group, departure)
    spread = ranked[start + (2 * count + 2) // 3 - 1] / _TWO_THIRDS_OF_SIGMA
    expected = np.hypot(soundings.sigma, soundings.pose_sigma)
    # two soundings cannot say which of them is wrong
    return (departure > _OUTLIER_SIGMAS * np.maximum(spread[group], expected)) & (count[group] > 2)


def _means(grid: Grid, soundings: _Soundings) -> Cells:
    count = grid.width * grid.height
    density = np.bincount(soundings.cell, minlength=count).astype(np.int32)
    source = np.zeros(count, np.uint8)
    source[soundings.cell] = soundings.source
    position, sigma = np.full((count, 3), np.nan), np.full(count, np.nan)
    if len(soundings.cell):
        cells = np.flatnonzero(density)
        position[cells], sigma[cells] = _two_step_mean(soundings)
    x, y, z = (column.reshape(grid.shape) for column in position.T)
    return Cells(z, sigma.reshape(grid.shape), density.reshape(grid.shape), source.reshape(grid.shape), x, y)


def _two_step_mean(soundings: _Soundings) -> tuple[Array, Array]:
    """Mean positions (G, 3) of the G cells and sigma (G,) of their elevations."""
    of_cell = _group(soundings.cell)
    changes = (np.diff(of_cell) > 0) | (np.diff(soundings.frame) != 0)
    of_frame = np.concatenate([[0], np.cumsum(changes)])
    first = np.concatenate([[0], np.flatnonzero(changes) + 1])
    frame_cell = of_cell[first]

    weight = soundings.sigma**-2
    X, variance = _weighted_mean(of_frame, soundings.X, weight)
    variance = variance * _birge(of_frame, soundings.X[:, 2], X[:, 2], weight)
    # soundings of one frame share its pose; the largest of their pose sigmas stands for all
    pose = np.maximum.reduceat(soundings.pose_sigma, first)
    weight = 1 / (variance + pose**2)
    mean, variance = _weighted_mean(frame_cell, X, weight)
    return mean, np.sqrt(variance * _birge(frame_cell, X[:, 2], mean[:, 2], weight))


def _weighted_mean(group: Indices, X: Array, weight: Array) -> tuple[Array, Array]:
    """Means (G, 3) and their variance (G,)."""
    total = np.bincount(group, weight)
    # from each group's first member, so that eastings of a million metres lose no digits
    base = X[np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1])]
    rest = X - base[group]
    return base + np.column_stack([np.bincount(group, weight * rest[:, k]) for k in range(3)]) / total[
        :, None
    ], 1 / total


def _birge(group: Indices, z: Array, mean: Array, weight: Array) -> Array:
    """Scatter over what the weights explain, as a factor of variance (G,), at least 1."""
    chi_squared = np.bincount(group, weight * (z - mean[group]) ** 2)
    freedom = np.bincount(group) - 1
    return np.maximum(np.divide(chi_squared, freedom, out=np.ones_like(chi_squared), where=freedom > 0), 1)
