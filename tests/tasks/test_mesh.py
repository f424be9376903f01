"""Triangles of tiles: what they cover, how far they are off, and how tiles fit on each other."""

import numpy as np
import pytest
from seamosaic.tasks import grids, mesh

CELL, SIDE = 0.02, mesh.SIDE
HILL = np.array([2.0, -2.5])


def _height(x, y):
    return -20 + 0.3 * np.exp(-((x - HILL[0]) ** 2 + (y - HILL[1]) ** 2) / 0.2) + 0.1 * x


def _tile(column=0, row=0):
    return _height(*grids.cell_centres(mesh.leaf_grid(column, row, CELL)))


def _vertices(surface):
    return np.column_stack([surface.nodes * [CELL, -CELL], surface.z])


def _area_above(surface):
    a, b, c = (_vertices(surface)[surface.triangles[:, k], :2] for k in range(3))
    first, second = b - a, c - a
    return (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2


def _edges(surface):
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    return np.unique(edges, axis=0, return_counts=True)


@pytest.mark.parametrize("tolerance", [0.0, 0.002, 0.05])
def test_a_mesh_is_cut_where_there_is_no_data_and_whole_elsewhere(tolerance):
    z = _tile() + np.random.default_rng(0).normal(0, 0.001, (SIDE + 1, SIDE + 1))
    z[60:91, 100:161] = np.nan
    surface = mesh.simplified(z, tolerance)
    areas = _area_above(surface)
    assert (areas > 0).all()  # seen from above, none folded over
    # around a hole of n x m nodes (n + 1)(m + 1) squares go, but two of its four corners keep a triangle
    assert areas.sum() / CELL**2 == pytest.approx(SIDE**2 - (32 * 62) + 1, abs=1.1)
    edges, faces = _edges(surface)
    assert faces.max() == 2
    rim = surface.nodes[edges[faces == 1]]
    at_rim = ((rim == 0) | (rim == SIDE)).any(-1).all(1)
    around = (rim[..., 0] >= 99) & (rim[..., 0] <= 161) & (rim[..., 1] >= 59) & (rim[..., 1] <= 91)
    assert (at_rim | around.all(1)).all()  # no crack anywhere else
    assert 2 * SIDE < at_rim.sum() <= 4 * SIDE


def test_fewer_triangles_where_more_may_be_lost_and_the_loss_is_told():
    z = _tile() + np.random.default_rng(0).normal(0, 0.001, (SIDE + 1, SIDE + 1))
    full, some, few = (mesh.simplified(z, tolerance) for tolerance in (0.0, 0.003, 0.02))
    assert len(full.triangles) == 2 * SIDE**2
    assert full.error_m == 0
    assert len(few.triangles) < len(some.triangles) / 3 < len(full.triangles) / 12
    for surface, tolerance in ((some, 0.003), (few, 0.02)):
        assert tolerance / 2 < surface.error_m < 2 * tolerance
        assert surface.error_m == pytest.approx(_largest_departure(surface, z), rel=1e-4)


def _largest_departure(surface, z):
    """Of all nodes from the triangle that each lies in."""
    found = np.full(z.shape, np.nan)
    for corners in surface.triangles:
        (x, y), heights = surface.nodes[corners].T.astype(float), surface.z[corners].astype(float)
        columns, rows = np.meshgrid(np.arange(x.min(), x.max() + 1), np.arange(y.min(), y.max() + 1))
        det = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
        b = ((columns - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (rows - y[0])) / det
        c = ((x[1] - x[0]) * (rows - y[0]) - (columns - x[0]) * (y[1] - y[0])) / det
        within = (b >= 0) & (c >= 0) & (b + c <= 1)
        value = heights[0] * (1 - b - c) + heights[1] * b + heights[2] * c
        found[rows[within].astype(int), columns[within].astype(int)] = value[within]
    assert np.isfinite(found).all()
    return np.abs(found - z).max()


@pytest.mark.parametrize(("right", "down"), [(1, 0), (0, 1)])
def test_neighbours_have_all_nodes_of_their_common_edge(right, down):
    first, second = (mesh.simplified(_tile(c, r), 0.01) for c, r in ((0, 0), (right, down)))
    edges = []
    for surface, at in ((first, SIDE), (second, 0)):
        axis = 0 if right else 1
        on_edge = surface.nodes[:, axis] == at
        edges.append(
            {(int(n), float(z)) for n, z in zip(surface.nodes[on_edge, 1 - axis], surface.z[on_edge], strict=True)}
        )
    assert len(edges[0]) == SIDE + 1
    assert edges[0] == edges[1]


def test_a_coarser_tile_has_every_other_node_of_the_four_below():
    quarters = {(c, r): _tile(c, r) for c in (0, 1) for r in (0, 1)}
    z = mesh.halved_resolution(quarters)
    step = 2 * np.arange(SIDE + 1) + 0.5
    expected = _height(step * CELL, -step[:, None] * CELL)
    np.testing.assert_allclose(z, expected, atol=1e-9)
    lost = mesh.lost_detail(quarters, z)
    curvature = 0.3 * 2 / 0.2  # of the hill's top, 1/m
    assert 0.2 * curvature * CELL**2 < lost < 2 * curvature * CELL**2
    del quarters[1, 0]
    part = mesh.halved_resolution(quarters)
    assert np.isnan(part[: SIDE // 2, SIDE // 2 + 1 :]).all()
    assert np.isfinite(part).sum() == (SIDE + 1) ** 2 - (SIDE // 2) ** 2


def test_no_data_no_triangles():
    surface = mesh.simplified(np.full((SIDE + 1, SIDE + 1), np.nan), 0.01)
    assert len(surface.triangles) == len(surface.nodes) == 0
    assert surface.error_m == 0
