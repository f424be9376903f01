import numpy as np
import pytest
from seamosaic.tasks.calibration_lines import averaged


def test_neighbouring_rows_are_averaged_and_their_sigma_with_them():
    rng, v = np.random.default_rng(0), np.arange(900.0)
    both = np.concatenate([np.column_stack([a + 0.5 * v + rng.normal(0, 0.3, 900), v]) for a in (100, 400)])
    sheet = np.repeat([0, 1], 900)
    order = rng.permutation(1800)
    uv, own, sigma = averaged(both[order], sheet[order], np.full(1800, 0.3))
    assert np.bincount(own).tolist() == [60, 60]
    off = uv[:, 0] - np.array([100, 400])[own] - 0.5 * uv[:, 1]
    assert 0.85 < np.std(off / sigma) < 1.15
    assert sigma == pytest.approx(0.3 / np.sqrt(15))


def test_a_short_line_keeps_its_points_and_none_stays_none():
    uv, own, sigma = averaged(np.array([[1.0, 5.0], [2.0, 4.0], [9.0, 9.0]]), np.array([0, 0, -1]), np.ones(3))
    assert uv.tolist() == [[2.0, 4.0], [1.0, 5.0]]
    assert own.tolist() == [0, 0]
    assert sigma.tolist() == [1.0, 1.0]
    assert len(averaged(uv, np.full(2, -1), sigma)[0]) == 0
