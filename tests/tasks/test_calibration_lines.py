import numpy as np
import pytest
from seamosaic.tasks.calibration_lines import averaged, between_edges


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


def test_a_clipped_line_is_between_its_edges_whatever_its_halo():
    """Five times what can be shown, in a halo that is three times as bright on one side of the line as on the other."""
    v, u = np.mgrid[:300, :400].astype(float)
    true = 180.3 + 0.11 * v[:, 0]
    off = u - true[:, None]
    halo = np.where(off < 0, 30, 90) * np.exp(-np.abs(off) / 15)
    image = np.clip(1200 * np.exp(-0.5 * (off / 5) ** 2) + halo + 5, 0, 255).astype(np.uint8)
    rows = np.arange(2.0, 298, 3)
    weight = np.clip(image[rows.astype(int)].astype(float) - 20, 0, None)
    centroid = (weight * u[0]).sum(1) / weight.sum(1)
    start = np.column_stack([centroid, rows])
    for picture in (image, np.stack([image // 2, image, image // 3], -1)):
        found = between_edges(picture, start)
        wrong = [uv[:, 0] - np.interp(uv[:, 1], v[:, 0], true) for uv in (start, found)]
        assert np.abs(wrong[0]).min() > 0.6
        # the halo is a third of the edges' height steeper on one side; rows by themselves have the raster's error
        assert abs(wrong[1].mean()) < 0.25
        assert np.abs(wrong[1]).max() < 0.5


def test_a_line_that_is_not_clipped_or_leaves_the_image_stays():
    u = np.arange(200.0)
    faint = np.clip(200 * np.exp(-0.5 * ((u - 90.2) / 3) ** 2), 0, 255).astype(np.uint8)
    at_the_edge = np.where(u < 12, 255, 20).astype(np.uint8)
    for row, at in ((faint, 90.1), (at_the_edge, 6.0)):
        uv = np.array([[at, 10.0]])
        assert between_edges(np.tile(row, (20, 1)), uv).tolist() == uv.tolist()
