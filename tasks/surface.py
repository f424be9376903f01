"""Delaunay surface of the sounded cells (paper IV: triangulation on x, y) and how sure it is.

A triangle counts where the circle through its corners has at most the radius `max_distance_m`. That one rule cuts
the long triangles over empty areas and along the rim, keeps every cell within that distance of a sounding, and
makes the surface local: whether a triangle is Delaunay depends only on what lies in its circle. So a halo of
twice that distance (`halo_cells`) gives each cell the same value in every tile.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.optimize import minimize
from scipy.spatial import Delaunay

from .gridding import INTERPOLATED, Cells
from .grids import Grid, cell_centres, window

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RIM_CELLS = 3  # any circle of this diameter, in cells, has a whole cell inside, whatever way it lies
_JITTER_CELLS = 1e-4  # so that no four vertices lie on one circle, where the triangulation would be a toss-up
_MIN_ERRORS = 30
_FIT_ERRORS = 20_000
_ONE_SIGMA, _TWO_SIGMA = 0.6827, 0.9545


class Growth(NamedTuple):
    """How the error of interpolation grows: sigma^2 = (scale_m distance^exponent)^2 + (relief spread)^2.

    Attributes
    ----------
    scale_m : 1-sigma at 1 m from the nearest sounding, m.
    exponent : of the distance to the nearest sounding in metres; 1 smooth seabed, about 0.5 rough.
    relief : sigma per metre of spread, the weighted standard deviation of the elevations that a value is
        interpolated from: between the top and the foot of a boulder anything may be.
    """

    scale_m: float = 0.05
    exponent: float = 0.6
    relief: float = 0.5


class Surface(NamedTuple):
    """The surface on a grid; arrays (height, width).

    Attributes
    ----------
    elevation : m at the cells' centres; NaN where the surface does not reach.
    sigma : m, 1-sigma; NaN where elevation is.
    source : uint8, 0 none, 1 laser, 2 image matching, 3 interpolated.
    """

    elevation: Array
    sigma: Array
    source: NDArray[np.uint8]


class _Reach(NamedTuple):
    """The triangles that wanted cells lie in.

    Attributes
    ----------
    cell : (K,) flat index of each cell that lies in one.
    corners : (K, 3) flat indices of the sounded cells at the corners.
    weights : (K, 3) of the corners at the cell's centre.
    distance : (K,) m, from the cell's centre to the nearest corner.
    """

    cell: NDArray[np.int64]
    corners: NDArray[np.int64]
    weights: Array
    distance: Array


def halo_cells(max_distance_m: float, cell_m: float) -> int:
    """Rim that a tile needs for its surface to be that of the whole map."""
    return math.ceil(2 * max_distance_m / cell_m) + 2 * _RIM_CELLS + 1


def _dense(cells: Cells, depth: int) -> Mask:
    """Cells that are sounded, as is every cell up to depth cells around them."""
    return np.asarray(minimum_filter(cells.density > 0, size=2 * depth + 1, mode="constant", cval=0), bool)


def _jitter(grid: Grid, flat: NDArray[np.int64]) -> Array:
    """Offsets (V, 2) in cells, a hash of the cell's place in the map, the same in every tile."""
    column = (grid.left + flat % grid.width).astype(np.uint64)
    row = (grid.top - flat // grid.width).astype(np.uint64)
    mixed = column * np.uint64(0x9E3779B97F4A7C15) + row * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    halves = np.column_stack([mixed >> np.uint64(40), (mixed >> np.uint64(16)) & np.uint64(0xFFFFFF)])
    return (halves / 2.0**24 - 0.5) * _JITTER_CELLS


def _triangles(grid: Grid, cells: Cells, max_distance_m: float) -> tuple[NDArray[np.int64], Array]:
    """Accepted triangles: corners (T, 3) as flat cells in rising order, and their x, y (T, 3, 2) in map metres.

    Cells deep in densely sounded ground are left out: they are no corner of a triangle over a cell that is not.
    """
    flat = np.flatnonzero((cells.density > 0) & ~_dense(cells, 2 * _RIM_CELLS))
    nothing = np.zeros((0, 3), np.int64), np.zeros((0, 3, 2))
    if len(flat) < 4:
        return nothing
    xy = np.column_stack([cells.x.ravel()[flat], cells.y.ravel()[flat]]) + _jitter(grid, flat) * grid.cell_m
    local = xy - xy.mean(0)
    if np.linalg.matrix_rank(local, tol=grid.cell_m) < 2:
        return nothing
    corners = np.sort(Delaunay(local).simplices.astype(np.int64), axis=1)
    corners = corners[_circumradius(xy[corners]) <= max_distance_m]
    return flat[corners], xy[corners]


def _circumradius(xy: Array) -> Array:
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    sides = [np.hypot(*a.T), np.hypot(*b.T), np.hypot(*(b - a).T)]
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    with np.errstate(divide="ignore"):
        return sides[0] * sides[1] * sides[2] / (2 * area)


def _in_cells(grid: Grid, xy: Array) -> tuple[Array, Array]:
    """Column and row of map positions (..., 2), whole at the cells' centres."""
    return xy[..., 0] / grid.cell_m - grid.left - 0.5, grid.top - xy[..., 1] / grid.cell_m - 0.5


def _rasterise(grid: Grid, xy: Array) -> NDArray[np.int64]:
    """Number of the triangle (of (T, 3, 2) map metres) over each cell's centre, (height * width,), -1 none."""
    x, y = _in_cells(grid, xy)
    first = np.maximum(np.ceil(y.min(1)), 0).astype(np.int64)
    rows = np.maximum(np.minimum(np.ceil(y.max(1)), grid.height).astype(np.int64) - first, 0)
    triangle, row = _runs(first, rows)
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        ya, yb, xa, xb = y[triangle, a], y[triangle, b], x[triangle, a], x[triangle, b]
        crossed = np.flatnonzero((ya <= row) != (yb <= row))
        ya, yb, xa, xb = ya[crossed], yb[crossed], xa[crossed], xb[crossed]
        at = xa + (row[crossed] - ya) / (yb - ya) * (xb - xa)
        left[crossed], right[crossed] = np.minimum(left[crossed], at), np.maximum(right[crossed], at)
    hit = np.isfinite(left)
    triangle, row, left, right = triangle[hit], row[hit], left[hit], right[hit]
    begin = np.clip(np.ceil(left), 0, grid.width).astype(np.int64)
    end = np.clip(np.ceil(right), 0, grid.width).astype(np.int64)
    span, column = _runs(begin, end - begin)
    owner = np.full(grid.height * grid.width, -1, np.int64)
    owner[row[span] * grid.width + column] = triangle[span]
    return owner


def _runs(first: NDArray[np.int64], length: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All members of runs first, first + 1, ...: the run's number and the member, (sum of lengths,) each."""
    run = np.repeat(np.arange(len(first)), length)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(length) - length, length) + first[run]


def _around(grid: Grid, xy: Array, wanted: Mask) -> Mask:
    """Which triangles (T, 3, 2), map metres, may lie over a wanted cell."""
    x, y = _in_cells(grid, xy)
    first, last = (
        (np.clip(np.ceil(at.min(1)), 0, size), np.clip(np.floor(at.max(1)) + 1, 0, size))
        for at, size in ((x, grid.width), (y, grid.height))
    )
    (left, right), (top, bottom) = (tuple(edge.astype(int) for edge in edges) for edges in (first, last))
    total = cv2.integral(wanted.astype(np.uint8))
    count = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
    return (right > left) & (bottom > top) & (count > 0)


def _reach(grid: Grid, cells: Cells, wanted: Mask, max_distance_m: float) -> _Reach:
    """Triangles over the wanted cells, none of which may lie deep in densely sounded ground."""
    corners, xy = _triangles(grid, cells, max_distance_m)
    near = _around(grid, xy, wanted)
    corners, xy = corners[near], xy[near]
    owner = _rasterise(grid, xy)
    owner[~wanted.ravel()] = -1
    cell = np.flatnonzero(owner >= 0)
    owner = owner[cell]
    X, Y = cell_centres(grid)
    centre = np.column_stack([X.ravel()[cell], Y.ravel()[cell]])
    # differences to the centre first: the same bits in every tile
    (ax, ay), (bx, by), (cx, cy) = ((xy[owner, k] - centre).T for k in range(3))
    weights = np.column_stack([bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx])
    distance = np.sqrt(np.minimum(np.minimum(ax**2 + ay**2, bx**2 + by**2), cx**2 + cy**2))
    return _Reach(cell, corners[owner], weights / weights.sum(1, keepdims=True), distance)


def _interpolated(cells: Cells, reach: _Reach) -> tuple[Array, Array, Array]:
    """Elevation, its sigma as the corners' own errors make it, and the spread of the corners' elevations, (K,)."""
    z, sigma = cells.elevation.ravel()[reach.corners], cells.sigma.ravel()[reach.corners]
    w = np.clip(reach.weights, 0, 1)
    elevation = (reach.weights * z).sum(1)
    spread = np.sqrt((w * (z - elevation[:, None]) ** 2).sum(1))
    # soundings of one image share the error of its pose, so errors add up and do not average
    return elevation, (w * sigma).sum(1), spread


def _inside(grid: Grid, part: Grid | None) -> Mask:
    """Cells of a grid that are in a part of it; all where no part is given."""
    inside = np.full(grid.shape, part is None)
    if part is not None:
        inside[window(grid, part)] = True
    return inside


def delaunay_surface(
    grid: Grid, cells: Cells, max_distance_m: float, growth: Growth, counted: Grid | None = None
) -> Surface:
    """Elevation at the centre of each cell, sounded or not, from the triangles of the soundings (paper IV).

    Parameters
    ----------
    grid : the tile with a halo of `halo_cells`; take the halo off the result.
    cells : soundings on that grid, by `gridding.grid_soundings`.
    max_distance_m : radius of the largest empty circle that is bridged, m; no cell farther than this from a
        sounding is filled.
    growth : the mission's, by `fit_growth`.
    counted : the part of the grid whose cells count; the others are left as they came.
    """
    sounded, dense, inside = cells.density > 0, _dense(cells, _RIM_CELLS), _inside(grid, counted)
    elevation, sigma, source = cells.elevation.copy(), cells.sigma.copy(), cells.source.copy()
    reach = _reach(grid, cells, ~dense & inside, max_distance_m)
    z, own, spread = _interpolated(cells, reach)
    grown = growth_sigma(growth, reach.distance, spread)
    elevation.ravel()[reach.cell], sigma.ravel()[reach.cell] = z, np.hypot(own, grown)
    source.ravel()[reach.cell] = np.where(sounded.ravel()[reach.cell], source.ravel()[reach.cell], INTERPOLATED)
    _to_centres(grid, cells, dense & inside, elevation)
    return Surface(elevation, sigma, source)


class Guesses(NamedTuple):
    """What the sigma of cells comes from, (height, width) each; NaN where nothing reaches.

    Attributes
    ----------
    own_m : sigma of the corners; of sounded cells their own.
    distance_m, spread_m : what `growth_sigma` wants; 0 where sounded.
    """

    own_m: Array
    distance_m: Array
    spread_m: Array


def guesses(grid: Grid, cells: Cells, max_distance_m: float, counted: Grid | None = None) -> Guesses:
    """What `delaunay_surface` interpolates from, before it is known how interpolation errs."""
    empty = cells.density == 0
    reach = _reach(grid, cells, empty & _inside(grid, counted), max_distance_m)
    _, own, spread = _interpolated(cells, reach)
    found = Guesses(*(np.where(empty, np.nan, at) for at in (cells.sigma, 0.0, 0.0)))
    for layer, values in zip(found, (own, reach.distance, spread), strict=True):
        layer.ravel()[reach.cell] = values
    return found


def without_guesses(surface: Surface, max_sigma_m: float) -> Surface:
    """The surface without interpolated cells whose sigma is larger: a guess is no map."""
    guess = (surface.source == INTERPOLATED) & (surface.sigma > max_sigma_m)
    elevation, sigma = (np.where(guess, np.nan, layer) for layer in (surface.elevation, surface.sigma))
    return Surface(elevation, sigma, np.where(guess, 0, surface.source).astype(np.uint8))


def seen(grid: Grid, outlines: Array) -> Mask:
    """Which cells (height, width) lie within an image's outline, (K, M, 2) map metres."""
    x, y = _in_cells(grid, outlines)
    covered = np.zeros(grid.shape, np.uint8)
    for points in np.round(np.stack([x, y], -1)).astype(np.int32):
        cv2.fillConvexPoly(covered, cv2.convexHull(points), 1)
    return covered > 0


def worst_shown(sigma: Array, least_share: float, max_sigma_m: float) -> float:
    """The sigma up to which interpolated cells are worth showing, m: that of which so many cells are no worse.

    Parameters
    ----------
    sigma : (N,) of all cells that were seen, sounded ones too; NaN where nothing reaches.
    least_share : of them; 1 for all that max_sigma_m lets pass.
    max_sigma_m : more is never shown.
    """
    if not len(sigma) or least_share >= 1:
        return max_sigma_m
    worst = np.quantile(np.where(np.isfinite(sigma), sigma, np.inf), least_share, method="higher")
    return float(min(worst, max_sigma_m))


def growth_sigma(growth: Growth, distance_m: Array, spread_m: Array) -> Array:
    """Sigma (N,) of interpolation, m, at a distance from the nearest sounding and with a spread of the corners."""
    return np.hypot(growth.scale_m * distance_m**growth.exponent, growth.relief * spread_m)


def _to_centres(grid: Grid, cells: Cells, dense: Mask, elevation: Array) -> None:
    """Carries the mean of densely sounded cells to their centres along the plane through 3 x 3 cells, in place.

    Within what those nine span, so that an edge stays as steep as it is.
    """
    row, column = np.nonzero(dense)
    if not len(row):
        return
    around = [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    X, Y = cell_centres(grid)
    x = np.stack([cells.x[at] - X[row, column] for at in around])
    y = np.stack([cells.y[at] - Y[row, column] for at in around])
    z = np.stack([cells.elevation[at] for at in around])
    dx, dy, dz = x - x.mean(0), y - y.mean(0), z - z.mean(0)
    xx, xy, yy, xz, yz = ((a * b).sum(0) for a, b in ((dx, dx), (dx, dy), (dy, dy), (dx, dz), (dy, dz)))
    determinant = xx * yy - xy**2
    slope_x, slope_y = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    moved = z[4] - slope_x * x[4] - slope_y * y[4]
    elevation[row, column] = np.clip(moved, z.min(0), z.max(0))


class Holdout(NamedTuple):
    """Soundings that were left out, compared with the surface without them; (N,) each.

    Attributes
    ----------
    error_m : difference of elevation, m, without sign.
    distance_m : to the nearest sounding left, m.
    spread_m : weighted standard deviation of the corners' elevations, m.
    """

    error_m: Array
    distance_m: Array
    spread_m: Array


def hold_out(grid: Grid, cells: Cells, max_distance_m: float, counted: Grid | None = None) -> Holdout:
    """What interpolation does to soundings that it does not know: squares of them are left out, an eighth at a
    time, with sides of 1/16, 1/8, 1/4 and 1/2 of the largest distance. Feed `fit_growth` with those of some tiles.

    counted : the part of the grid whose cells count, so that tiles give what the whole map would.
    """
    inside = _inside(grid, counted)
    row, column = np.mgrid[grid.top : grid.top - grid.height : -1, grid.left : grid.left + grid.width]
    found = []
    for k, share in enumerate((16, 8, 4, 2)):
        side = max(1, round(max_distance_m / share / grid.cell_m))
        out = ((column // side) * 3 + (row // side) * 5 + k) % 8 == 0
        out &= cells.density > 0
        rest = cells._replace(density=np.where(out, np.int32(0), cells.density))
        reach = _reach(grid, rest, out & inside, max_distance_m)
        z, _, spread = _interpolated(rest, reach)
        found.append((np.abs(z - cells.elevation.ravel()[reach.cell]), reach.distance, spread))
    return Holdout(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def fit_growth(holdout: Holdout) -> Growth:
    """The growth under which 68 % of the errors are within one sigma, at every distance and relief.

    Quantile regression (Koenker & Bassett 1978) of the error's size on `growth_sigma`. Where boulders make a longer
    tail than a normal distribution has, sigma is widened halfway, on a scale of ratios, to what would hold 95 % within
    two. With fewer than 30 errors the default stands.
    """
    if len(holdout.error_m) < _MIN_ERRORS:
        return Growth()
    every = max(1, len(holdout.error_m) // _FIT_ERRORS)
    error, distance, spread = (values[::every] for values in holdout)
    distance = np.maximum(distance, 1e-6)

    def growth(p: Array) -> Growth:
        return Growth(float(np.exp(p[0])), float(1 / (1 + np.exp(-p[1]))), float(np.exp(p[2])))

    def loss(p: Array) -> float:
        excess = error - growth_sigma(growth(p), distance, spread)
        return float(np.mean(np.maximum(_ONE_SIGMA * excess, (_ONE_SIGMA - 1) * excess)))

    start = np.array([math.log(max(float(np.median(error)), 1e-6)), 0.4, math.log(0.3)])
    best = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-9, "maxiter": 600})
    found = growth(best.x)
    tail = float(np.quantile(error / growth_sigma(found, distance, spread), _TWO_SIGMA)) / 2
    wider = math.sqrt(max(tail, 1.0))
    return Growth(wider * found.scale_m, found.exponent, wider * found.relief)
