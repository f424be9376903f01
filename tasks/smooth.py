"""Cells of image matching, each averaged with as many of its neighbours as lie on one plane with it.

Local planes over growing squares; the largest that says the same as all smaller ones, within what their noise allows,
counts (intersection of confidence intervals: Katkovnik 1999). The seabed departs from its planes by as much as cells
around do beyond their noise, so a cell is taken to lie between the plane and its own value, by what either is worth
(best linear unbiased prediction: universal kriging with a nugget, Cressie 1993). On even ground that takes the noise of
matching away; on rough ground and at edges cells stay as they are.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .gridding import MATCHING, Cells
from .grids import Grid, cell_centres

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

_RADII = (1, 2, 4)  # cells
_SPARSE = 2  # beyond this radius every second cell each way says enough
_NOISE_M = 1e-3  # of weight one, so that single precision does
_INTERVAL = 2.0  # sigmas
_LEAST_CELLS = 6
_TOGETHER = 32_768  # cells, whose sums stay in the processor's cache
_SPIKE_CELLS = 5  # neighbours that can tell a cell that it stands out
_CHANCE = 3.0  # sigmas of chi squared over its freedom: more is no plane
_ROUGH_RADIUS = 5  # cells, of the square whose planes tell how rough the ground is
_EVEN = 1.16  # chi squared over its freedom of all of them, a sigma above what even ground has
_MOST_MISFIT = 9.0  # of one plane's chi squared over its freedom that counts: more is an edge
_WHOLE = 1e-12  # m2; sums of whole numbers are the same in whatever order
REACH = _RADII[-1] + _ROUGH_RADIUS + _RADII[0] + 1  # cells, of what a cell depends on; the last one is of spikes


class _Moments(NamedTuple):
    """Weighted sums over a square around each cell: of 1, x, y, xx, xy, yy, z, xz, yz, zz; cells and metres."""

    one: Array
    x: Array
    y: Array
    xx: Array
    xy: Array
    yy: Array
    z: Array
    xz: Array
    yz: Array
    zz: Array


class _Around(NamedTuple):
    """All cells with a rim of unknown ones, flat, in rows of `width`: x, y from their centres, cells; weights; z;
    variances of their noise, and of how far the ground departs from its planes, in units of _NOISE_M squared."""

    width: int
    x: Array
    y: Array
    weight: Array
    z: Array
    noise: Array
    rough: Array


class _Plane(NamedTuple):
    """Of some cells (n,) the planes around them: height and its variance at the cell's centre over the cell's own
    value, m; slopes in metres a cell; chi squared over its freedom."""

    height: Array
    variance: Array
    slope_x: Array
    slope_y: Array
    misfit: Array


class _Found(NamedTuple):
    """Of some cells (n,): elevation and noise at their centres, whether it is there, by what the ground is uneven."""

    elevation: Array
    noise: Array
    at_centre: Mask
    uneven: Array


def matched(grid: Grid, cells: Cells, window_m: float = 0.0, noise_scale: float = 1.0) -> Cells:
    """Cells with matched ones smoothed and carried to their centres; those of the laser as they are.

    A cell depends on those within `REACH` cells of it and on nothing else. Cells in one window of matching, window_m
    wide, share its noise: as many of them as it has are averaged as if they were one.

    noise_scale : what matched cells err by, their noise so found being 1 (`matching_noise`).
    """
    wanted = np.flatnonzero(cells.source == MATCHING)
    if not len(wanted):
        return cells
    X, Y = cell_centres(grid)
    x, y = (cells.x - X) / grid.cell_m, (cells.y - Y) / grid.cell_m
    z = np.where(cells.source == MATCHING, _without_spikes(cells.elevation), cells.elevation)
    variance = np.where(cells.density > 0, (np.maximum(cells.noise, 1e-5) / _NOISE_M) ** 2, np.inf)
    rim = _RADII[-1]
    u, v = (np.pad(np.nan_to_num(values), rim).ravel().astype(np.float32) for values in (x, y))
    heights = np.pad(np.nan_to_num(z), rim).ravel()
    variance = np.pad(variance, rim, constant_values=np.inf).ravel().astype(np.float32)
    width = grid.width + 2 * rim
    around = _Around(width, u, v, 1 / variance, heights, variance, np.zeros_like(variance))
    here = (wanted // grid.width + rim) * width + wanted % grid.width + rim
    rough = np.pad(_roughness(grid, around, wanted, here), rim).ravel().astype(np.float32)
    around = around._replace(weight=1 / (variance + rough), rough=rough)
    alike = max(1.0, window_m / grid.cell_m) ** 2
    parts = [_smoothed(around, here[k : k + _TOGETHER], alike) for k in range(0, len(here), _TOGETHER)]
    found = _Found(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    elevation, sigma, noise, x, y = (
        values.copy() for values in (cells.elevation, cells.sigma, cells.noise, cells.x, cells.y)
    )
    at, own = wanted[found.at_centre], cells.noise.ravel()[wanted]
    elevation.ravel()[wanted] = found.elevation
    # what neighbours differ by, beyond what noise makes them, no plane explains: edges, flanks, wrong matches
    noise.ravel()[wanted] = noise_scale * np.where(found.at_centre, found.noise, own) * found.uneven
    shared = np.maximum(cells.sigma.ravel()[wanted] ** 2 - own**2, 0)
    sigma.ravel()[wanted] = np.sqrt(shared + noise.ravel()[wanted] ** 2)
    x.ravel()[at], y.ravel()[at] = X.ravel()[at], Y.ravel()[at]
    return cells._replace(elevation=elevation, sigma=sigma, noise=noise, x=x, y=y)


def _roughness(grid: Grid, around: _Around, wanted: NDArray[np.int64], here: NDArray[np.int64]) -> Array:
    """Variance (height, width) of how far the ground departs from the planes through nine cells.

    What is left of the planes around each matched cell beyond their noise, all together; units of `_Around`. Where
    cells differ in their noise it is a little too low: the better ones hold the plane.
    """
    excess, freedom = np.zeros(grid.shape), np.zeros(grid.shape)
    for k in range(0, len(here), _TOGETHER):
        some, cell = here[k : k + _TOGETHER], wanted[k : k + _TOGETHER]
        sums, count = _nothing(len(some))
        _add_ring(sums, count, (0, _RADII[0]), around, some)
        plane = _plane(sums, count)
        told = (count >= _LEAST_CELLS) & (plane.variance > 0) & np.isfinite(plane.misfit)
        free, misfit = np.where(told, count - 3, 0), np.clip(np.where(told, plane.misfit, 0), 0, _MOST_MISFIT)
        more = (misfit - _EVEN) * free * count / np.maximum(sums.one, 1e-9)
        excess.ravel()[cell], freedom.ravel()[cell] = np.round(more * (_NOISE_M**2 / _WHOLE)), free
    size = (2 * _ROUGH_RADIUS + 1,) * 2
    total, free = (
        cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for values in (excess, freedom)
    )
    return np.maximum(total, 0) / np.maximum(free, 1) * (_WHOLE / _NOISE_M**2)


def _nothing(count: int) -> tuple[_Moments, Array]:
    return _Moments(*(np.zeros(count, np.float32) for _ in _Moments._fields)), np.zeros(count, np.float32)


def _smoothed(around: _Around, here: NDArray[np.int64], alike: float) -> _Found:
    """The cells at some places among all, each by the largest plane that says the same as all smaller ones.

    alike : how many cells err as one.
    """
    x, y, z, own, rough = (
        values[here].astype(float) for values in (around.x, around.y, around.z, around.noise, around.rough)
    )
    kept = rough / (rough + own)  # how much of a cell's departure from its plane is the seabed's
    found, noise, uneven = z.copy(), np.zeros(len(here)), np.ones(len(here))
    low, high = np.full(len(here), -np.inf), np.full(len(here), np.inf)
    going, at_centre, last = np.ones(len(here), bool), np.zeros(len(here), bool), 0
    sums, count = _nothing(len(here))
    for radius in _RADII:
        _add_ring(sums, count, (last, radius), around, here)
        last = radius
        plane = _plane(sums, count)
        misfit, most = plane.misfit, _most(count)
        if radius == _RADII[0]:
            uneven = np.sqrt(np.where((count >= _LEAST_CELLS) & (misfit > most), misfit, 1))
        enough = going & (count >= _LEAST_CELLS) & np.isfinite(plane.height) & (plane.variance > 0)
        height, variance, slope_x, slope_y = (np.where(enough, values, 0) for values in plane[:4])
        spread = _INTERVAL * np.sqrt(variance)
        low, high = (
            np.where(enough, np.maximum(low, height - spread), low),
            np.where(enough, np.minimum(high, height + spread), high),
        )
        even = (misfit < most) & (low <= high) & (height >= low) & (height <= high)
        better = enough & even
        # the plane at the centre, and what the cell departs from it where it lies
        value = z + height - kept * (height + slope_x * x + slope_y * y)
        mean = np.minimum(alike * variance, own * _NOISE_M**2)
        error = kept * own * _NOISE_M**2 + (1 - kept) ** 2 * np.maximum(mean, variance)
        found[better], noise[better] = value[better], np.sqrt(error[better])
        at_centre |= better
        going &= better | ~enough
    return _Found(found, noise, at_centre, uneven)


def _most(count: Array) -> Array:
    """Chi squared over its freedom that so many cells on a plane have by chance at most."""
    return 1 + _CHANCE * np.sqrt(2 / np.maximum(count - 3, 1))


def _without_spikes(z: Array) -> Array:
    """Elevations held within those of the eight cells around, where most of them are known."""
    padded = np.pad(z, 1, constant_values=np.nan)
    low, high, count = np.full(z.shape, np.inf), np.full(z.shape, -np.inf), np.zeros(z.shape, int)
    for i in (0, 1, 2):
        for j in (0, 1, 2):
            if (i, j) != (1, 1):
                other = padded[i : i + z.shape[0], j : j + z.shape[1]]
                low, high, count = np.fmin(low, other), np.fmax(high, other), count + np.isfinite(other)
    return np.where(count >= _SPIKE_CELLS, np.clip(z, low, high), z)


def _add_ring(sums: _Moments, count: Array, radii: tuple[int, int], around: _Around, here: NDArray[np.int64]) -> None:
    """Adds the cells between two squares to the sums, in place; with the smaller of radius 0 also the cell itself."""
    inner, outer = radii
    every = _SPARSE if outer > _SPARSE else 1
    for i in range(-outer, outer + 1, every):
        for j in range(-outer, outer + 1, every):
            if inner and max(abs(i), abs(j)) <= inner:
                continue
            there = here + i * around.width + j
            # rows go south
            w, dx, dy = around.weight[there], around.x[there] + j, around.y[there] - i
            dz = (around.z[there] - around.z[here]).astype(np.float32)
            wx, wy, wz = w * dx, w * dy, w * dz
            terms = (w, wx, wy, wx * dx, wx * dy, wy * dy, wz, wx * dz, wy * dz, wz * dz)
            for total, term in zip(sums, terms, strict=True):
                total += term
            count += w > 0


def _plane(m: _Moments, count: Array) -> _Plane:
    a, b, c = m.xx * m.yy - m.xy**2, m.xy * m.y - m.x * m.yy, m.x * m.xy - m.xx * m.y
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = m.one * a + m.x * b + m.y * c
        height = (a * m.z + b * m.xz + c * m.yz) / determinant
        slope_x = (b * m.z + (m.one * m.yy - m.y**2) * m.xz + (m.x * m.y - m.one * m.xy) * m.yz) / determinant
        slope_y = (c * m.z + (m.x * m.y - m.one * m.xy) * m.xz + (m.one * m.xx - m.x**2) * m.yz) / determinant
        left = m.zz - height * m.z - slope_x * m.xz - slope_y * m.yz
        misfit = left / _NOISE_M**2 / np.maximum(count - 3, 1)
        return _Plane(height, _NOISE_M**2 * a / determinant, slope_x, slope_y, misfit)
