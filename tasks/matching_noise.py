"""What matched cells err by, measured where the laser has seen the same cells.

The noise of the images says what a pair errs by on a plane; that windows of matching round off what is rough and that
neighbours share them, it does not say. So cells of matching are compared with the laser's, which is finer.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .gridding import LASER, MATCHING, Cells, group_index, group_median
from .grids import Grid, window

Array = NDArray[np.float64]

# poses move matching against the laser by decimetres of ground at a time
_BLOCK_M, _BLOCK_CELLS, _LEAST_IN_BLOCK = 0.5, 25, 12
_LEAST_COMPARED = 100
_USUAL = 1.5  # where the laser says too little: of simulated surveys, 1.1 on even ground to 1.8 on rough
_MOST = 3.0
_ONE_SIGMA, _TWO_SIGMA = 0.6827, 0.9545


class Beside(NamedTuple):
    """Cells of matching beside the laser's; (K,) m.

    Attributes
    ----------
    error : of the elevation, without what poses do to the place.
    noise, laser : stated 1-sigma of the cell's noise, and of the laser's.
    """

    error: Array
    noise: Array
    laser: Array


NOTHING = Beside(*np.zeros((3, 0)))


def instead_of_laser(cells: Cells, beside: Cells) -> Cells:
    """The cells as matching alone would have them wherever it has something to say (`gridding.beside_laser`)."""
    known = beside.source == MATCHING
    return Cells(*(np.where(known, theirs, mine) for mine, theirs in zip(cells, beside, strict=True)))


def compare(grid: Grid, matched: Cells, cells: Cells, counted: Grid) -> Beside:
    """Matched cells, by `instead_of_laser` and `smooth.matched`, beside those of the laser.

    counted : the part of the grid whose cells count.
    """
    inner = window(grid, counted)
    both = np.zeros(grid.shape, bool)
    both[inner] = ((cells.source == LASER) & (matched.source == MATCHING))[inner]
    south, east = np.gradient(matched.elevation, grid.cell_m)
    # both are where their soundings lie on average, which is not the same place
    off = matched.elevation - cells.elevation - east * (matched.x - cells.x) + south * (matched.y - cells.y)
    finer = cells.noise < matched.noise  # else the laser tells nothing
    row, column = np.nonzero(both & np.isfinite(off) & finer)
    across = max(_BLOCK_CELLS, round(_BLOCK_M / grid.cell_m))
    place = np.column_stack([(grid.top - row) // across, (grid.left + column) // across])
    order = np.lexsort(place.T)
    row, column, block = row[order], column[order], group_index(place[order])
    if not len(row):
        return NOTHING
    error = off[row, column]
    error = error - group_median(block, error)[block]
    enough = (np.bincount(block) >= _LEAST_IN_BLOCK)[block]
    return Beside(error[enough], matched.noise[row, column][enough], cells.noise[row, column][enough])


def noise_scale(beside: Beside) -> float:
    """Error of matched cells over their stated noise, from 1 to 3; the usual one where the laser says too little.

    The scale under which 68 % of the differences are within one sigma; where their tail is longer than a normal
    distribution's, widened halfway, on a scale of ratios, to what would hold 95 % within two.
    """
    error, noise, laser = beside
    if len(error) < _LEAST_COMPARED:
        return _USUAL
    scale = float(np.quantile(np.sqrt(np.maximum(error**2 - laser**2, 0)) / noise, _ONE_SIGMA))
    tail = float(np.quantile(np.abs(error) / np.hypot(scale * noise, laser), _TWO_SIGMA)) / 2
    return min(max(1.0, scale * max(1.0, tail) ** 0.5), _MOST)
