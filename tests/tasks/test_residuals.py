import numpy as np
import pytest
from seamosaic.tasks import residuals
from seamosaic.tasks.crossovers import Crossovers
from seamosaic.tasks.tracks import Sights


def test_residuals_by_image_and_by_pair():
    image, track = np.array([0, 1, 2, 0, 1, 2]), np.array([0, 0, 0, 1, 1, 2])
    off = np.array([[3.0, 4.0], [0, 0], [0, 1], [0, 0], [0, 2], [6, 8]])
    none = np.zeros((3, 3))
    apart = np.array([0.003, -0.004, 0.001])
    crossed = Crossovers(np.array([0, 0, 1]), np.array([3, 3, 3]), none, none, none, apart, np.ones(3))
    found = residuals.of(5, Sights(image, track, np.zeros((6, 2))), off, crossed)
    assert found.image_px[:3] == pytest.approx(np.sqrt([12.5, 2, 50.5]))
    assert np.isnan(found.image_px[3:]).all()
    assert found.sighted.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert found.shared.tolist() == [2, 1, 1]
    assert found.pair_px == pytest.approx(np.sqrt([(12.5 + 2) / 2, 13, 0.5]))
    assert found.crossed.tolist() == [[0, 3], [1, 3]]
    assert found.crossings.tolist() == [2, 1]
    assert found.apart_m == pytest.approx([np.sqrt(12.5e-6), 0.001])


def test_blocks_are_what_pairs_join():
    found = residuals.blocks(6, np.array([[0, 2], [2, 3], [4, 5]]))
    assert found[0] == found[2] == found[3]
    assert found[4] == found[5]
    assert len(np.unique(found)) == 3
    assert len(np.unique(residuals.blocks(3, np.zeros((0, 2), int)))) == 3
