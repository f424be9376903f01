import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seamosaic.tasks import grids
from seamosaic.tasks.grids import Bounds, Grid

metres = st.floats(-5e6, 5e6)
lengths = st.floats(0.01, 40)
cells = st.sampled_from([0.002, 0.02, 0.05, 0.25])


@given(metres, metres, lengths, lengths, cells)
def test_grid_around_covers_bounds_with_no_cell_to_spare(west, south, width, height, cell_m):
    grid = grids.grid_around((west, south, west + width, south + height), cell_m)
    slack = 2e-6 * cell_m + 1e-8
    assert grid.bounds.west <= west + slack
    assert grid.bounds.east >= west + width - slack
    assert grid.bounds.south <= south + slack
    assert grid.bounds.north >= south + height - slack
    assert grid.bounds.west > west - cell_m - slack
    assert grid.bounds.north < south + height + cell_m + slack


def test_grid_around_bounds_on_cell_edges_adds_no_cell():
    assert grids.grid_around(Bounds(0.1, 0.3, 0.7, 0.9), 0.1) == Grid(0.1, 1, 9, 6, 6)
    assert grids.grid_around(Bounds(0.1, 0.3, 0.1, 0.3), 0.1).shape == (1, 1)


@given(st.integers(-300, 300), st.integers(-300, 300), st.integers(1, 200), st.integers(1, 200), st.integers(5, 90))
def test_tiles_take_every_cell_once(left, top, width, height, size):
    grid = Grid(0.5, left, top, width, height)
    taken = np.zeros(grid.shape, int)
    for tile in grids.tiles(grid, size):
        assert tile.width <= size
        assert tile.height <= size
        taken[grids.window(grid, tile)] += 1
    assert (taken == 1).all()


def test_tiles_of_a_grown_grid_are_the_same_tiles():
    small, grown = Grid(0.1, 0, 0, 256, 256), Grid(0.1, -40, 30, 500, 400)
    assert set(grids.tiles(small, 128)) <= set(grids.tiles(grown, 128))


@given(cells, st.integers(-(10**8), 10**8), st.integers(-(10**8), 10**8))
def test_index_of_inverts_cell_centres(cell_m, left, top):
    grid = Grid(cell_m, left, top, 7, 5)
    X, Y = grids.cell_centres(grid)
    row, column = grids.index_of(grid, np.column_stack([X.ravel(), Y.ravel()]))
    assert (row.reshape(5, 7) == np.arange(5)[:, None]).all()
    assert (column.reshape(5, 7) == np.arange(7)).all()
    assert grids.inside(grid, row, column).all()
    assert not grids.inside(grid, row - 5, column).any()
    assert not grids.inside(grid, row, column + 7).any()


def test_row_0_is_north_and_column_0_west():
    grid = Grid(0.5, 10, 4, 3, 2)
    X, Y = grids.cell_centres(grid)
    assert grid.bounds == Bounds(5.0, 1.0, 6.5, 2.0)
    np.testing.assert_array_equal(X[0], [5.25, 5.75, 6.25])
    np.testing.assert_array_equal(Y[:, 0], [1.75, 1.25])


def test_centres_have_the_same_bits_in_every_tile():
    grid = Grid(0.002, 350_000_123, 2_400_000_777, 300, 200)
    X, Y = grids.cell_centres(grid)
    for tile in grids.tiles(grid, 64):
        at = grids.window(grid, tile)
        np.testing.assert_array_equal(grids.cell_centres(tile)[0], X[at])
        np.testing.assert_array_equal(grids.cell_centres(tile)[1], Y[at])


def test_windows_of_foreign_grids_are_refused():
    grid = Grid(0.1, 0, 0, 10, 10)
    with pytest.raises(ValueError, match="does not lie within"):
        grids.window(grid, grids.pad(grid, 1))
    with pytest.raises(ValueError, match="do not fit"):
        grids.intersection(grid, grid._replace(cell_m=0.2))
    assert grids.intersection(grid, Grid(0.1, 10, 0, 5, 5)) is None
    assert grids.pad(grids.pad(grid, 3), -3) == grid


@pytest.mark.parametrize(
    ("gsd", "bathymetry", "mosaic"),
    [(0.0006, 0.02, 0.002), (0.0021, 0.02, 0.0021), (0.01234, 0.0494, 0.0124), (0.005, 0.02, 0.005)],
)
def test_automatic_cells(gsd, bathymetry, mosaic):
    assert grids.bathymetry_cell_m(gsd) == pytest.approx(bathymetry, abs=1e-9)
    assert grids.mosaic_cell_m(gsd) == pytest.approx(mosaic, abs=1e-9)
