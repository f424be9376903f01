"""Soundings to cells: elevation, uncertainty, density and source of each cell that was sounded (paper V)."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

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
    noise : m, 1-sigma of that part of elevation's error that neighbouring cells do not share.
    density : number of accepted soundings.
    source : uint8, 0 none, 1 laser, 2 image matching.
    x, y : map position to which elevation belongs, the weighted mean of the soundings' positions, m; NaN where none.
    """

    elevation: Array
    sigma: Array
    noise: Array
    density: NDArray[np.int32]
    source: NDArray[np.uint8]
    x: Array
    y: Array


class Soundings(NamedTuple):
    """Soundings of the seabed in map coordinates, by whatever means.

    Attributes
    ----------
    X : (N, 3) m. sigma : (N,) 1-sigma of each one's elevation on its own, m; positive.
    source : (N,) uint8, 1 laser, 2 image matching.
    frame : (N,) number of the image, or pair of images, that each comes from.
    pose_sigma : (N,) 1-sigma of the elevation that all of the frame have in common, m.
    doubtful : (N,) bool, those that count only if another frame says the same.
    """

    X: Array
    sigma: Array
    source: NDArray[np.uint8]
    frame: Indices
    pose_sigma: Array
    doubtful: NDArray[np.bool_]


class _Sorted(NamedTuple):
    """Soundings sorted by cell, then frame, with the flat index of the cell of each."""

    cell: Indices
    soundings: Soundings

    def take(self, index: Indices | NDArray[np.bool_]) -> "_Sorted":
        return _Sorted(self.cell[index], Soundings._make(values[index] for values in self.soundings))


def grid_soundings(grid: Grid, soundings: Soundings) -> Cells:
    """Grid soundings. A cell depends on nothing but the soundings within it, in whatever order and tile they come.

    Where a cell has laser soundings only these count; image matching fills the others, where doubtful soundings must
    be confirmed by another frame. Soundings more than four robust sigmas from the cell's median are outliers. The rest
    are averaged with inverse variances in two steps: within a frame, where the error of the frame's pose is common to
    all and does not average down, then over frames, where it does. A scatter larger than the sigmas explain enlarges
    the result (Birge's ratio). Soundings outside of the grid are passed over.
    """
    placed = _laser_first(_sorted(grid, soundings))
    placed = placed.take(~_unconfirmed(placed, grid.cell_m))
    return _means(grid, placed.take(~_outliers(placed)))


def beside_laser(grid: Grid, soundings: Soundings) -> Cells:
    """What image matching says of the cells that the laser has seen, of which `grid_soundings` tells the laser's."""
    row, column = index_of(grid, soundings.X)
    cell, laser = np.where(inside(grid, row, column), row * grid.width + column, -1), soundings.source == LASER
    lit = ~laser & np.isin(cell, cell[laser])
    return grid_soundings(grid, Soundings._make(values[lit] for values in soundings))


def _sorted(grid: Grid, soundings: Soundings) -> _Sorted:
    row, column = index_of(grid, soundings.X)
    usable = inside(grid, row, column) & np.isfinite(soundings.X).all(1) & (soundings.sigma > 0)
    everything = _Sorted(row * grid.width + column, soundings).take(usable)
    # within a cell the order is that of the values, so sums have the same bits however the soundings came
    X = everything.soundings.X
    return everything.take(np.lexsort((X[:, 1], X[:, 0], X[:, 2], everything.soundings.frame, everything.cell)))


def _laser_first(placed: _Sorted) -> _Sorted:
    """Without the matched soundings of cells that the laser has seen."""
    group, laser = group_index(placed.cell), placed.soundings.source == LASER
    has_laser = np.bincount(group, weights=laser, minlength=1) > 0
    return placed.take(laser | ~has_laser[group])


