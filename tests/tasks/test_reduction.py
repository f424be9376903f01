"""Tie points eliminated: the same answers as GTSAM gives with every tie point a variable of its own."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from seamosaic.tasks import reduction
from seamosaic.tasks.evaluation import trajectory_errors
from seamosaic.tasks.factors import first_values, navigation_factors
from seamosaic.tasks.laser_ranges import Ranges
from seamosaic.tasks.navigation import NavigationPrior, Poses
from seamosaic.tasks.reduction import State
from seamosaic.tasks.tracks import Sights

COUNT, POINTS = 6, 80
SIGMA, SIGMA_M, THRESHOLD = 3e-4, 0.004, 3.0


class Scene:
    """A line of cameras over rough ground, with noise, some wrong sights and navigation."""

    def __init__(self, seed: int):
        rng = np.random.default_rng(seed)
        C = np.column_stack([0.7 * np.arange(COUNT), rng.normal(0, 0.05, (COUNT, 2))])
        down = np.diag([1.0, -1.0, -1.0])
        self.true = Poses(down @ Rotation.from_rotvec(rng.normal(0, 0.02, (COUNT, 3))).as_matrix(), C)
        X = np.column_stack([rng.uniform(-0.8, 4.3, POINTS), rng.uniform(-0.8, 0.8, POINTS), np.zeros(POINTS)])
        self.X = X + [0, 0, -3] + rng.normal(0, 0.05, (POINTS, 3)) * [0, 0, 1]
        image, track = np.meshgrid(np.arange(COUNT), np.arange(POINTS))
        image, track = image.ravel(), track.ravel()
        seen = np.einsum("mji,mj->mi", self.true.R_local_camera[image], self.X[track] - C[image])
        x = seen[:, :2] / seen[:, 2:]
        near = (np.abs(x) < 0.4).all(1)
        near &= (np.bincount(track[near], minlength=POINTS) > 1)[track]
        names, number = np.unique(track[near], return_inverse=True)
        self.X = self.X[names]
        x = x[near] + rng.normal(0, SIGMA, (near.sum(), 2))
        x[:5] += 0.02
        self.sights, self.x = Sights(image[near], number, x), x
        chosen = np.flatnonzero(near)[::4]
        lit = np.flatnonzero(np.isin(np.flatnonzero(near), chosen))
        length = np.linalg.norm(self.X[number[lit]] - C[image[near][lit]], axis=1)
        range_m = length + rng.normal(0, SIGMA_M, len(lit))
        self.ranges = Ranges(image[near][lit], number[lit], range_m, np.zeros(len(lit)), np.zeros((len(lit), 2)))
        drift = np.cumsum(rng.normal(0, 0.02, (COUNT, 3)), 0)
        self.start = Poses(
            self.true.R_local_camera @ Rotation.from_rotvec(rng.normal(0, 0.004, (COUNT, 3))).as_matrix(), C + drift
        )
        self.navigation = NavigationPrior(
            self.start,
            4.0 * np.arange(COUNT),
            np.full(COUNT, 0.4),
            np.full(COUNT, 0.03),
            np.full((COUNT, 3), 0.005),
            0.02,
            np.eye(3),
        )

    def observations(self):
        sigma_m = np.full(len(self.ranges.track), SIGMA_M)
        normal = np.zeros((len(sigma_m), 3))
        return reduction.observations(self.sights, self.x, SIGMA, self.ranges, sigma_m, normal, THRESHOLD)

    def gtsam(self, fixed):
        """The same adjustment with a variable for each tie point."""

        def robust(dimensions, sigma):
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(THRESHOLD)
            return gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(dimensions, sigma))

        graph, values = gtsam.NonlinearFactorGraph(fixed), first_values(fixed, self.start)
        for n, point in enumerate(self.X):
            values.insert(gtsam.symbol("x", n), point)
        for image, track, x in zip(self.sights.image, self.sights.track, self.x, strict=True):
            key, noise = gtsam.symbol("x", int(track)), robust(2, SIGMA)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(x, noise, int(image), key, gtsam.Cal3_S2()))
        for image, track, range_m in zip(*self.ranges[:3], strict=True):
            graph.add(gtsam.RangeFactor3D(int(image), gtsam.symbol("x", int(track)), range_m, robust(1, SIGMA_M)))
        return graph, values


@pytest.fixture(scope="module", params=[0, 1])
def scene(request):
    return Scene(request.param)


def test_the_error_is_gtsams(scene):
    fixed = navigation_factors(scene.navigation)
    graph, values = scene.gtsam(fixed)
    own = fixed.error(values) + reduction.error(scene.observations(), scene.start, scene.X)
    assert own == pytest.approx(graph.error(values), rel=1e-9)


def test_the_solution_is_gtsams_and_better_than_the_start(scene):
    fixed = navigation_factors(scene.navigation)
    start = State(first_values(fixed, scene.start), scene.start, scene.X)
    found = reduction.solve(fixed, start, scene.observations(), 1e-9, afloat=False)
    graph, values = scene.gtsam(fixed)
    p = gtsam.LevenbergMarquardtParams()
    p.setRelativeErrorTol(1e-12)
    other = gtsam.LevenbergMarquardtOptimizer(graph, values, p).optimize()
    theirs = np.array([other.atPose3(k).translation() for k in range(COUNT)])
    np.testing.assert_allclose(found.poses.C_local, theirs, atol=2e-5)
    before, after = (trajectory_errors(each.C_local, scene.true.C_local) for each in (scene.start, found.poses))
    assert 1e-5 < after.rigid_rms_m < 0.6 * before.rigid_rms_m


def test_an_anchor_changes_where_the_map_is_by_less_than_it_is_certain_and_not_its_shape(scene):
    fixed = navigation_factors(scene.navigation)
    start = State(first_values(fixed, scene.start), scene.start, scene.X)
    free, held = (reduction.solve(fixed, start, scene.observations(), 1e-9, afloat=each) for each in (False, True))
    moved = held.poses.C_local - free.poses.C_local
    assert 0 < np.abs(moved).max() < 0.1 * scene.navigation.sigma_horizontal[0]
    assert np.abs(moved - moved.mean(0)).max() < 1e-3


def test_the_covariances_are_gtsams(scene):
    fixed = navigation_factors(scene.navigation)
    graph, values = scene.gtsam(fixed)
    state = State(first_values(fixed, scene.start), scene.start, scene.X)
    found = reduction.covariances(fixed, state, scene.observations())
    theirs = gtsam.Marginals(graph, values)
    for k in range(COUNT):
        expected = theirs.marginalCovariance(k)
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(found[k] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-3)


def test_distances_along_normals_are_derived_as_they_change(scene):
    """Gradients of the error by poses and tie points against differences, with ranges along normals of their own."""
    count, rng = len(scene.ranges.track), np.random.default_rng(3)
    normal = rng.normal(0, 0.2, (count, 3)) + [0, 0, -1]
    normal[::3] = 0
    seen = scene.X[scene.ranges.track] - scene.start.C_local[scene.ranges.image]
    seen = np.einsum("kji,kj->ki", scene.start.R_local_camera[scene.ranges.image], seen)
    own = (normal != 0).any(1)
    length = np.where(own, (seen * normal).sum(1), np.linalg.norm(seen, axis=1)) + rng.normal(0, SIGMA_M, count)
    ranges, sigma_m = scene.ranges._replace(range_m=length), np.full(count, SIGMA_M)
    o = reduction.observations(scene.sights, scene.x, 1.0, ranges, sigma_m, normal, 1e3)
    found = reduction.linearised(o, scene.start, scene.X)

    def error(step, k, X):
        R, C = scene.start.R_local_camera.copy(), scene.start.C_local.copy()
        C[k] += R[k] @ step[3:]
        R[k] = R[k] @ Rotation.from_rotvec(step[:3]).as_matrix()
        return reduction.error(o, Poses(R, C), X)

    small = 1e-6
    for k in range(COUNT):
        by_pose = [(error(small * e, k, scene.X) - error(-small * e, k, scene.X)) / (2 * small) for e in np.eye(6)]
        np.testing.assert_allclose(by_pose, -found.g_pose[k], rtol=1e-3, atol=1e-2)
    n = int(ranges.track[own][0])
    moves = [small * np.eye(3)[axis] * (np.arange(len(scene.X)) == n)[:, None] for axis in range(3)]
    by_point = [(error(np.zeros(6), 0, scene.X + m) - error(np.zeros(6), 0, scene.X - m)) / (2 * small) for m in moves]
    np.testing.assert_allclose(by_point, -found.g_point[n], rtol=1e-3, atol=1e-2)


def test_what_nothing_holds_is_said(scene):
    nothing = gtsam.NonlinearFactorGraph()
    state = State(first_values(nothing, scene.start), scene.start, scene.X)
    with pytest.raises(RuntimeError):
        reduction.covariances(nothing, state, scene.observations())
