"""Layers that analysts derive from bathymetry: slope, aspect, curvature, position, ruggedness; NaN where there is none.

Elevations are (rows, columns) float64, metres, row 0 north, NaN for no data; a value needs all cells of its window (of
a ring, half), so a tile with a rim of `reach` cells has the values of the whole map, bit for bit.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

FLAT_DEG: Final = 0.05  # less slope has no aspect
_FIXED_POINT: Final = 2.0**24  # of a metre: holds all bits of a float32 that is not within half a metre of zero


class Ring(NamedTuple):
    """The cells whose centres are from inner to outer cells away."""

    inner_cells: int
    outer_cells: int


LAYERS: Final = (
    *("slope", "aspect", "profile-curvature", "plan-curvature", "bpi-fine", "bpi-broad"),
    *("vrm", "rugosity", "roughness", "tri", "tpi"),
)


def layers(z: Array, cell_m: float, fine: Ring, broad: Ring) -> dict[str, Array]:
    """All of LAYERS of elevations, float32; the position indices `bpi-fine` and `bpi-broad` by these rings."""
    found = (
        slope_deg(z, cell_m),
        aspect_deg(z, cell_m),
        *curvatures(z, cell_m),
        benthic_position(z, fine),
        benthic_position(z, broad),
        vector_ruggedness(z, cell_m),
        surface_rugosity(z, cell_m),
        roughness(z),
        ruggedness(z),
        position(z),
    )
    return {name: values.astype(np.float32) for name, values in zip(LAYERS, found, strict=True)}


def _around(z: Array) -> list[Array]:
    """The eight neighbours (rows, columns) of each cell, from the north-west row by row; NaN beyond the rim."""
    wide = np.pad(z, 1, constant_values=np.nan)
    rows, columns = z.shape
    steps = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return [wide[i : i + rows, j : j + columns] for i, j in steps]


def gradient(z: Array, cell_m: float) -> tuple[Array, Array]:
    """Rise towards east and towards north, metres a metre, by eight neighbours (Horn 1981, as gdaldem)."""
    nw, n, ne, w, e, sw, s, se = _around(z)
    known = np.where(np.isfinite(z), 0.0, np.nan)
    east = ((ne + 2 * e + se) - (nw + 2 * w + sw)) / (8 * cell_m) + known
    north = ((nw + 2 * n + ne) - (sw + 2 * s + se)) / (8 * cell_m) + known
    return east, north


def slope_deg(z: Array, cell_m: float) -> Array:
    """Steepest slope, degrees."""
    return np.degrees(np.arctan(np.hypot(*gradient(z, cell_m))))


def aspect_deg(z: Array, cell_m: float) -> Array:
    """Direction in which the ground falls, degrees clockwise from grid north; NaN where it is flat."""
    east, north = gradient(z, cell_m)
    facing = np.degrees(np.arctan2(-east, -north)) % 360
    return np.where(np.hypot(east, north) > np.tan(np.radians(FLAT_DEG)), facing, np.nan)


def curvatures(z: Array, cell_m: float) -> tuple[Array, Array]:
    """Profile and plan curvature, 1/m (Zevenbergen & Thorne 1987): along the slope and across it; 0 where level.

    Positive where convex: a profile that steepens downhill, a ridge from which flow diverges. These are SAGA's
    longitudinal and cross-sectional curvature of method 6; ArcGIS's profile curvature has the other sign.
    """
    nw, n, ne, w, e, sw, s, se = _around(z)
    D, E = ((w + e) / 2 - z) / cell_m**2, ((n + s) / 2 - z) / cell_m**2
    F = (-nw + ne + sw - se) / (4 * cell_m**2)
    G, H = (-w + e) / (2 * cell_m), (n - s) / (2 * cell_m)
    steep = G**2 + H**2
    level = steep < 1e-12
    with np.errstate(invalid="ignore", divide="ignore"):
        profile = -2 * (D * G**2 + E * H**2 + F * G * H) / steep
        plan = -2 * (D * H**2 + E * G**2 - F * G * H) / steep
    return np.where(level, 0.0, profile), np.where(level, 0.0, plan)


def roughness(z: Array) -> Array:
    """Largest less smallest elevation of 3 x 3 cells, m (Wilson et al. 2007, as gdaldem)."""
    window = np.stack([z, *_around(z)])
    return window.max(0) - window.min(0)


def ruggedness(z: Array) -> Array:
    """Terrain ruggedness index: mean size of the differences from the eight neighbours, m (Wilson et al. 2007)."""
    return np.sum([np.abs(other - z) for other in _around(z)], axis=0) / 8


def position(z: Array) -> Array:
    """Topographic position index: elevation above the mean of the eight neighbours, m (Wilson et al. 2007)."""
    return z - np.sum(_around(z), axis=0) / 8


def benthic_position(z: Array, ring: Ring) -> Array:
    """Bathymetric position index: elevation above the mean of a ring, m (Lundblad et al. 2006; SAGA's TPI).

    Cells without data do not count, and where half of the ring or more is missing there is no value.
    """
    inner, outer = ring
    known = np.isfinite(z)
    # whole numbers: their sums do not depend on where a tile begins
    heights = np.where(known, np.rint(np.nan_to_num(z) * _FIXED_POINT), 0).astype(np.int64)
    total, count = (_ring_sum(layer, ring) for layer in (heights, known.astype(np.int64)))
    away2 = np.arange(-outer, outer + 1)[:, None] ** 2 + np.arange(-outer, outer + 1) ** 2
    cells = ((away2 >= inner**2) & (away2 <= outer**2)).sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(2 * count > cells, z - total / count / _FIXED_POINT, np.nan)


def _ring_sum(values: NDArray[np.int64], ring: Ring) -> NDArray[np.int64]:
    """Sum of the whole numbers in the ring around each cell, from sums along its rows."""
    inner, outer = ring
    rows, columns = values.shape
    before = np.cumsum(np.pad(values, ((outer, outer), (outer + 1, outer))), axis=1)
    total = np.zeros(values.shape, np.int64)
    for down in range(-outer, outer + 1):
        line = before[down + outer : down + outer + rows]
        total += _along(line, columns, outer, math.isqrt(outer**2 - down**2))
        if abs(down) < inner:
            total -= _along(line, columns, outer, math.isqrt(inner**2 - down**2 - 1))
    return total


def _along(before: NDArray[np.int64], columns: int, outer: int, half: int) -> NDArray[np.int64]:
    """Sums (rows, columns) of the cells up to half away along their row; before: sums up to each cell, padded."""
    return before[:, outer + half + 1 : outer + half + 1 + columns] - before[:, outer - half : outer - half + columns]


def vector_ruggedness(z: Array, cell_m: float) -> Array:
    """Vector ruggedness measure of 3 x 3 cells: 0 for any plane, up to 1 (Sappington et al. 2007)."""
    east, north = gradient(z, cell_m)
    up = 1 / np.sqrt(1 + east**2 + north**2)
    sums = [part + np.sum(_around(part), axis=0) for part in (-east * up, -north * up, up)]
    return np.maximum(1 - np.sqrt(sums[0] ** 2 + sums[1] ** 2 + sums[2] ** 2) / 9, 0)


def surface_rugosity(z: Array, cell_m: float) -> Array:
    """Area of the surface over that of its map, of each cell, at least 1 (Jenness 2004: eight triangles)."""
    nw, n, ne, w, e, sw, s, se = _around(z)
    ring = [n, ne, e, se, s, sw, w, nw, n]
    area = np.zeros(z.shape)
    for k in range(8):
        # half as long as the sides between centres: the parts of the triangles within the cell
        a, b = ring[k] - z, ring[k + 1] - z
        step_a, step_b = ((1.0 if (k + turn) % 2 == 0 else np.sqrt(2.0)) * cell_m for turn in (0, 1))
        sides = np.hypot(a, step_a) / 2, np.hypot(b, step_b) / 2, np.hypot(a - b, cell_m) / 2
        half = (sides[0] + sides[1] + sides[2]) / 2
        area += np.sqrt(np.maximum(half * (half - sides[0]) * (half - sides[1]) * (half - sides[2]), 0))
    return area / cell_m**2


def reach(broad: Ring) -> int:
    """Rim of cells that a tile needs for all of these layers, of which the largest ring is that one."""
    return max(2, broad.outer_cells)
