import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.schemas.parameters import MatchParameters
from seamosaic.tasks import motion, rotations
from seamosaic.tasks.navigation import RelativePrior

from tests.tasks import scenes

P = MatchParameters()


def _estimate(relief_m, seed, step=(0.25, 0.9, 0.05), **options):
    rng = np.random.default_rng(seed)
    points = scenes.seabed(relief_m)
    poses = scenes.cameras([[0, 0, 0], step], seed=seed)
    x_i, x_j = scenes.matches(points, poses, 0, 1, rng, **options)
    lasers = [scenes.laser(points, poses, k, rng) for k in (0, 1)]
    return motion.estimate(x_i, x_j, *lasers, scenes.FOCAL_PX, P), *scenes.true_motion(poses, 0, 1)


@pytest.mark.parametrize(("relief_m", "model"), [(0.0, "homography"), (0.25, "essential")])
def test_the_motion_is_metric_and_its_covariance_honest(relief_m, model):
    """Error bounded from both sides: noise of 0.4 px cannot be beaten by a thousand, nor may it be blown up."""
    errors, scores = [], []
    for seed in range(12):
        found, R, t = _estimate(relief_m, seed)
        assert found is not None
        assert found.model == model
        assert found.metric
        off = np.concatenate([Rotation.from_matrix(R.T @ found.R_i_j).as_rotvec(), R.T @ (found.t_i_j - t)])
        errors.append(np.linalg.norm(found.t_i_j - t))
        scores.append(off @ np.linalg.solve(found.covariance, off) / 6)
    assert 2e-4 < np.median(errors) < 8e-3
    assert 0.1 < np.median(scores) < 4


def test_the_laser_decides_between_homography_and_essential_matrix():
    rng = np.random.default_rng(0)
    for relief_m, planar in ((0.0, True), (0.004, True), (0.15, False)):
        points, poses = scenes.seabed(relief_m), scenes.cameras([[0, 0, 0], [0, 0.9, 0]])
        lasers = [scenes.laser(points, poses, k, rng) for k in (0, 1)]
        assert (motion.common_plane(*lasers, P) is not None) == planar


def _one_arm(points, poses, k):
    """Soundings of a single sheet, in which they lie to rounding."""
    normal = np.array([0.7, 0.65, 0.3]) / np.linalg.norm([0.7, 0.65, 0.3])
    _, seen = scenes.view(points, poses, k)
    X = (points[seen] - poses.C_local[k]) @ poses.R_local_camera[k]
    off = X @ normal - 0.65
    near = np.abs(off) < 0.01
    return X[near] * (0.65 / (0.65 + off[near]))[:, None]


def test_soundings_of_one_arm_lie_on_its_sheet_and_tell_nothing_of_the_seabed():
    rng, dense = np.random.default_rng(0), scenes.seabed(0.25, count=400_000)
    points, poses = scenes.seabed(0.25), scenes.cameras([[0, 0, 0], [0.1, 0.5, 0.05]], seed=2)
    arms = [_one_arm(dense, poses, k) for k in (0, 1)]
    assert motion.fit_plane(arms[0], P.planarity_m).share == 1
    assert motion.common_plane(*arms, P) is None
    found = motion.estimate(*scenes.matches(points, poses, 0, 1, rng), *arms, scenes.FOCAL_PX, P)
    _, t = scenes.true_motion(poses, 0, 1)
    assert (found.model, found.metric) == ("essential", True)
    assert 1e-4 < np.linalg.norm(found.t_i_j - t) < 0.03


def test_features_on_a_box_do_not_take_their_scale_from_the_floor_around_it():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-1.2, 1.2, (60_000, 2))
    box = (np.abs(xy) < 0.5).all(1)
    points, textured = np.column_stack([xy, np.where(box, -2.77, -3.0)]), (np.abs(xy) < 0.35).all(1)
    poses = scenes.cameras([[0, 0, 0], [0.1, 0.3, 0]], seed=3)
    lasers = [
        np.concatenate([scenes.laser(points[side], poses, k, rng)[:most] for side, most in ((~box, 900), (box, 60))])
        for k in (0, 1)
    ]
    assert motion.common_plane(*lasers, P) is not None
    found = motion.estimate(*scenes.matches(points[textured], poses, 0, 1, rng), *lasers, scenes.FOCAL_PX, P)
    _, t = scenes.true_motion(poses, 0, 1)
    assert 1e-5 < abs(np.linalg.norm(found.t_i_j) / np.linalg.norm(t) - 1) < 0.03


