import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from seamosaic.tasks import gridding, grids
from seamosaic.tasks.grids import Grid

GRID = Grid(0.1, 5_000_000, 47_000_000, 30, 20)


def soundings(rng, count, z=lambda x, y: 0 * x - 12.0, noise=0.004, grid=GRID):
    b = grid.bounds
    x, y = rng.uniform(b.west, b.east, count), rng.uniform(b.south, b.north, count)
    return np.column_stack([x, y, z(x, y) + rng.normal(0, noise, count)])


def gridded(X, sigma=0.004, source=1, frame=0, pose=0.0, grid=GRID, doubtful=False):
    n = len(X)
    soundings = gridding.Soundings(
        X,
        np.broadcast_to(np.asarray(sigma, float), n),
        np.broadcast_to(np.asarray(source, np.uint8), n),
        np.broadcast_to(np.asarray(frame), n),
        np.broadcast_to(np.asarray(pose, float), n),
        np.broadcast_to(np.asarray(doubtful), n),
    )
    return gridding.grid_soundings(grid, soundings)


def test_recovers_a_plane_with_the_error_that_it_states():
    rng = np.random.default_rng(1)
    X = soundings(rng, 20_000)
    cells = gridded(X)
    error = cells.elevation + 12.0
    assert cells.density.sum() > 0.98 * len(X)
    assert 0.5 * 0.004 / np.sqrt(33) < error.std() < 1.5 * 0.004 / np.sqrt(33)
    assert 0.55 < np.mean(np.abs(error) < cells.sigma) < 0.85


def test_noise_of_a_frame_averages_down_but_its_pose_does_not():
    rng = np.random.default_rng(2)
    X = soundings(rng, 60_000)
    one = gridded(X, pose=0.03)
    assert np.nanmin(one.sigma) >= 0.03
    assert np.nanmax(one.sigma) < 0.0305
    # nine frames with the same pose sigma: a third
    frame = rng.integers(0, 9, len(X))
    pose = rng.normal(0, 0.03, 9)
    X[:, 2] += pose[frame]
    nine = gridded(X, frame=frame, pose=0.03)
    assert 0.009 < np.nanmedian(nine.sigma) < 0.016


def test_scatter_beyond_the_sigmas_shows():
    rng = np.random.default_rng(3)
    X = soundings(rng, 20_000, noise=0.02)
    cells = gridded(X, sigma=0.004)
    error = cells.elevation + 12.0
    assert 0.55 < np.mean(np.abs(error) < cells.sigma) < 0.85
    # frames that disagree more than their poses may
    frame = np.arange(len(X)) % 2
    X[:, 2] = -12 + 0.1 * frame
    assert np.nanmedian(gridded(X, sigma=0.004, frame=frame, pose=0.01).sigma) > 0.03


def test_outliers_do_not_count():
    rng = np.random.default_rng(4)
    X = soundings(rng, 12_000)
    wild = rng.random(len(X)) < 0.1
    X[wild, 2] += rng.uniform(0.2, 2.0, wild.sum())
    cells = gridded(X)
    # up to a third of a cell's soundings may be wrong; by chance it is more in some cell
    assert np.quantile(np.abs(cells.elevation + 12.0), 0.99) < 0.006
    assert 0.97 * (~wild).sum() < cells.density.sum() < 1.01 * (~wild).sum()


def test_laser_decides_where_it_is():
    rng = np.random.default_rng(5)
    X = soundings(rng, 12_000)
    west = X[:, 0] < GRID.bounds.west + 1.0
    laser = west & (rng.random(len(X)) < 0.5)
    X[~laser, 2] += 0.3
    cells = gridded(X, source=np.where(laser, 1, 2))
    assert (cells.source[:, :10] == gridding.LASER).all()
    assert (cells.source[:, 10:] == gridding.MATCHING).all()
    assert np.abs(cells.elevation[:, :10] + 12.0).max() < 0.01
    assert np.abs(cells.elevation[:, 10:] + 11.7).max() < 0.01


