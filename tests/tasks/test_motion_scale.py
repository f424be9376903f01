import numpy as np
from seamosaic.tasks.motion_scale import laser_scale


def test_scale_is_a_robust_vote_of_the_features_near_soundings():
    rng = np.random.default_rng(1)
    soundings = np.column_stack([rng.uniform(-0.9, 0.9, (400, 1)), np.zeros((400, 1)), np.full((400, 1), 3.0)])
    x = np.column_stack([rng.uniform(-0.3, 0.3, 200), rng.uniform(-0.02, 0.02, 200)])
    depth = 3.0 / 1.25 * (1 + rng.normal(0, 0.01, 200))
    depth[:30] *= rng.uniform(0.5, 2, 30)
    scale, sigma, _ = laser_scale([(x, depth, soundings)])
    assert abs(scale / 1.25 - 1) < 4 * sigma
    assert 5e-4 < sigma < 5e-3
    assert np.isnan(laser_scale([(x + 0.5, depth, soundings)]).scale)