def _unconfirmed(placed: _Sorted, cell_m: float) -> NDArray[np.bool_]:
    """Doubtful soundings of which no other frame's in the cell, next above or below, is within four sigmas.

    Positions within a cell differ, so half a cell is let pass.
    """
    soundings = placed.soundings
    if not soundings.doubtful.any():
        return np.zeros(len(placed.cell), bool)
    order = np.lexsort((soundings.X[:, 2], placed.cell))
    cell, frame, z = placed.cell[order], soundings.frame[order], soundings.X[order, 2]
    variance = (soundings.sigma**2 + soundings.pose_sigma**2)[order]
    margin = _OUTLIER_SIGMAS * np.sqrt(variance[1:] + variance[:-1]) + cell_m / 2
    same = (np.diff(cell) == 0) & (np.diff(frame) != 0) & (np.diff(z) < margin)
    confirmed = np.zeros(len(cell), bool)
    confirmed[order] = np.append(same, False) | np.insert(same, 0, False)
    return soundings.doubtful & ~confirmed


def group_index(keys: Indices) -> Indices:
    """0, 0, 1, 2, 2, ... for sorted keys (N,) or rows of keys (N, K)."""
    new = keys[1:] != keys[:-1]
    return np.concatenate([[0], np.cumsum(new if new.ndim == 1 else new.any(1))]).astype(np.int64)[: len(keys)]


def ranked(group: Indices, values: Array) -> Indices:
    """Order (N,) by group, numbered from 0, then by value: that of `numpy.lexsort`, several times faster."""
    rising, count = np.argsort(values), len(values)
    if not count:
        return rising
    # the rows of a sparse matrix keep the order in which their entries come
    entries = rising, (group[rising], np.arange(count))
    return np.asarray(coo_array(entries, shape=(int(group.max()) + 1, count)).tocsr().data, np.int64)


def group_median(group: Indices, values: Array) -> Array:
    """Median (G,) of values (N,) in each group 0..G-1 (N,)."""
    rising, start, count = _rising(group, values)
    return (rising[start + (count - 1) // 2] + rising[start + count // 2]) / 2


def _rising(group: Indices, values: Array) -> tuple[Array, Indices, Indices]:
    """Values (N,) in rising order group by group, and each group's start and count, (G,)."""
    count = np.bincount(group)
    return values[ranked(group, values)], np.cumsum(count) - count, count


def _outliers(placed: _Sorted) -> NDArray[np.bool_]:
    """Farther than four sigmas from the cell's median; sigma is the spread of the nearer two thirds.

    So up to a third can be outliers; two images of about equal weight that contradict each other both stay, and
    enlarge the cell's sigma. A sounding's own sigma is the least spread that counts.
    """
    if not len(placed.cell):
        return np.zeros(0, bool)
    soundings, group = placed.soundings, group_index(placed.cell)
    z = soundings.X[:, 2]
    departure = np.abs(z - group_median(group, z)[group])
    rising, start, count = _rising(group, departure)
    spread = rising[start + (2 * count + 2) // 3 - 1] / _TWO_THIRDS_OF_SIGMA
    expected = np.hypot(soundings.sigma, soundings.pose_sigma)
    # two soundings cannot say which of them is wrong
    return (departure > _OUTLIER_SIGMAS * np.maximum(spread[group], expected)) & (count[group] > 2)


def _means(grid: Grid, placed: _Sorted) -> Cells:
    count = grid.width * grid.height
    density = np.bincount(placed.cell, minlength=count).astype(np.int32)
    source = np.zeros(count, np.uint8)
    source[placed.cell] = placed.soundings.source
    values = np.full((count, 5), np.nan)
    if len(placed.cell):
        values[np.flatnonzero(density)] = _two_step_mean(placed)
    x, y, z, sigma, noise = (column.reshape(grid.shape) for column in values.T)
    return Cells(z, sigma, noise, density.reshape(grid.shape), source.reshape(grid.shape), x, y)


def _two_step_mean(placed: _Sorted) -> Array:
    """Mean positions of the G cells, sigma and noise of their elevations, (G, 5)."""
    soundings, of_cell = placed.soundings, group_index(placed.cell)
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
    own = np.bincount(frame_cell, weight**2 * variance) / np.bincount(frame_cell, weight) ** 2
    mean, variance = _weighted_mean(frame_cell, X, weight)
    scatter = _birge(frame_cell, X[:, 2], mean[:, 2], weight)
    return np.column_stack([mean, np.sqrt(variance * scatter), np.sqrt(own * scatter)])


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
