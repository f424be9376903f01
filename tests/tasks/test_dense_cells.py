import numpy as np
import pytest
from seamosaic.tasks import dense_cells
from seamosaic.tasks.dense_cells import departures, differences, reduce_to_cells, share_of_each

CORNER = np.array([500_000.0, 4_700_000.0])


def _floor(rng, count, z=-12.0, size_m=1.0):
    return np.column_stack([CORNER + rng.uniform(0, size_m, (count, 2)), np.full(count, z)])


def test_a_cell_has_the_median_of_its_points():
    rng = np.random.default_rng(0)
    X = _floor(rng, 40_000)
    X[:, 2] += rng.normal(0, 0.002, len(X))
    wild = rng.random(len(X)) < 0.2
    X[wild, 2] += 0.5
    cells = reduce_to_cells(X, np.full(len(X), 0.005), np.full(len(X), 0.1), _floor(rng, 200), 0.05)
    assert len(cells.X_map) == 400
    assert 0.0001 < np.std(cells.X_map[:, 2] + 12) < 0.002
    assert np.allclose(cells.metres_per_px, 0.005)
    assert cells.borne_out.all()
    centre = (np.floor(cells.X_map[:, :2] / 0.05) + 0.5) * 0.05
    assert np.abs(cells.X_map[:, :2] - centre).max() < 0.01


def test_ground_that_nothing_around_bears_out_is_doubtful():
    rng = np.random.default_rng(1)
    X, known = _floor(rng, 20_000), _floor(rng, 300)
    invented = (X[:, :2] - CORNER < 0.3).all(1)
    X[invented, 2] += 0.4
    cells = reduce_to_cells(X, np.full(len(X), 0.005), np.full(len(X), 0.1), known, 0.02)
    wrong = cells.X_map[:, 2] > -11.7
    assert wrong.sum() > 150
    assert not cells.borne_out[wrong].any()
    assert cells.borne_out[~wrong].all()
    # a boulder with tie points on it is none
    known[(known[:, :2] - CORNER < 0.3).all(1), 2] += 0.4
    assert reduce_to_cells(X, np.full(len(X), 0.005), np.full(len(X), 0.1), known, 0.02).borne_out[wrong].mean() > 0.97


def test_nothing_known_leaves_all_in_doubt_and_no_points_leave_no_cells():
    rng = np.random.default_rng(2)
    X = _floor(rng, 5000)
    assert not reduce_to_cells(X, np.full(len(X), 0.005), np.full(len(X), 0.1), X[:3], 0.05).borne_out.any()
    assert len(reduce_to_cells(X[:0], np.zeros(0), np.zeros(0), X, 0.05).X_map) == 0


def test_the_laser_tells_by_how_much_matching_errs():
    rng = np.random.default_rng(3)
    X, laser = _floor(rng, 5000), _floor(rng, 3000)
    X[:, 2] += rng.normal(0, 0.3 * 0.005, len(X))
    laser[:, 2] += rng.normal(0, 0.3 * 0.005, len(laser))
    off = differences(X, np.full(len(X), 0.005), laser, 0.01)
    assert 1000 < len(off.px) < 5000
    assert 0.27 < share_of_each(off.px, 1.0) < 0.33
    assert 0.27 < share_of_each(off.metres, 1.0) / 0.005 < 0.33
    assert share_of_each(off.px[:5], 1.0) == 1.0
    assert dense_cells.NO_CELLS.X_map.shape == (0, 3)
    assert len(differences(X, np.full(len(X), 0.005), laser[:0], 0.01).px) == 0


def test_only_what_poses_do_is_told_of_laser_and_matching():
    """Slopes, roughness, noise and where in a cell the laser lies do not count; an offset does."""
    rng = np.random.default_rng(4)
    slope = lambda xy: -12 + 0.4 * (xy[:, 0] - CORNER[0]) - 0.3 * (xy[:, 1] - CORNER[1])  # noqa: E731
    centres = (np.stack(np.meshgrid(np.arange(100), np.arange(100)), -1).reshape(-1, 2) + 0.5) * 0.02 + CORNER
    cells = np.column_stack([centres, slope(centres) + rng.normal(0, 0.002, len(centres))])
    along = rng.uniform(0, 2, 3000)
    line = CORNER + np.column_stack([along, 0.2 + 0.8 * along])
    laser = np.column_stack([line, slope(line) + rng.normal(0, 0.002, len(line))])
    scale = np.full(len(cells), 0.01)
    none = departures(cells, scale, laser, 0.02)
    assert len(none.metres) >= 4
    assert np.median(none.metres) < 0.0004
    raised = departures(cells + (0, 0, 0.003), scale, laser, 0.02)
    assert 0.0025 < np.median(raised.metres) < 0.0035
    assert np.allclose(raised.px, raised.metres / 0.01)
    assert not len(departures(cells[:5], scale[:5], laser, 0.02).px)


@pytest.mark.parametrize(("points_a_cell", "share"), [(np.inf, 0.6), (4.0, 0.85), (1.0, 1.0)])
def test_a_cell_that_can_have_few_points_needs_half_of_them(points_a_cell, share):
    rng = np.random.default_rng(4)
    X = _floor(rng, 1200)  # three in each of 400 cells on average
    cells = reduce_to_cells(X, np.full(len(X), 0.005), np.full(len(X), 0.1), X[:100], 0.05, points_a_cell)
    hit = len(np.unique(np.floor(X[:, :2] / 0.05), axis=0))
    assert len(cells.X_map) / hit == pytest.approx(share, abs=0.05)
