import numpy as np
import pytest
from seamosaic.tasks import grids, mesh
from seamosaic.tasks.grids import Bounds, Grid

GRID = Grid(0.1, 4_999_900, 46_999_900, 80, 60)
ORIGIN = np.array([499990.0, 4699990.0, -20.0])


def bumpy(grid=GRID):
    x, y = grids.cell_centres(grid)
    west, south, *_ = grid.bounds
    return -22 + 0.4 * np.exp(-((x - west - 5) ** 2 + (y - south - 2) ** 2)) + 0.1 * (x - west)


def area_above(built):
    a, b, c = (built.vertices[built.triangles[:, k], :2] for k in range(3))
    return 0.5 * np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]


def test_mesh_covers_exactly_the_data_and_faces_up():
    elevation = bumpy()
    elevation[20:30, 40:60] = np.nan
    elevation[5, 5] = np.nan
    built = mesh.surface_mesh(elevation, GRID, ORIGIN, GRID.bounds, 100_000)
    areas = area_above(built)
    assert (areas > 0).all()
    # around a hole of n x m cells (n + 1)(m + 1) squares go, but the four at its corners leave a triangle
    squares = 79 * 59 - (11 * 21 - 2) - (2 * 2 - 2)
    assert areas.sum() == pytest.approx(squares * 0.01, rel=1e-6)
    assert len(built.vertices) == np.isfinite(elevation).sum()
    X, Y = grids.cell_centres(GRID)
    where = np.isfinite(elevation)
    expected = np.column_stack([X[where], Y[where], elevation[where]]) - ORIGIN
    np.testing.assert_allclose(built.vertices, expected, atol=1e-8)


def test_texture_coordinates_begin_in_the_south_west():
    texture = Bounds(GRID.bounds.west - 2, GRID.bounds.south - 1, GRID.bounds.east + 4, GRID.bounds.north + 3)
    built = mesh.surface_mesh(bumpy(), GRID, ORIGIN, texture, 100_000)
    place = built.vertices[:, :2] + ORIGIN[:2]
    expected = (place - [texture.west, texture.south]) / [8 + 6, 6 + 4]
    np.testing.assert_allclose(built.uv, expected, atol=1e-6)
    assert built.uv[built.vertices[:, 1].argmax(), 1] > 0.6


@pytest.mark.parametrize("most", [200, 1500])
def test_simplification_keeps_the_shape(most):
    elevation = bumpy()
    built = mesh.surface_mesh(elevation, GRID, ORIGIN, GRID.bounds, most)
    assert 0.5 * most < len(built.triangles) <= most
    assert (area_above(built) > 0).all()
    assert area_above(built).sum() == pytest.approx(
        7.9 * 5.9, rel=0.1
    )  # at most half a cell of the thinned raster is lost at the rim
    x, y, z = (built.vertices + ORIGIN).T
    west, south, *_ = GRID.bounds
    off = z - (-22 + 0.4 * np.exp(-((x - west - 5) ** 2 + (y - south - 2) ** 2)) + 0.1 * (x - west))
    assert 1e-6 < np.abs(off).max() < 0.06
    assert built.triangles.max() == len(built.vertices) - 1


def test_large_rasters_are_thinned_first():
    grid = Grid(0.02, -513, 401, 700, 600)
    elevation = bumpy(grid)
    elevation[:, :200] = np.nan
    built = mesh.surface_mesh(elevation, grid, np.zeros(3), grid.bounds, 1000)
    assert 400 < len(built.triangles) <= 1000
    assert area_above(built).sum() == pytest.approx(500 * 600 * 0.0004, rel=0.08)
    assert built.vertices[:, 0].min() > grid.bounds.west + 4.0 - 0.02


def test_edges_of_a_box_are_cut_along_the_edge():
    grid = Grid(0.1, 0, 40, 40, 40)
    x, y = grids.cell_centres(grid)
    elevation = np.where(x + y > 4.0, 1.0, 0.0)
    built = mesh.surface_mesh(elevation, grid, np.zeros(3), grid.bounds, 100_000)
    steps = np.ptp(built.vertices[built.triangles, 2], axis=1)
    # every other diagonal would make saw teeth: then each square on the edge has two triangles with a step
    assert (steps > 0.5).sum() <= 2 * 40


def test_no_surface_is_an_error():
    with pytest.raises(ValueError, match="no surface to mesh"):
        mesh.surface_mesh(np.full(GRID.shape, np.nan), GRID, ORIGIN, GRID.bounds, 1000)
