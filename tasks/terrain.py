"""The ground under a mosaic: its height at each cell and what it hides from a camera."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .frames import LocalAffine
from .grids import Grid, axes, grid_around, intersection, pad, window

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Terrain(NamedTuple):
    """What a tile lies on.

    Attributes
    ----------
    elevation : of the cells of `grid`, m, NaN for none.
    grid : grid of the bathymetry around the tile.
    local : from map to local around the tile.
    """

    elevation: Array
    grid: Grid
    local: LocalAffine


class _Rays(NamedTuple):
    """Rays under way from cells to the camera, (K,) each.

    Attributes
    ----------
    cell : flat index of the cell that it began in.
    row, column : of that cell in the terrain's grid.
    down, right : rows and columns gained by a step, which is as long as a cell.
    height, rise : m, above which ground hides the cell at the start, and what a step adds.
    steps : to the camera.
    """

    cell: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    down: Array
    right: Array
    height: Array
    rise: Array
    steps: Array


def resample(values: Array, grid: Grid, target: Grid) -> Array:
    """Values of grid at the centres of target's cells, bilinear; NaN where less than half of the weight has data."""
    column, x = _between(axes(target)[0], axes(grid)[0][0], grid.cell_m, grid.width)
    row, y = _between(-axes(target)[1], -axes(grid)[1][0], grid.cell_m, grid.height)
    known = np.isfinite(values)
    total, weight = (
        _bilinear(np.pad(layer, 1), row, y[:, None], column, x)
        for layer in (np.where(known, values, 0.0), known.astype(float))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(weight >= 0.5, total / weight, np.nan)


def _between(at: Array, first: float, cell_m: float, size: int) -> tuple[NDArray[np.int64], Array]:
    """Index, in an axis with one node more at either end, of the node before each position, and the next's weight."""
    # both are whole multiples of half a cell, counted from the map's origin: the same bits in every tile
    place = at / cell_m - first / cell_m
    before = np.floor(place)
    outside = (before < -1) | (before >= size)
    return np.where(outside, 0, before + 1).astype(np.int64), np.where(outside, 0.0, place - before)


def _bilinear(padded: Array, row: NDArray[np.int64], y: Array, column: NDArray[np.int64], x: Array) -> Array:
    lines = padded[row] * (1 - y) + padded[row + 1] * y
    return lines[:, column] * (1 - x) + lines[:, column + 1] * x


def hidden(terrain: Terrain, cells: Grid, C_map: Array) -> Mask:
    """Cells (height, width) that terrain hides from a camera at C_map (3,), map coordinates.

    Marches on the bathymetry's grid from each of its cells towards the camera, a cell at a time, until the ray is
    above all ground. Ground hides when it rises above the ray by more than a cell's size, so that a rough slope
    does not hide itself.
    """
    grid = intersection(terrain.grid, pad(grid_around(cells.bounds, terrain.grid.cell_m), 1))
    if grid is None:
        return np.zeros(cells.shape, bool)
    rows, columns = window(terrain.grid, grid)
    ground = terrain.elevation[rows, columns]
    found = np.where(np.isfinite(ground), 0.0, np.nan)
    rays = _rays(grid, ground, C_map, rows.start, columns.start)
    top = np.nanmax(terrain.elevation, initial=-np.inf) if np.isfinite(ground).any() else -np.inf
    step = 0
    while len(rays.cell):
        step += 1
        height = rays.height + step * rays.rise
        row = np.floor(rays.row + step * rays.down + 0.5).astype(np.int64)
        column = np.floor(rays.column + step * rays.right + 0.5).astype(np.int64)
        going = (step < rays.steps) & (height < top)
        going &= (row >= 0) & (row < terrain.grid.height) & (column >= 0) & (column < terrain.grid.width)
        going = np.flatnonzero(going)
        blocked = terrain.elevation[row[going], column[going]] > height[going]
        found.reshape(-1)[rays.cell[going[blocked]]] = 1.0
        rays = _Rays._make(values[going[~blocked]] for values in rays)
    if not (found == 1).any():
        return np.zeros(cells.shape, bool)
    return resample(found, grid, cells) > 0.5


def _rays(grid: Grid, ground: Array, C_map: Array, row_start: int, column_start: int) -> _Rays:
    cell = np.flatnonzero(np.isfinite(ground) & (ground < C_map[2]))
    row, column = np.divmod(cell, grid.width)
    x, y = axes(grid)
    east, north = C_map[0] - x[column], C_map[1] - y[row]
    away = np.maximum(np.hypot(east, north), 1e-9)
    height = ground.ravel()[cell]
    return _Rays(
        cell,
        row + row_start,
        column + column_start,
        -north / away,
        east / away,
        height + grid.cell_m,
        grid.cell_m * (C_map[2] - height) / away,
        away / grid.cell_m,
    )
