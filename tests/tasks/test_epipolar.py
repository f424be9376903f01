import numpy as np
from seamosaic.tasks import epipolar

from tests.tasks import scenes


def test_sampson_and_depths_of_perfect_matches():
    points, poses = scenes.seabed(0.3), scenes.cameras([[0, 0, 0], [0.3, 0.8, 0.1]])
    x_i, x_j = scenes.matches(points, poses, 0, 1, np.random.default_rng(0), noise_px=0, outliers=0)
    R, t = scenes.true_motion(poses, 0, 1)
    assert np.abs(epipolar.sampson(x_i, x_j, R, t)).max() < 1e-12
    assert np.abs(epipolar.sampson(x_i, np.add(x_j, [0, 1e-3]), R, t)).mean() > 1e-4
    depth_i, depth_j = epipolar.depths(x_i, x_j, R, t)
    X_i = np.column_stack([x_i, np.ones(len(x_i))]) * depth_i[:, None]
    X_j = np.column_stack([x_j, np.ones(len(x_j))]) * depth_j[:, None]
    np.testing.assert_allclose(X_i, X_j @ R.T + t, atol=1e-9)
