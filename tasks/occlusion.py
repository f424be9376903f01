"""What a mesh and the ground around it hide from cameras, by rays through triangles (Open3D's scene, Embree)."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .grids import Grid, axes, window
from .open3d_loader import load_open3d
from .terrain import Terrain

Array = NDArray[np.float64]
Faces = NDArray[np.integer]

OFF_SURFACE: Final = 0.25  # of a cell: the mesh departs from the ground by as much, and nothing lower hides a face


class Scene(NamedTuple):
    """Triangles to cast rays at.

    Attributes
    ----------
    triangles : an Open3D RaycastingScene, float32, from `origin`.
    origin : (3,) m, map coordinates, within the triangles: metres from it keep their tenths of millimetres.
    """

    triangles: Any
    origin: Array


def scene(X_map: Array, triangles: Faces, terrain: Terrain, own: Grid) -> Scene:
    """A tile's mesh, vertices X_map (V, 3), triangles (T, 3), and the terrain outside of the tile's nodes, own."""
    open3d = load_open3d()
    around, outside = _around(terrain, own)
    origin = np.round(X_map.mean(0))
    made = open3d.t.geometry.RaycastingScene(nthreads=1)  # as many tiles as cores are at work already
    for vertices, corners in ((X_map, triangles), (around, outside)):
        if len(corners):
            made.add_triangles(
                np.ascontiguousarray(vertices - origin, np.float32), np.ascontiguousarray(corners, np.uint32)
            )
    return Scene(made, origin)


def _around(terrain: Terrain, own: Grid) -> tuple[Array, Faces]:
    """The terrain's nodes with data (V, 3) and the triangles (T, 3) between them, two a square, that own leaves out."""
    height, width = terrain.grid.shape
    rows, columns = window(terrain.grid, own)
    wanted = np.ones((height - 1, width - 1), bool)
    wanted[rows.start : rows.stop - 1, columns.start : columns.stop - 1] = False
    known = np.isfinite(terrain.elevation)
    number = (np.cumsum(known) - 1).reshape(known.shape)
    at = {}
    for down in (0, 1):
        for right in (0, 1):
            part = slice(down, height - 1 + down), slice(right, width - 1 + right)
            at[down, right] = np.where(known[part], number[part], -1)[wanted]
    halves = [np.column_stack([at[0, 0], at[1, 0], at[0, 1]]), np.column_stack([at[0, 1], at[1, 0], at[1, 1]])]
    corners = np.concatenate(halves)
    x, y = np.meshgrid(*axes(terrain.grid))
    vertices = np.column_stack([x[known], y[known], terrain.elevation[known]])
    return vertices, corners[(corners >= 0).all(1)]


def hidden(scene: Scene, X_map: Array, normals: Array, C_map: Array, cell_m: float) -> NDArray[np.bool_]:
    """Which places (N, 3) on triangles with normals (N, 3), of any length, the scene hides from cameras (N, 3).

    cell_m : between nodes. Rays begin OFF_SURFACE of it above the triangles and end at the cameras.
    """
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    start = X_map + OFF_SURFACE * cell_m * unit
    rays = np.column_stack([start - scene.origin, C_map - start]).astype(np.float32)
    # directions are as long as the way, so cameras are at 1
    return scene.triangles.test_occlusions(load_open3d().core.Tensor(rays), tfar=1.0, nthreads=1).numpy()
