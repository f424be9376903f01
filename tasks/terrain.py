"""The ground under a mosaic: its height at each cell and what it hides from a camera."""

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .frames import LocalAffine
from .grids import Grid, axes, grid_around, intersection, pad, window

Array = NDArray[np.float64]

_FLOAT32_M: Final = 1e-3  # more than heights lose as float32
_RINGS: Final = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)  # cells; between two the nearer distance is taken


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
    cell : which one it is: the flat index of the cell that it began in, or its number.
    row, column : where it began in the terrain's grid.
    down, right : rows and columns gained by a step, which is as long as a cell.
    height, rise : m, above which ground hides the cell at the start, and what a step adds.
    steps : to the camera.
    """

    cell: NDArray[np.int64]
    row: NDArray[Any]
    column: NDArray[Any]
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


def horizon(terrain: Terrain) -> Array:
    """What the ground around each cell of the terrain may rise to: tangent of an angle, -inf for nothing.

    Never less than in any one direction: a camera that stands higher above a cell sees it, and no ray has to be
    followed to know.
    """
    z = np.where(np.isfinite(terrain.elevation), terrain.elevation, -np.inf)
    highest, steepest, nearer = (z + _FLOAT32_M).astype(np.float32), np.full(z.shape, -np.inf), 0
    for reach in [*_RINGS, max(z.shape)]:
        if reach <= nearer:
            continue
        if reach in _RINGS:
            window = np.ones((2 * (reach - nearer) + 1,) * 2, np.uint8)
            highest = cv2.dilate(highest, window, borderType=cv2.BORDER_CONSTANT, borderValue=-np.inf)
        else:
            highest = np.full(z.shape, highest.max(initial=-np.inf))
        with np.errstate(invalid="ignore"):
            rise = (highest - z) / terrain.grid.cell_m - 1
        steepest = np.fmax(steepest, rise / (nearer + 1))
        nearer = reach
    return steepest


def hidden(terrain: Terrain, steepest: Array, cells: Grid, C_map: Array) -> Array:
    """Share 0..1 of cells (height, width) that terrain hides from a camera at C_map (3,), map coordinates.

    Marches on the bathymetry's grid from each of its cells towards the camera, a cell at a time, until the ray is
    above all ground. Ground hides when it rises above the ray by more than a cell's size, so that a rough slope
    does not hide itself. Only cells below their `horizon`, steepest, can be hidden.
    """
    grid = intersection(terrain.grid, pad(grid_around(cells.bounds, terrain.grid.cell_m), 1))
    if grid is None:
        return np.zeros(cells.shape)
    rows, columns = window(terrain.grid, grid)
    rays = _rays(terrain, steepest, grid, C_map)
    if not len(rays.cell):
        return np.zeros(cells.shape)
    found = np.where(np.isfinite(terrain.elevation[rows, columns]), 0.0, np.nan)
    found.reshape(-1)[_blocked(terrain, rays)] = 1.0
    return np.nan_to_num(resample(found, grid, cells)) if (found == 1).any() else np.zeros(cells.shape)


def _blocked(terrain: Terrain, rays: _Rays) -> NDArray[np.int64]:
    """The rays, by `cell`, that meet ground on their way."""
    top = float(np.nanmax(terrain.elevation)) if np.isfinite(terrain.elevation).any() else -np.inf
    found, step = [np.zeros(0, np.int64)], 0
    while len(rays.cell):
        step += 1
        height = rays.height + step * rays.rise
        row = np.floor(rays.row + step * rays.down + 0.5).astype(np.int64)
        column = np.floor(rays.column + step * rays.right + 0.5).astype(np.int64)
        going = (step < rays.steps) & (height < top)
        going &= (row >= 0) & (row < terrain.grid.height) & (column >= 0) & (column < terrain.grid.width)
        going = np.flatnonzero(going)
        blocked = terrain.elevation[row[going], column[going]] > height[going]
        found.append(rays.cell[going[blocked]])
        rays = _Rays._make(values[going[~blocked]] for values in rays)
    return np.concatenate(found)


def _rays(terrain: Terrain, steepest: Array, grid: Grid, C_map: Array) -> _Rays:
    """The rays from those cells of a part of the terrain's grid that may be hidden."""
    rows, columns = window(terrain.grid, grid)
    x, y = axes(grid)
    ground, east, north = terrain.elevation[rows, columns], C_map[0] - x, (C_map[1] - y)[:, None]
    away = np.maximum(np.sqrt(east**2 + north**2), 1e-9)
    above = C_map[2] - ground
    with np.errstate(invalid="ignore"):
        cell = np.flatnonzero((above > 0) & (above < steepest[rows, columns] * away))
    row, column = np.divmod(cell, grid.width)
    height, away = ground.ravel()[cell], away.ravel()[cell]
    return _Rays(
        cell,
        row + rows.start,
        column + columns.start,
        -north.ravel()[row] / away,
        east[column] / away,
        height + grid.cell_m,
        grid.cell_m * (C_map[2] - height) / away,
        away / grid.cell_m,
    )


def slopes(terrain: Terrain, smooth_cells: int = 5) -> tuple[Array, Array]:
    """Slopes dz/dx and dz/dy of the terrain's cells, mean over so many cells; 0 where there is no ground."""
    known = np.isfinite(terrain.elevation)
    down, right = np.gradient(np.where(known, terrain.elevation, np.nan), terrain.grid.cell_m)
    return _mean(right, smooth_cells), _mean(-down, smooth_cells)


def _mean(values: Array, cells: int) -> Array:
    known = np.isfinite(values).astype(float)
    total, weight = (
        cv2.blur(layer, (cells, cells), borderType=cv2.BORDER_CONSTANT) for layer in (np.nan_to_num(values), known)
    )
    return np.where(weight > 0.5 / cells**2, total / np.maximum(weight, 1e-9), 0.0)
