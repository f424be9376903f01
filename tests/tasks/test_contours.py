"""Contours of surfaces whose contours are known, and of tiles against those of the whole."""

import numpy as np
import pytest
from seamosaic.tasks import contours
from seamosaic.tasks.grids import Grid, cell_centres, tiles, window

CELL = 0.02
GRID = Grid(CELL, 25_000_000, 235_000_000, 100, 80)
MIDDLE = np.array([500_001.0, 4_699_999.2])


def _cone():
    """Rises 0.5 m for each metre from MIDDLE; the westernmost 5 columns are empty."""
    x, y = cell_centres(GRID)
    z = -3 + 0.5 * np.hypot(x - MIDDLE[0], y - MIDDLE[1])
    z[:, :5] = np.nan
    return z


def test_contours_lie_on_their_elevation():
    """On the cone a contour is a circle: 2 m of radius for each metre of height."""
    found = contours.contours(_cone(), GRID, 0.1)
    assert {round(elevation, 3) for elevation in found.elevation} == {-2.9, -2.8, -2.7, -2.6, -2.5, -2.4}
    for elevation, line in found.lines():
        radius = np.hypot(*(line - MIDDLE).T)
        np.testing.assert_allclose(radius, 2 * (elevation + 3), atol=0.002)
        assert line[:, 0].min() > GRID.bounds.west + 5 * CELL  # none through the empty part


@pytest.mark.parametrize("z", [np.full((9, 9), np.nan), np.zeros((1, 9)), np.full((9, 9), -3.05)])
def test_nothing_to_contour(z):
    found = contours.contours(z, Grid(CELL, 0, 0, *z.shape[::-1]), 0.1)
    assert not list(found.lines())
    assert not list(contours.join([found, found], CELL).lines())


@pytest.mark.parametrize(("span", "interval"), [(0.0, 0.01), (1.2, 0.1), (3.0, 0.2), (6.5, 0.5), (120, 10)])
def test_interval_is_round(span, interval):
    counts = contours.heights(np.linspace(-span, 0, 100_001) / 0.98)
    assert contours.interval_m(counts) == pytest.approx(interval)


def test_an_empty_map_has_an_interval_too():
    assert contours.interval_m(contours.heights(np.full((3, 3), np.nan))) == pytest.approx(0.01)


def _as_sets(found):
    return {(elevation, frozenset(map(tuple, np.round(line, 5).tolist()))) for elevation, line in found.lines()}


@pytest.mark.parametrize("size", [16, 33])
def test_contours_of_tiles_joined_are_those_of_the_whole(size):
    z = _cone() + np.random.default_rng(1).normal(0, 0.004, GRID.shape)
    parts = []
    for tile in tiles(GRID, size):
        shared = Grid(CELL, tile.left, tile.top, *(np.array(tile[3:]) + 1).tolist())
        around = np.full(shared.shape, np.nan)
        rows, columns = window(GRID, tile)
        part = z[rows.start : rows.stop + 1, columns.start : columns.stop + 1]
        around[: part.shape[0], : part.shape[1]] = part
        parts.append(contours.contours(around, shared, 0.1))
    whole = contours.join([contours.contours(z, GRID, 0.1)], CELL)
    assert len(whole.elevation) > 6
    assert sum(len(part.elevation) for part in parts) > len(whole.elevation)
    assert _as_sets(contours.join(parts, CELL)) == _as_sets(whole)
