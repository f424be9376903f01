"""Triangle meshes of square tiles of bathymetry, finer where the ground is less even, at several levels of detail.

A tile has SIDE + 1 nodes a side; at level 0 they are the centres of cells, at level n every 2^n-th of them, counted
from the map's origin. Neighbouring tiles have the nodes of their common edge in common, and all of these are vertices
of both, so tiles of a level fit on each other without cracks. Within a tile triangles are right and isosceles, halved
where the ground departs from them (right-triangulated irregular network, Evans, Kirkpatrick & Townsend 2001).
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .grids import Grid

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Nodes = NDArray[np.int32]

SIDE: Final = 256  # steps between nodes along a tile's side


class Surface(NamedTuple):
    """Triangles of a tile, anticlockwise seen from above.

    Attributes
    ----------
    nodes : (V, 2) column and row of each vertex in the tile.
    z : (V,) m.
    triangles : (T, 3) vertices.
    error_m : most that a node with data is away from the triangles.
    """

    nodes: Nodes
    z: Array32
    triangles: Nodes
    error_m: float


def leaf_grid(column: int, row: int, cell_m: float) -> Grid:
    """The grid whose cells' centres are the nodes of a tile of level 0; rows of tiles count to the SOUTH."""
    return Grid(cell_m, column * SIDE, -row * SIDE, SIDE + 1, SIDE + 1)