def test_without_laser_the_direction_is_right_and_the_length_open():
    rng = np.random.default_rng(3)
    points, poses = scenes.seabed(0.3), scenes.cameras([[0, 0, 0], [0.2, 0.9, 0]])
    x_i, x_j = scenes.matches(points, poses, 0, 1, rng)
    none = np.zeros((0, 3))
    found = motion.estimate(x_i, x_j, none, none, scenes.FOCAL_PX, P)
    R, t = scenes.true_motion(poses, 0, 1)
    assert found is not None
    assert not found.metric
    assert abs(np.linalg.norm(found.t_i_j) - 1) < 1e-3
    assert np.degrees(np.arccos(found.t_i_j @ t / np.linalg.norm(t))) < 1.0
    assert rotations.angle_between_deg(R, found.R_i_j) < 0.5


def test_on_a_narrow_strip_navigation_leads_to_the_right_motion():
    rng = np.random.default_rng(5)
    points, poses = scenes.seabed(0.1), scenes.cameras([[0, 0, 0], [2.1, 0.1, 0]])
    x_i, x_j = scenes.matches(points, poses, 0, 1, rng, outliers=0.2)
    R, t = scenes.true_motion(poses, 0, 1)
    lasers = [scenes.laser(points, poses, k, rng) for k in (0, 1)]
    covariance = np.diag(np.radians([0.4, 0.4, 1.2]).tolist() + [0.05] * 3) ** 2
    prior = RelativePrior(R, t + 0.03, covariance)
    found = motion.estimate(x_i, x_j, *lasers, scenes.FOCAL_PX, P, prior)
    assert found is not None
    direction, expected = (v / np.linalg.norm(v) for v in (found.t_i_j, t))
    assert np.degrees(np.arccos(direction @ expected)) < 2.0
    assert rotations.angle_between_deg(R, found.R_i_j) < 2.0


@pytest.mark.parametrize("seed", range(5))
def test_unrelated_images_have_no_motion(seed: int):
    rng = np.random.default_rng(seed)
    x_i, x_j = rng.uniform(-0.3, 0.3, (2, 60, 2))
    none = np.zeros((0, 3))
    assert motion.estimate(x_i, x_j, none, none, scenes.FOCAL_PX, P) is None
    assert motion.estimate(x_i[:5], x_j[:5], none, none, scenes.FOCAL_PX, P) is None


def test_plane_through_soundings_with_outliers():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (500, 2))
    X = np.column_stack([xy, 3 + 0.1 * xy[:, 0] - 0.2 * xy[:, 1] + rng.normal(0, 0.003, 500)])
    X[:40, 2] += rng.uniform(0.1, 0.6, 40)
    plane = motion.fit_plane(X, 0.02)
    assert plane is not None
    normal = np.array([-0.1, 0.2, 1]) / np.sqrt(1.05)
    assert np.degrees(np.arccos(plane.normal @ normal)) < 0.1
    assert 0.90 < plane.share < 0.94
    assert 0.002 < plane.rms_m < 0.005
    assert motion.fit_plane(X[:5], 0.02) is None


@pytest.mark.parametrize("relief_m", [0.0, 0.3])
def test_an_error_that_soundings_share_is_an_error_of_the_scale(relief_m):
    points, poses, rng = scenes.seabed(relief_m), scenes.cameras([[0, 0, 0], [0, 0.6, 0]]), np.random.default_rng(3)
    x = scenes.matches(points, poses, 0, 1, rng)
    X = [scenes.laser(points, poses, k, rng) for k in (0, 1)]
    alone, shared = (motion.estimate(*x, *X, scenes.FOCAL_PX, MatchParameters(), None, s) for s in (0.0, 0.02))
    along = shared.t_i_j / np.linalg.norm(shared.t_i_j)
    in_camera_j = shared.R_i_j.T @ along
    sigma = np.sqrt(in_camera_j @ shared.covariance[3:, 3:] @ in_camera_j) / np.linalg.norm(shared.t_i_j)
    assert alone.scale_sigma < 0.01 < 0.02 <= shared.scale_sigma < 0.025
    assert 0.019 < sigma < 0.03
