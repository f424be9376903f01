"""Coarser cells made of a finer surface."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seamosaic.tasks import grids
from seamosaic.tasks.coarsening import coarsen
from seamosaic.tasks.grids import Grid

FINE = Grid(0.02, 25_000_000, 236_000_000, 160, 130)
x, y = (values - values.mean() for values in grids.cell_centres(FINE))


def coarse_of(cell_m, rim=1):
    """The coarse cells that lie whole within the fine grid and a rim of its cells."""
    west, south, east, north = grids.pad(FINE, -rim).bounds
    left, top = int(np.ceil(west / cell_m - 1e-6)), int(np.floor(north / cell_m + 1e-6))
    return Grid(cell_m, left, top, int(east / cell_m + 1e-6) - left, top - int(np.ceil(south / cell_m - 1e-6)))


def layers(elevation, sigma=0.004, source=2, density=3):
    return [np.broadcast_to(value, FINE.shape) for value in (elevation, sigma, source, density)]


@given(st.floats(0.0201, 0.3), st.floats(-2, 2), st.floats(-2, 2))
def test_a_plane_stays_where_it_is_whatever_the_cell(cell_m, east, north):
    coarse = coarse_of(cell_m)
    found = coarsen(FINE, *layers(east * x + north * y - 12), coarse)
    X, Y = grids.cell_centres(coarse)
    X, Y = X - grids.cell_centres(FINE)[0].mean(), Y - grids.cell_centres(FINE)[1].mean()
    np.testing.assert_allclose(found.elevation, east * X + north * Y - 12, atol=1e-6)
    np.testing.assert_allclose(found.sigma, 0.004, atol=1e-6)  # the errors of neighbours are much the same
    assert (found.source == 2).all()


@pytest.mark.parametrize("cell_m", [0.04, 0.05])
def test_every_sounding_is_counted_once(cell_m):
    density = np.random.default_rng(0).integers(0, 9, FINE.shape)
    found = coarsen(FINE, *layers(-12.0, density=density), grids.grid_around(FINE.bounds, cell_m))
    assert found.density.sum() == density.sum()


def test_tiles_give_what_the_whole_gives():
    rough = layers(np.random.default_rng(1).normal(-12, 0.1, FINE.shape))
    coarse = coarse_of(0.05)
    whole = coarsen(FINE, *rough, coarse)
    for tile in grids.tiles(coarse, 16):
        around = grids.intersection(FINE, grids.pad(grids.grid_around(tile.bounds, 0.02), 1))
        assert around is not None
        part = coarsen(around, *(values[grids.window(FINE, around)] for values in rough), tile)
        for one, other in zip(part, whole, strict=True):
            np.testing.assert_allclose(one, other[grids.window(coarse, tile)], atol=1e-9)


def test_half_a_cell_is_enough_and_less_is_not():
    edge = float(x[0, FINE.width // 2])
    known = np.where(x < edge, -12 + 0.2 * np.sin(40 * y), np.nan)
    coarse = coarse_of(0.1)
    found = coarsen(FINE, *layers(known), coarse)
    X, _ = grids.cell_centres(coarse)
    X = X - grids.cell_centres(FINE)[0].mean()
    there = np.isfinite(found.elevation)
    assert there[edge - 0.06 > X].all()
    assert not there[edge + 0.06 < X].any()
    partly = there & (np.abs(X - edge) < 0.049)
    assert not partly.any() or (found.sigma[partly] > 0.005).any()  # what is missing may be otherwise
    assert ((found.source > 0) == there).all()
    assert ((found.density > 0) == there).all()


def test_the_source_is_that_of_most_of_the_cell():
    """A laser line of two cells in large ones that matching has filled, and one cell of nothing else."""
    source = np.full(FINE.shape, 2)
    source[:, 40:42] = 1
    source[:30] = 3
    found = coarsen(FINE, *layers(-12.0, source=source), coarse_of(0.2))
    assert set(np.unique(found.source).tolist()) == {2, 3}
    assert 1 in coarsen(FINE, *layers(-12.0, source=source), coarse_of(0.03)).source