def simplified(z: Array, tolerance_m: float) -> Surface:
    """Triangles of heights (SIDE + 1, SIDE + 1), row 0 north, NaN for none: cut where there is no data.

    Where triangles are halved no further, the ground is within about the tolerance of them; along the tile's rim and
    around cells without data they are as small as they can be.
    """
    departs = _departures(z)
    corners = _halved(departs > tolerance_m)
    known = np.isfinite(z)
    corners = corners[known[corners[..., 1], corners[..., 0]].all(1)]
    flat, triangles = np.unique(corners[..., 1] * (SIDE + 1) + corners[..., 0], return_inverse=True)
    nodes = np.column_stack([flat % (SIDE + 1), flat // (SIDE + 1)]).astype(np.int32)
    off = np.abs(_as_meshed(z, departs > tolerance_m) - z)
    error = float(np.nanmax(off)) if np.isfinite(off).any() else 0.0
    return Surface(nodes, z.ravel()[flat].astype(np.float32), triangles.reshape(-1, 3).astype(np.int32), error)


def _midpoints(step: int) -> list[tuple[Any, Any, Any]]:
    """Where triangles of a size are halved: slices of the midpoints of their long sides, and of these sides' ends.

    First long sides along rows and columns, 2 * step long, then diagonals of squares of 2 * step, every other one the
    other way.
    """
    odd, even, ends = slice(step, None, 2 * step), slice(None, None, 2 * step), slice(2 * step, None, 2 * step)
    starts = slice(None, -1, 2 * step)
    return [
        ((even, odd), (even, starts), (even, ends)),
        ((odd, even), (starts, even), (ends, even)),
        ((odd, odd), (starts, starts), (ends, ends)),
        ((odd, odd), (starts, ends), (ends, starts)),
    ]


def _other_way(count: int) -> Mask:
    """Of the squares (count, count) of a size, those whose diagonal runs from north-east to south-west."""
    return (np.arange(count)[:, None] + np.arange(count)) % 2 == 1


def _departures(z: Array) -> Array:
    """How far the ground departs at each node from the long side that it is the middle of, or at those below it."""
    found = np.zeros(z.shape)
    step = 1
    while step < SIDE:
        across, down, falling, rising = _midpoints(step)
        for middle, start, end in (across, down):
            found[middle] = np.maximum(_departure(z, middle, start, end), _below(found, middle, step))
        # tiles meet at their rims, where nothing is left out
        for rim in (found[0], found[-1], found[:, 0], found[:, -1]):
            rim[step :: 2 * step] = np.inf
        own = np.where(_other_way(SIDE // (2 * step)), _departure(z, *rising), _departure(z, *falling))
        (rows, columns), _, _ = falling
        sides = [found[rows, slice(k, None, 2 * step)][:, : own.shape[1]] for k in (0, 2 * step)]
        sides += [found[slice(k, None, 2 * step), columns][: own.shape[0]] for k in (0, 2 * step)]
        found[rows, columns] = np.maximum.reduce([own, *sides])
        step *= 2
    return found


def _departure(z: Array, middle: Any, start: Any, end: Any) -> Array:
    """How far midpoints are from the mean of the ends; infinite where only some of the three have data."""
    known = np.isfinite(z)
    count = known[middle].astype(int) + known[start] + known[end]
    return np.where(count == 3, np.abs(z[middle] - (z[start] + z[end]) / 2), np.where(count == 0, 0.0, np.inf))


def _below(found: Array, middle: Any, step: int) -> Array | float:
    """The largest departure in the middles of the four squares around midpoints along rows or columns."""
    half = step // 2
    if not half:
        return 0.0
    wide = np.pad(found, half)
    rows, columns = np.arange(len(found))[middle[0]], np.arange(len(found))[middle[1]]
    around = [wide[np.ix_(rows + i, columns + j)] for i in (0, 2 * half) for j in (0, 2 * half)]
    return np.maximum.reduce(around)


def _halved(split: Mask) -> NDArray[np.int64]:
    """Corners (T, 3, 2) as column and row of the triangles that are left when those with split midpoints are halved."""
    far = SIDE
    waiting = np.array([[[0, 0], [far, far], [far, 0]], [[far, far], [0, 0], [0, far]]])
    done = []
    while len(waiting):
        a, b, c = waiting.transpose(1, 0, 2)
        middle = (a + b) // 2
        halve = (np.abs(a - c).sum(1) > 1) & split[middle[:, 1], middle[:, 0]]
        done.append(waiting[~halve])
        a, b, c, middle = a[halve], b[halve], c[halve], middle[halve]
        waiting = np.concatenate([np.stack([c, a, middle], 1), np.stack([b, c, middle], 1)])
    corners = np.concatenate(done)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    clockwise = first[:, 0] * -second[:, 1] + first[:, 1] * second[:, 0] < 0  # rows count southwards
    corners[clockwise] = corners[clockwise][:, [0, 2, 1]]
    return corners


def _as_meshed(z: Array, split: Mask) -> Array:
    """Heights of the mesh at all nodes."""
    found, step = z.copy(), SIDE // 2
    while step:
        across, down, falling, rising = _midpoints(step)
        (middle, *_), other = falling, _other_way(SIDE // (2 * step))
        mean = np.where(other, _mean(found, rising), _mean(found, falling))
        found[middle] = np.where(split[middle], z[middle], mean)
        for side in (across, down):
            found[side[0]] = np.where(split[side[0]], z[side[0]], _mean(found, side))
        step //= 2
    return found


def _mean(z: Array, side: tuple[Any, Any, Any]) -> Array:
    return (z[side[1]] + z[side[2]]) / 2


def halved_resolution(quarters: dict[tuple[int, int], Array]) -> Array:
    """Heights (SIDE + 1, SIDE + 1) of a tile from those of the four of the level below, by (right, down) of 0 and 1."""
    whole = np.full((2 * SIDE + 1, 2 * SIDE + 1), np.nan)
    for (right, down), z in quarters.items():
        part = whole[down * SIDE : (down + 1) * SIDE + 1, right * SIDE : (right + 1) * SIDE + 1]
        part[:] = np.where(np.isnan(part), z, part)
    return whole[::2, ::2]


def lost_detail(quarters: dict[tuple[int, int], Array], z: Array) -> float:
    """The most that nodes of the tiles below, by (right, down), are away from z of the tile above and between."""
    half, lost = SIDE // 2, 0.0
    for (right, down), fine in quarters.items():
        coarse = z[down * half : (down + 1) * half + 1, right * half : (right + 1) * half + 1]
        rows = np.repeat(coarse, 2, 0)[:-1].astype(float)
        rows[1::2] = (coarse[:-1] + coarse[1:]) / 2
        whole = np.repeat(rows, 2, 1)[:, :-1]
        whole[:, 1::2] = (rows[:, :-1] + rows[:, 1:]) / 2
        off = np.abs(whole - fine)
        lost = max(lost, float(np.nanmax(off)) if np.isfinite(off).any() else 0.0)
    return lost