def test_what_matching_says_of_the_lasers_cells_is_kept_beside():
    rng = np.random.default_rng(6)
    laser = soundings(rng, 900, noise=0.001)
    laser = laser[laser[:, 0] < GRID.bounds[0] + 1.5]
    matched = soundings(rng, 3000, z=lambda x, y: 0 * x - 11.9, noise=0.001)
    source = np.repeat([1, 2], [len(laser), len(matched)])
    both = gridding.Soundings(
        np.concatenate([laser, matched]),
        np.full(len(source), 0.001),
        source.astype(np.uint8),
        source.astype(np.int64),
        np.zeros(len(source)),
        np.zeros(len(source), bool),
    )
    cells, beside = gridding.grid_soundings(GRID, both), gridding.beside_laser(GRID, both)
    np.testing.assert_array_equal(beside.density > 0, (cells.source == 1) & (gridded(matched).density > 0))
    assert (beside.source[beside.density > 0] == 2).all()
    np.testing.assert_allclose(beside.elevation[beside.density > 0], -11.9, atol=0.006)
    np.testing.assert_allclose(cells.elevation[beside.density > 0], -12, atol=0.006)


def test_empty_cells_are_empty_and_positions_are_means():
    X = np.array(
        [[500000.01, 4699999.99, -5.0], [500000.03, 4699999.95, -5.2], [0.0, 0.0, 0.0], [500000.5, 4699999.5, np.nan]]
    )
    cells = gridded(X)
    assert cells.density[0, 0] == 2
    assert cells.density.sum() == 2
    assert np.isfinite(cells.elevation).sum() == 1
    assert cells.elevation[0, 0] == pytest.approx(-5.1, abs=1e-9)
    assert (cells.x[0, 0], cells.y[0, 0]) == pytest.approx((500000.02, 4699999.97), abs=1e-8)
    assert cells.source[0, 0] == 1
    assert cells.source.sum() == 1
    assert not gridded(np.zeros((0, 3))).density.any()


def test_the_result_does_not_depend_on_tiling_or_order():
    rng = np.random.default_rng(6)
    X = soundings(rng, 5_000, noise=0.02)
    frame, source, sigma = rng.integers(0, 5, len(X)), rng.integers(1, 3, len(X)), rng.uniform(0.002, 0.01, len(X))
    whole = gridded(X, sigma, source, frame, 0.01)
    order = rng.permutation(len(X))
    for tile in grids.tiles(GRID, 7):
        part = gridded(X[order], sigma[order], source[order], frame[order], 0.01, tile)
        for a, b in zip(part, whole, strict=True):
            np.testing.assert_array_equal(a, b[grids.window(GRID, tile)])


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 6), st.floats(-10, 10)), min_size=1, max_size=60))
def test_group_median_is_numpys(pairs):
    group, values = (np.array(column) for column in zip(*pairs, strict=True))
    group = np.unique(group, return_inverse=True)[1]
    expected = [np.median(values[group == g]) for g in range(group.max() + 1)]
    np.testing.assert_allclose(gridding.group_median(group, values), expected)


def test_doubtful_soundings_need_another_frame_that_says_the_same():
    x, y = (values.ravel() for values in grids.cell_centres(GRID))
    ground, wrong = (np.column_stack([x, y, np.full(len(x), z)]) for z in (-12.0, -12.4))
    frames = np.repeat([1, 2], len(x))
    alone = gridded(wrong, source=2, frame=1, doubtful=True)
    assert alone.density.sum() == 0
    confirmed = gridded(np.vstack([wrong, wrong]), source=2, frame=frames, doubtful=True)
    assert (confirmed.density == 2).all()
    # twice by one frame is once
    assert gridded(np.vstack([wrong, wrong]), source=2, frame=1, doubtful=True).density.sum() == 0
    contradicted = gridded(np.vstack([ground, wrong]), source=2, frame=frames, doubtful=frames == 2)
    assert np.allclose(contradicted.elevation, -12.0)
    assert (contradicted.density == 1).all()
