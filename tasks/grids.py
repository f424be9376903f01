"""Raster geometry: which cells there are and where they lie, kept apart from what is in them.

Cells are counted from the origin of the map's coordinates, so any two grids of one cell size fit on each other
and a cell's centre has the same bits in every tile. Row 0 is the northernmost.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Window = tuple[slice, slice]

_STEP_M = 1e-4  # automatic cell sizes are whole multiples of this


class Bounds(NamedTuple):
    """An upright rectangle of the map, metres."""

    west: float
    south: float
    east: float
    north: float


class Grid(NamedTuple):
    """A rectangle of square cells, aligned to whole multiples of the cell in map coordinates.

    Attributes
    ----------
    cell_m : side of a cell, metres.
    left, top : cells from the map's origin to the west edge and to the north edge.
    width, height : columns and rows.
    """

    cell_m: float
    left: int
    top: int
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.height, self.width

    @property
    def bounds(self) -> Bounds:
        """Outer edges, metres."""
        return Bounds(
            self.left * self.cell_m,
            (self.top - self.height) * self.cell_m,
            (self.left + self.width) * self.cell_m,
            self.top * self.cell_m,
        )


def bathymetry_cell_m(ground_sample_m: float) -> float:
    """Automatic cell of the bathymetry: the larger of 0.02 m and 4 ground sample distances (FORMATS)."""
    return _rounded_up(max(0.02, 4 * ground_sample_m))


def mosaic_cell_m(ground_sample_m: float) -> float:
    """Automatic cell of the mosaic: the larger of 0.002 m and one ground sample distance (FORMATS)."""
    return _rounded_up(max(0.002, ground_sample_m))


def max_interpolation_m(range_m: float) -> float:
    """How far the bathymetry is interpolated of itself: the larger of 1 m and a third of the range (FORMATS)."""
    return max(1.0, range_m / 3)


def _rounded_up(cell_m: float) -> float:
    return round(math.ceil(round(cell_m / _STEP_M, 6)) * _STEP_M, 4)


def grid_around(bounds: Bounds | tuple[float, float, float, float], cell_m: float) -> Grid:
    """The smallest grid that covers bounds (west, south, east, north), metres; at least one cell."""
    west, south, east, north = (round(value / cell_m, 6) for value in bounds)
    left, top = math.floor(west), math.ceil(north)
    return Grid(cell_m, left, top, max(1, math.ceil(east) - left), max(1, top - math.floor(south)))


def tiles(grid: Grid, size: int) -> Iterator[Grid]:
    """The grid cut into tiles of at most size x size cells, row by row from the north-west.

    Cuts are at whole multiples of size from the map's origin: where a later version's grid has grown, the old
    tiles stay the same tiles.
    """
    bottom, right = grid.top - grid.height, grid.left + grid.width
    for top in range(math.ceil(grid.top / size) * size, bottom, -size):
        for left in range(math.floor(grid.left / size) * size, right, size):
            tile = intersection(grid, Grid(grid.cell_m, left, top, size, size))
            if tile is not None:
                yield tile


def pad(grid: Grid, cells: int) -> Grid:
    """The grid with a rim of so many cells on each side; negative takes a rim off."""
    return Grid(grid.cell_m, grid.left - cells, grid.top + cells, grid.width + 2 * cells, grid.height + 2 * cells)


def intersection(a: Grid, b: Grid) -> Grid | None:
    """The cells that two grids share, None if there are none.

    Raises
    ------
    ValueError
        The grids have different cells.
    """
    if a.cell_m != b.cell_m:
        raise ValueError(f"grids of {a.cell_m} m and {b.cell_m} m cells do not fit on each other")
    left, right = max(a.left, b.left), min(a.left + a.width, b.left + b.width)
    top, bottom = min(a.top, b.top), max(a.top - a.height, b.top - b.height)
    return Grid(a.cell_m, left, top, right - left, top - bottom) if right > left and top > bottom else None


def window(outer: Grid, inner: Grid) -> Window:
    """Rows and columns of outer that inner takes up: array_of_outer[window(outer, inner)].

    Raises
    ------
    ValueError
        inner reaches outside of outer, or their cells differ.
    """
    if intersection(outer, inner) != inner:
        raise ValueError(f"{inner} does not lie within {outer}")
    row, column = outer.top - inner.top, inner.left - outer.left
    return slice(row, row + inner.height), slice(column, column + inner.width)


def axes(grid: Grid) -> tuple[Array, Array]:
    """Map x (width,) of the columns' centres and map y (height,) of the rows' centres, metres."""
    x = (np.arange(grid.left, grid.left + grid.width, dtype=np.float64) + 0.5) * grid.cell_m
    y = (np.arange(grid.top, grid.top - grid.height, -1, dtype=np.float64) - 0.5) * grid.cell_m
    return x, y


def cell_centres(grid: Grid) -> tuple[Array, Array]:
    """Map x and y of all cell centres, (height, width) each, metres."""
    X, Y = np.meshgrid(*axes(grid))
    return X, Y


def index_of(grid: Grid, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column (N,) of the cells that hold map points (N, 2 or more); may lie outside of the grid."""
    xy = np.asarray(xy, float)
    column = np.floor(xy[:, 0] / grid.cell_m).astype(np.int64) - grid.left
    row = grid.top - np.ceil(xy[:, 1] / grid.cell_m).astype(np.int64)
    return row, column


def inside(grid: Grid, row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which rows and columns (N,) are cells of the grid."""
    return (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
