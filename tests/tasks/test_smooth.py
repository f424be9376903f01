"""Matched cells averaged over planes: noise goes, edges stay."""

import numpy as np
import pytest
from seamosaic.tasks import gridding, grids, smooth
from seamosaic.tasks.grids import Grid

GRID = Grid(0.02, 25_000_000, 235_000_000, 70, 60)
X, Y = grids.cell_centres(GRID)


def _cells(z, noise, source=gridding.MATCHING, seed=0):
    rng = np.random.default_rng(seed)
    shape = GRID.shape
    return gridding.Cells(
        elevation=z + rng.normal(0, noise, shape),
        sigma=np.full(shape, np.hypot(noise, 0.001)),
        noise=np.full(shape, noise),
        density=np.ones(shape, np.int32),
        source=np.broadcast_to(np.asarray(source, np.uint8), shape).copy(),
        x=X + rng.uniform(-0.004, 0.004, shape),
        y=Y + rng.uniform(-0.004, 0.004, shape),
    )


def test_even_ground_loses_its_noise_and_says_so():
    slope = -10 + 0.3 * (X - X.min()) + 0.2 * (Y - Y.min())
    before = _cells(slope, 0.002)
    after = smooth.matched(GRID, before)
    error = (after.elevation - slope)[5:-5, 5:-5]
    assert 0.0002 < np.std(error) < 0.0008
    stated = after.noise[5:-5, 5:-5]
    assert 0.6 < np.mean(np.abs(error) < stated) < 0.8
    assert np.median(after.sigma) < np.median(before.sigma)
    # what neighbours share does not average down
    assert np.median(after.sigma) > 0.001
    assert 0.97 < np.mean(np.abs(after.x - X)[5:-5, 5:-5] < 1e-9) <= 1


@pytest.mark.parametrize("width", [1, 3])
def test_cells_that_share_their_noise_are_not_averaged_as_if_they_did_not(width):
    """Noise that is the same over squares of some cells, as it is in one window of matching."""
    before = _cells(np.full(GRID.shape, -10.0), 0.0)._replace(noise=np.full(GRID.shape, 0.002))
    rng = np.random.default_rng(3)
    errors, stated = [], []
    for _ in range(20):
        coarse = rng.normal(0, 0.002, (GRID.height // width + 1, GRID.width // width + 1))
        shared = np.kron(coarse, np.ones((width, width)))[: GRID.height, : GRID.width]
        after = smooth.matched(GRID, before._replace(elevation=-10 + shared), width * GRID.cell_m)
        errors.append(after.elevation[8:-8, 8:-8] + 10)
        stated.append(after.noise[8:-8, 8:-8])
    assert 0.8 < np.std(errors) / np.sqrt(np.mean(np.square(stated))) < 1.3


def test_a_cell_that_keeps_its_own_value_is_carried_along_the_slope():
    """Rough ground on a slope of 0.5, sounded beside the cells' centres and almost without noise."""
    rng = np.random.default_rng(5)
    bumps, aside = rng.normal(0, 0.001, GRID.shape), rng.uniform(-0.008, 0.008, GRID.shape)
    at_centre = -10 + 0.5 * (X - X.min()) + bumps
    cells = _cells(at_centre, 0.0)._replace(
        elevation=at_centre + 0.5 * aside, noise=np.full(GRID.shape, 0.0005), x=X + aside, y=Y
    )
    after = smooth.matched(GRID, cells)
    moved = (np.abs(after.x - X) < 1e-9)[6:-6, 6:-6]
    error = (after.elevation - at_centre)[6:-6, 6:-6][moved]
    assert moved.mean() > 0.9
    # 0.0016 if the slope did not count
    assert 0.0001 < np.median(np.abs(error)) < 0.0004


def test_ground_as_rough_as_its_noise_is_met_halfway():
    rng = np.random.default_rng(4)
    rough = -10 + 0.2 * (X - X.min()) + rng.normal(0, 0.002, GRID.shape)
    cells = _cells(rough, 0.002)
    after = smooth.matched(GRID, cells)
    inner = np.s_[8:-8, 8:-8]
    error, stated = (after.elevation - rough)[inner], after.noise[inner]
    # as good as a mean of both can be, 0.0014 and a little for the plane; either alone errs by 0.002
    assert 0.0013 < np.std(error) < 0.0017
    # highest and lowest of nine are cut, so ground looks a little less rough than it is
    assert 1.0 < np.std(error) / np.sqrt(np.mean(stated**2)) < 1.2
    twice = smooth.matched(GRID, cells, noise_scale=2.0)
    np.testing.assert_array_equal(twice.elevation, after.elevation)
    np.testing.assert_allclose(twice.noise, 2 * after.noise)
    np.testing.assert_allclose(twice.sigma**2 - twice.noise**2, after.sigma**2 - after.noise**2, atol=1e-12)


def test_an_edge_stays_where_it_is():
    step = -10 + 0.2 * (GRID.left * 0.02 + 0.7 > X)
    after = smooth.matched(GRID, _cells(step, 0.002))
    assert np.quantile(np.abs(after.elevation - step), 0.999) < 0.007
    assert np.std((after.elevation - step)[:, 5:25]) < 0.0009


def test_rough_ground_is_left_as_it_is():
    rough = -10 + np.random.default_rng(1).normal(0, 0.03, GRID.shape)
    cells = _cells(rough, 0.002)._replace(x=X, y=Y)
    after = smooth.matched(GRID, cells)
    kept = np.abs(after.elevation - cells.elevation) < 0.001
    # but for cells that all of their neighbours contradict: of nine, the highest and the lowest
    assert 0.6 < kept.mean() < 0.9
    assert np.median(after.noise) > 3 * 0.002


def test_spikes_go_and_the_laser_stays():
    flat = np.full(GRID.shape, -10.0)
    cells = _cells(flat, 0.001)
    spiky = np.random.default_rng(2).random(GRID.shape) < 0.02
    cells.elevation[spiky] += 0.3
    assert np.quantile(np.abs(smooth.matched(GRID, cells).elevation + 10), 0.99) < 0.004
    laser = _cells(flat, 0.001, gridding.LASER)
    laser.source[:, ::2] = gridding.MATCHING
    after = smooth.matched(GRID, laser)
    for before, now in zip(laser, after, strict=True):
        np.testing.assert_array_equal(before[:, 1::2], now[:, 1::2])


def test_a_cell_is_the_same_in_every_tile():
    rough = np.random.default_rng(7).normal(0, 0.003, GRID.shape)
    cells = _cells(-10 + 0.05 * np.sin(9 * X) * np.cos(7 * Y) + rough, 0.002)
    whole = smooth.matched(GRID, cells)
    part = grids.pad(GRID, -13)
    cut = grids.window(GRID, part)
    made = smooth.matched(part, gridding.Cells(*(values[cut] for values in cells)))
    for a, b in zip(made, whole, strict=True):
        rim = np.s_[smooth.REACH : -smooth.REACH, smooth.REACH : -smooth.REACH]
        np.testing.assert_array_equal(a[rim], b[cut][rim])
