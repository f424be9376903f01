"""What matched cells err by is found where the laser has seen them, too."""

import numpy as np
import pytest
from seamosaic.tasks import grids, matching_noise
from seamosaic.tasks.gridding import LASER, MATCHING, Cells
from seamosaic.tasks.grids import Grid

GRID = Grid(0.02, 25_000_000, 235_000_000, 200, 150)
X, Y = grids.cell_centres(GRID)
GROUND = -10 + 0.3 * (X - X.min()) - 0.2 * (Y - Y.min())
STATED, LASER_M = 0.002, 0.0005


def _both(scale, poses_m=0.0, seed=0, tail=0.0):
    """Cells with the laser in every fourth column, and those of matching, which err by scale times what they state."""
    rng = np.random.default_rng(seed)
    error = rng.normal(0, scale * STATED, GRID.shape)
    if tail:
        error = np.where(rng.random(GRID.shape) < tail, 4 * error, error)
    bend = poses_m * np.sin(X - X.min()) * np.cos(Y - Y.min())
    lit = np.broadcast_to(np.arange(GRID.width) % 4 == 0, GRID.shape)
    x, y = X + rng.uniform(-0.008, 0.008, GRID.shape), Y + rng.uniform(-0.008, 0.008, GRID.shape)
    on_line = GROUND + 0.3 * (x - X) - 0.2 * (y - Y) + rng.normal(0, LASER_M, GRID.shape)
    source = np.where(lit, LASER, MATCHING)
    matched = Cells(
        elevation=GROUND + bend + error,
        sigma=np.full(GRID.shape, STATED),
        noise=np.full(GRID.shape, STATED),
        density=np.ones(GRID.shape, np.int32),
        source=np.full(GRID.shape, MATCHING, np.uint8),
        x=X,
        y=Y,
    )
    cells = matched._replace(
        elevation=np.where(lit, on_line, matched.elevation),
        noise=np.where(lit, LASER_M, STATED),
        source=source.astype(np.uint8),
        x=np.where(lit, x, X),
        y=np.where(lit, y, Y),
    )
    return cells, matched


def _scale(cells, matched, counted=GRID):
    return matching_noise.noise_scale(matching_noise.compare(GRID, matched, cells, counted))


@pytest.mark.parametrize("poses_m", [0.0, 0.004])
@pytest.mark.parametrize("scale", [1.2, 1.7])
def test_the_scale_is_found_whatever_poses_do(scale, poses_m):
    assert _scale(*_both(scale, poses_m)) == pytest.approx(scale, rel=0.06)


def test_a_long_tail_widens_it_and_too_little_says_nothing():
    assert 1.6 < _scale(*_both(1.5, tail=0.1)) < 2.2
    assert _scale(*_both(0.5)) == 1
    cells, matched = _both(1.2)
    assert _scale(cells, matched, Grid(0.02, GRID.left, GRID.top, 12, 20)) == 1.5
    # a laser that is worse than matching is no judge
    assert _scale(cells._replace(noise=np.where(cells.source == LASER, 0.003, STATED)), matched) == 1.5


def test_only_cells_of_both_are_compared():
    cells, matched = _both(1.5)
    beside = matching_noise.compare(GRID, matched, cells, grids.pad(GRID, -20))
    assert len(beside.error) == pytest.approx(160 * 110 / 4, abs=120)
    np.testing.assert_array_equal(beside.noise, STATED)
    np.testing.assert_array_equal(beside.laser, LASER_M)
    nothing = matching_noise.compare(GRID, matched._replace(source=cells.source), cells, GRID)
    assert [len(values) for values in nothing] == [0, 0, 0]


def test_matching_takes_the_place_of_the_laser_where_it_has_something_to_say():
    cells, matched = _both(1.5)
    some = matched._replace(source=np.where(Y.mean() < Y, MATCHING, 0).astype(np.uint8))
    put = matching_noise.instead_of_laser(cells, some)
    north = Y.mean() < Y
    for values, theirs, mine in zip(put, some, cells, strict=True):
        np.testing.assert_array_equal(values[north], theirs[north])
        np.testing.assert_array_equal(values[~north], mine[~north])
