"""What a densely matched pair says of each map cell, and whether what is surely known around it bears that out."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .gridding import group_index, group_median, ranked

Array = NDArray[Any]
Mask = NDArray[np.bool_]

_LEAST_POINTS = 3  # of a cell; half of what it could have where that is less
_NEIGHBOURS = 8
_STEEPEST = 1.0  # rise over run from the points known to a cell among them
_NEAR_PX = 2.0
_ONE_SIGMA = 0.6827
_LEAST_COMPARED = 30
_AROUND = 12  # cells that soundings are compared with,
_BLOCK_CELLS, _LEAST_IN_BLOCK = 25, 12
_AROUND_CELLS, _OFF_CENTRE = 4.5, 1.5  # none farther than this many cells, their middle no farther than that many


class PairCells(NamedTuple):
    """One point for each cell that a pair has matched.

    Attributes
    ----------
    X_map : (M, 3) mean position and median elevation of the cell's points, m.
    metres_per_px : (M,) 1-sigma of the elevation for a pixel of disparity, m.
    borne_out : (M,) whether laser and tie points around it say the same, within what terrain may do between them.
    noise_px : (M,) 1-sigma of the disparity by the noise of the images.
    """

    X_map: Array
    metres_per_px: Array
    borne_out: Mask
    noise_px: Array


NO_CELLS = PairCells(np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool), np.zeros(0))


def reduce_to_cells(
    X_map: Array, metres_per_px: Array, noise_px: Array, known_map: Array, cell_m: float, points_a_cell: float = np.inf
) -> PairCells:
    """Cells of the points (N, 3) of a pair, map coordinates.

    known_map : (K, 3) laser and tie points around. points_a_cell : that a cell can have.
    """
    if not len(X_map):
        return NO_CELLS
    column, row = np.floor(X_map[:, :2] / cell_m).astype(np.int64).T
    cell = (row - row.min()) * (np.ptp(column) + 1) + column - column.min()
    order = ranked(cell, X_map[:, 2])
    group = group_index(cell[order])
    count = np.bincount(group)
    enough = count >= min(_LEAST_POINTS, points_a_cell / 2)
    order, group = order[enough[group]], group_index(group[enough[group]])
    if not len(order):
        return NO_CELLS
    X, count = X_map[order], np.bincount(group)
    base = X[0]  # eastings of a million metres lose no digits
    means = (X[:, 0] - base[0], X[:, 1] - base[1], metres_per_px[order], noise_px[order])
    x, y, scale, noise = (np.bincount(group, v) / count for v in means)
    start, z = np.cumsum(count) - count, X[:, 2]  # in rising order in each cell
    median = (z[start + (count - 1) // 2] + z[start + count // 2]) / 2
    cells = np.column_stack([x + base[0], y + base[1], median])
    return PairCells(cells, scale, _borne_out(cells, scale, known_map), noise)


def _borne_out(X: Array, metres_per_px: Array, known: Array) -> Mask:
    """Which points lie between the lowest and the highest of the points known around them, or nearly so.

    Where a boulder hides the ground from one image, matching invents ground, decimetres off and smooth.
    """
    if len(known) < _NEIGHBOURS:
        return np.zeros(len(X), bool)
    base = known[0, :2]
    away, nearest = (np.asarray(v) for v in KDTree(known[:, :2] - base).query(X[:, :2] - base, k=_NEIGHBOURS))
    z = known[nearest, 2]
    margin = _NEAR_PX * metres_per_px + _STEEPEST * away[:, 0]
    return (X[:, 2] > z.min(1) - margin) & (X[:, 2] < z.max(1) + margin)


class Differences(NamedTuple):
    """Points less the laser's soundings beside them: (K,) metres, and in pixels of disparity."""

    metres: Array
    px: Array


NO_DIFFERENCES = Differences(np.zeros(0), np.zeros(0))


def differences(X_map: Array, metres_per_px: Array, laser_map: Array, within_m: float) -> Differences:
    """Differences in elevation of points (N, 3) from the laser's nearest sounding, where one is near."""
    if not len(laser_map) or not len(X_map):
        return NO_DIFFERENCES
    base = laser_map[0, :2]
    away, nearest = (np.asarray(v) for v in KDTree(laser_map[:, :2] - base).query(X_map[:, :2] - base))
    near = away < within_m
    off = X_map[near, 2] - laser_map[nearest[near], 2]
    return Differences(off, off / metres_per_px[near])


def departures(X_map: Array, metres_per_px: Array, laser_map: Array, cell_m: float) -> Differences:
    """Differences of matched cells (M, 3) from one image's soundings (L, 3), without what single ones err by.

    The plane through the cells around, less the mean of the soundings of a cell where those lie; of that the medians
    of blocks some decimetres wide. So neither slopes nor noise nor roughness count, and what is left is what the poses
    do to either.
    """
    if len(X_map) < _AROUND or not len(laser_map):
        return NO_DIFFERENCES
    base = X_map.mean(0)
    cells, at = X_map - base, _means(laser_map - base, cell_m)
    away, near = (np.asarray(v) for v in KDTree(cells[:, :2]).query(at[:, :2], k=_AROUND))
    beside = cells[near] - at[:, None]
    centred = np.hypot(*beside[..., :2].mean(1).T) < _OFF_CENTRE * cell_m
    good = centred & (away[:, -1] < _AROUND_CELLS * cell_m)
    if not good.any():
        return NO_DIFFERENCES
    design = np.concatenate([np.ones((*beside.shape[:2], 1)), beside[..., :2] / cell_m], -1)[good]
    normal = np.einsum("nki,nkj->nij", design, design) + 1e-6 * np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", design, beside[good, :, 2])[..., None])
    off, scale = plane[:, 0, 0], metres_per_px[near[good, 0]]
    _, block = np.unique(np.floor(at[good, :2] / (_BLOCK_CELLS * cell_m)), axis=0, return_inverse=True)
    order = np.argsort(block.reshape(-1), kind="stable")
    block, off, scale = block.reshape(-1)[order], off[order], scale[order]
    enough = np.bincount(block) >= _LEAST_IN_BLOCK
    middle = group_median(block, off)
    scatter = 1.48 * group_median(block, np.abs(off - middle[block]))
    # of a median over that many; what it could be by chance does not count
    chance = 1.25 * scatter / np.sqrt(np.bincount(block))
    metres = np.sqrt(np.maximum(middle**2 - chance**2, 0))[enough]
    return Differences(metres, metres / group_median(block, scale)[enough])


def _means(X: Array, cell_m: float) -> Array:
    """Mean points (M, 3) of the cells that some points (N, 3) lie in."""
    _, group = np.unique(np.floor(X[:, :2] / cell_m).astype(np.int64), axis=0, return_inverse=True)
    group = group.reshape(-1)
    return np.column_stack([np.bincount(group, column) for column in X.T]) / np.bincount(group)[:, None]


def tell(off: Array) -> bool:
    """Whether differences (K,) are enough to say something."""
    return len(off) >= _LEAST_COMPARED


def share_of_each(off: Array, otherwise: float) -> float:
    """1-sigma of either side of differences (K,): two thirds of them are within it, times the root of two.

    The poses of the laser's image and those of the pair are held by the same tie points, so either has half of the
    variance. Too few differences say nothing.
    """
    if not tell(off):
        return otherwise
    return float(np.quantile(np.abs(off), _ONE_SIGMA) / np.sqrt(2))
