"""A surface on coarser cells: means, over the area of each, of the cells that it was made on.

Soundings on a line through a large cell say much of the line and little of the cell, so large cells are not made of
soundings but of the surface.
"""

from typing import Final, NamedTuple

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from .gridding import INTERPOLATED, LASER, MATCHING
from .grids import Grid, axes, index_of

Array = NDArray[np.float64]

_LEAST_SHARE: Final = 0.5  # of a cell's area that must have a value


class Coarse(NamedTuple):
    """Layers of the coarser grid (height, width), as `surface.Surface` has them, and the soundings in each cell."""

    elevation: Array
    sigma: Array
    source: NDArray[np.uint8]
    density: NDArray[np.uint32]


def coarsen(fine: Grid, elevation: Array, sigma: Array, source: NDArray, density: NDArray, coarse: Grid) -> Coarse:
    """The layers (height, width) of a finer grid, NaN where it has no value, on the cells of a coarser one.

    Sigma is the mean of the cells' own, as errors of neighbours are much the same, and what the part of a cell that
    has no value may differ from the rest. The source is that of most of the cell's area.

    fine : covers the coarse grid and one cell around it, as far as there are values.
    """
    down, across = _weights(coarse, fine)

    def summed(values: NDArray) -> Array:
        """Integral (height, width) over each coarse cell."""
        return np.asarray((across @ (down @ values).T).T)

    known = np.isfinite(elevation)
    share = summed(known.astype(float)) / coarse.cell_m**2
    there = share >= _LEAST_SHARE
    area = np.where(there, share * coarse.cell_m**2, np.nan)
    level = float(np.mean(elevation[known])) if known.any() else 0.0
    z = np.where(known, elevation - level, 0.0)
    mean, square = summed(z) / area, summed(z * z) / area
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    own = summed(np.where(known, sigma, 0.0)) / area
    of_each = np.stack([summed((known & (source == code)).astype(float)) for code in (LASER, MATCHING, INTERPOLATED)])
    return Coarse(
        elevation=mean + level,
        sigma=np.hypot(own, np.maximum(1 - share, 0) * spread),
        source=np.where(there, 1 + of_each.argmax(0), 0).astype(np.uint8),
        density=np.where(there, _counted(coarse, fine, density), 0).astype(np.uint32),
    )


def _weights(coarse: Grid, fine: Grid) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Weights of rows, and of columns, of the fine grid in the integrals over those of the coarse one, metres."""
    x, y = axes(fine)
    rows, columns = (np.arange(count + 1, dtype=np.float64) for count in coarse.shape)
    south, west = (rows - coarse.top) * coarse.cell_m, (columns + coarse.left) * coarse.cell_m
    return _integrals(south, -y, fine.cell_m), _integrals(west, x, fine.cell_m)


def _integrals(edges: Array, centres: Array, step: float) -> sparse.csr_array:
    """(C, F): of what is linear between rising centres (F,), the integral between edges (C + 1,) by its values there.

    So planes keep their places, whatever cells begin or end within others.
    """
    first = np.searchsorted(centres, edges[:-1] - step, side="right")
    count = np.maximum(np.searchsorted(centres, edges[1:] + step, side="left") - first, 0)
    row = np.repeat(np.arange(len(count)), count)
    column = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + first[row]
    below, above = ((edges[k] - centres[column]) / step for k in (row, row + 1))
    weight = step * (_hat_integral(above) - _hat_integral(below))
    return sparse.csr_array((weight, (row, column)), shape=(len(edges) - 1, len(centres)))


def _hat_integral(u: Array) -> Array:
    """Integral up to u of the function that is 1 at 0 and falls to 0 at -1 and 1."""
    u = np.clip(u, -1, 1)
    return np.where(u < 0, (u + 1) ** 2 / 2, 1 - (1 - u) ** 2 / 2)


def _counted(coarse: Grid, fine: Grid, density: NDArray) -> NDArray:
    """Soundings of the fine cells whose centres lie in each coarse cell."""
    x, y = axes(fine)
    row, _ = index_of(coarse, np.column_stack([np.full(len(y), x[0]), y]))
    _, column = index_of(coarse, np.column_stack([x, np.full(len(x), y[0])]))
    rows, columns = (row >= 0) & (row < coarse.height), (column >= 0) & (column < coarse.width)
    total = np.zeros(coarse.shape, np.int64)
    np.add.at(total, np.ix_(row[rows], column[columns]), np.asarray(density, np.int64)[np.ix_(rows, columns)])
    return total
