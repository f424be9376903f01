"""What hides a face from a camera: walls of known height, on the tile's mesh and around it."""

import numpy as np
import pytest
from seamosaic.tasks import occlusion
from seamosaic.tasks.frames import LocalAffine
from seamosaic.tasks.grids import Grid, axes, cell_centres
from seamosaic.tasks.terrain import Terrain

CELL = 0.05
FAR = 20_000_000  # cells: a map's coordinates are those of UTM, a million metres
WALL_M, BEHIND_M = 1.0, 0.8


def _grid(margin=0):
    return Grid(CELL, FAR - margin, 4 * FAR + margin, 60 + 2 * margin, 60 + 2 * margin)


def _mesh(z, grid):
    x, y = cell_centres(grid)
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (number[i : i - 1 or None, j : j - 1 or None].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]), np.concatenate(
        [np.column_stack([a, c, b]), np.column_stack([b, c, d])]
    )


def _wall(own, around, column):
    """Level ground with a ridge a node wide, WALL_M high, at a column of own; and the scene of it."""
    z = np.zeros(around.shape)
    z[:, own.left - around.left + column] = WALL_M
    inner = z[around.top - own.top :, own.left - around.left :][: own.height, : own.width]
    X, triangles = _mesh(inner, own)
    terrain = Terrain(z, around, LocalAffine(np.eye(3), np.zeros(3)))
    return occlusion.scene(X, triangles, terrain, own)


@pytest.mark.parametrize(("column", "place"), [(20, 36), (-4, 12)], ids=["on the tile", "next to it"])
def test_a_wall_hides_what_lies_in_its_shadow(column, place):
    own = _grid()
    found = _wall(own, _grid(10), column)
    x, y = axes(own)
    top, behind = x[0] + CELL * column, CELL * (place - column)
    assert behind == pytest.approx(BEHIND_M)
    at = np.array([x[place], y[30] - 0.3 * CELL, 0.0])
    # a camera 3 m west of the ridge sees past it from where the line through the ridge's top comes out
    start = occlusion.OFF_SURFACE * CELL
    height = start + (WALL_M - start) * (behind + 3) / behind
    C = at + np.column_stack(
        [np.full(7, top - 3 - at[0]), np.zeros(7), height + np.array([-3, -1, -0.05, 0.05, 1, 3, 9])]
    )
    points, normals = np.tile(at, (7, 1)), np.tile([0.0, 0.0, 2.0], (7, 1))
    hidden = occlusion.hidden(found, points, normals, C, CELL)
    assert hidden.tolist() == [True] * 3 + [False] * 4
    # what is beyond the camera hides nothing
    near = at + [[0.5 * (top - at[0]), 0.0, 0.2]]
    assert not occlusion.hidden(found, at[None], normals[:1], near, CELL).any()


def test_rough_ground_is_seen_from_above_and_not_from_below():
    rng = np.random.default_rng(0)
    own, around = _grid(), _grid(10)
    z = rng.normal(0, 0.4 * CELL, around.shape)
    z[rng.random(z.shape) < 0.02] = np.nan
    inner = z[10:-10, 10:-10]
    X, triangles = _mesh(inner, own)
    triangles = triangles[np.isfinite(X[triangles, 2]).all(1)]
    used, number = np.unique(triangles, return_inverse=True)
    X, triangles = X[used], number.reshape(-1, 3)
    corners = X[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    scene = occlusion.scene(X, triangles, Terrain(z, around, LocalAffine(np.eye(3), np.zeros(3))), own)
    above = corners.mean(1) + [0, 0, 2.5]
    assert not occlusion.hidden(scene, corners.mean(1), normals, above, CELL).any()
    # from below everything is behind something
    below = corners.mean(1) - [0, 0, 2.5]
    assert occlusion.hidden(scene, corners.mean(1), normals, below, CELL).all()
