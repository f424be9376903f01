"""Triangle mesh of the bathymetry, simplified, with its place in the mosaic's texture."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .grids import Bounds, Grid, cell_centres
from .open3d_loader import load_open3d

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_RAW_PER_KEPT: Final = 4  # triangles that simplification may choose from
_RIM_WEIGHT: Final = 1.0


class Mesh(NamedTuple):
    """Triangles that face up.

    Attributes
    ----------
    vertices : (V, 3) m, map coordinates less the local origin.
    triangles : (T, 3) int32 vertices, anticlockwise seen from above.
    uv : (V, 2) place in the texture, u from its west edge and v from its SOUTH edge, 0 to 1.
    """

    vertices: Array
    triangles: NDArray[np.int32]
    uv: Array


def surface_mesh(
    elevation: NDArray[np.floating], grid: Grid, origin_map: Array, texture: Bounds, max_triangles: int
) -> Mesh:
    """Mesh of a bathymetry, cut where there is no data.

    Parameters
    ----------
    elevation : (height, width) m, NaN for none.
    grid : its grid.
    origin_map : (3,) local origin in map coordinates, m.
    texture : edges of the mosaic that is the texture.
    max_triangles : quadric simplification (Garland & Heckbert 1997) ends at this many.

    Raises
    ------
    ValueError
        No three neighbouring cells have data.
    """
    elevation, grid = _thinned(elevation, grid, max_triangles)
    triangles = _cut_triangles(elevation)
    if not len(triangles):
        raise ValueError("the bathymetry has no three neighbouring cells with data: there is no surface to mesh")
    used, triangles = np.unique(triangles, return_inverse=True)
    X, Y = cell_centres(grid)
    vertices = np.column_stack([X.ravel()[used], Y.ravel()[used], elevation.ravel()[used]]) - origin_map
    triangles = triangles.reshape(-1, 3).astype(np.int32)
    if len(triangles) > max_triangles:
        vertices, triangles = _simplified(vertices, triangles, max_triangles)
    place = vertices[:, :2] + origin_map[:2]
    size = texture.east - texture.west, texture.north - texture.south
    return Mesh(vertices, triangles, (place - [texture.west, texture.south]) / size)


def _thinned(elevation: NDArray[np.floating], grid: Grid, max_triangles: int) -> tuple[Array, Grid]:
    """Means of squares of cells, so large that simplification has not much more than it needs."""
    side = int(np.ceil(np.sqrt(2 * np.isfinite(elevation).sum() / (_RAW_PER_KEPT * max_triangles))))
    if side <= 1:
        return elevation.astype(float), grid
    # squares are counted from the map's origin, as cells are
    left, top = grid.left // side, -(-grid.top // side)
    right, bottom = -(-(grid.left + grid.width) // side), (grid.top - grid.height) // side
    coarse = Grid(grid.cell_m * side, left, top, right - left, top - bottom)
    whole = np.full((coarse.height * side, coarse.width * side), np.nan)
    row, column = top * side - grid.top, grid.left - left * side
    whole[row : row + grid.height, column : column + grid.width] = elevation
    squares = whole.reshape(coarse.height, side, coarse.width, side)
    known = np.isfinite(squares).sum((1, 3))
    mean = np.nansum(squares, axis=(1, 3)) / np.maximum(known, 1)
    return np.where(2 * known >= side * side, mean, np.nan), coarse


def _cut_triangles(elevation: Array) -> Indices:
    """Two triangles between four neighbouring cells with data, one between three; (T, 3) flat cells.

    A square is cut along the diagonal with the smaller step, which follows edges of the ground.
    """
    flat = np.arange(elevation.size).reshape(elevation.shape)
    corners = np.stack([flat[:-1, :-1], flat[:-1, 1:], flat[1:, 1:], flat[1:, :-1]], -1).reshape(-1, 4)
    z = elevation.ravel()[corners]  # clockwise from the north-west
    missing = np.isnan(z)
    falling = np.abs(z[:, 0] - z[:, 2]) <= np.abs(z[:, 1] - z[:, 3])
    full, three = ~missing.any(1), missing.sum(1) == 1
    found = [
        corners[full & falling][:, order] if way else corners[full & ~falling][:, order]
        for way, order in ((True, [0, 3, 2]), (True, [0, 2, 1]), (False, [0, 3, 1]), (False, [1, 3, 2]))
    ]
    for lost in range(4):
        order = [(lost + 3) % 4, (lost + 2) % 4, (lost + 1) % 4]
        found.append(corners[three & missing[:, lost]][:, order])
    return np.concatenate(found)


def _simplified(vertices: Array, triangles: NDArray[np.int32], max_triangles: int) -> tuple[Array, NDArray[np.int32]]:
    open3d = load_open3d()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles)
    )
    mesh = mesh.simplify_quadric_decimation(max_triangles, boundary_weight=_RIM_WEIGHT)
    mesh.remove_degenerate_triangles()
    vertices, triangles = np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int32)
    upright = triangles[_area_above(vertices, triangles) > 0]
    used, renumbered = np.unique(upright, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3).astype(np.int32)


def _area_above(vertices: Array, triangles: NDArray[np.int32]) -> Array:
    """Area (T,) seen from above, m2; negative for a triangle that faces down."""
    a, b, c = (vertices[triangles[:, k], :2] for k in range(3))
    first, second = b - a, c - a
    return 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
