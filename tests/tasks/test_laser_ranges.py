import numpy as np
from scipy.spatial import KDTree
from seamosaic.tasks import laser_ranges

from tests.tasks import scenes


def _scene(relief_m, seed=0, count=12_000):
    rng = np.random.default_rng(seed)
    points, poses = scenes.seabed(relief_m), scenes.cameras([[0, 0, 0], [0, 0.8, 0]])
    X = points[rng.permutation(len(points))[:count]]
    return poses, X, {k: scenes.cross(relief_m, poses, k, rng) for k in (0, 1)}


def test_ranges_near_the_laser_are_true_on_slopes_too():
    poses, X, soundings = _scene(0.3)
    found = laser_ranges.measure(poses, X, soundings, 200)
    true = np.linalg.norm(X[found.track] - poses.C_local[found.image], axis=1)
    error = found.range_m - true
    assert (np.bincount(found.image) > 80).all()
    assert 2e-4 < 1.48 * np.median(np.abs(error)) < 0.01
    assert abs(error.mean()) < 0.002


def test_few_tie_points_do_not_tell_how_the_seabed_runs():
    poses, X, soundings = _scene(0.3, count=1500)
    assert len(laser_ranges.measure(poses, X, soundings, 200).track) < 10


def test_the_roughness_is_measured():
    levels = []
    for relief in (0.02, 0.6):
        poses, X, soundings = _scene(relief)
        levels.append(laser_ranges.roughness(poses, X, laser_ranges.measure(poses, X, soundings, 200)))
    assert 0.01 <= levels[0] < levels[1] < 0.3
    sigma = laser_ranges.sigma(np.array([0.0, 0.1]), levels[1])
    assert sigma[0] == 0.001
    assert sigma[1] > 0.1 * levels[1]


def test_the_nearest_are_taken_first_and_images_without_laser_tell_nothing():
    poses, X, soundings = _scene(0.1)
    few, many = (laser_ranges.measure(poses, X, {0: soundings[0]}, most) for most in (10, 300))
    assert len(few.track) == 10
    assert few.away_m.max() <= np.sort(many.away_m)[-1]
    assert set(few.image) == {0}
    assert not len(laser_ranges.measure(poses, X, {}, 10).track)
    assert not len(laser_ranges.measure(poses, X + [40, 0, 0], soundings, 10).track)  # an image on its own
    assert not len(laser_ranges.measure(poses, X[:0], soundings, 10).track)
    assert not len(laser_ranges.measure(poses, X[:12], soundings, 10).track)


def test_slopes_of_a_plane():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-2, 2, (400, 2))
    X = np.column_stack([xy, 0.2 * xy[:, 0] - 0.1 * xy[:, 1]])
    found, width = laser_ranges.slopes(X, KDTree(xy))
    assert np.abs(np.median(found, axis=0) - [0.2, -0.1]).max() < 0.03
    assert (np.abs(np.median(found, axis=0)) < [0.2, 0.1]).all()  # drawn a little towards level
    nearest = np.sort(np.linalg.norm(xy - xy[0], axis=1))
    assert width[0] == nearest[11]
