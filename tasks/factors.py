"""What holds the map to the ground: navigation, or the first image, as factors of a GTSAM graph.

Camera k is the pose variable k; navigation has pose variables of its own (`of_navigation`).
"""

import itertools
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from .navigation import NavigationPrior, Poses, relative, walk_m

Array = NDArray[Any]

_DATUM_SIGMA = 1e-5
DOUBTFUL = 4.0  # sigmas of an attitude, depth or step, from which on they are rather wrong than unlucky
_EXACT_M, _EXACT_RAD, _ANYWHERE_M = 3e-3, 5e-4, 1e2


def pose(R: Array, C: Array) -> Any:
    """A gtsam.Pose3 of R (3, 3) and C (3,)."""
    return gtsam.Pose3(gtsam.Rot3(R), np.asarray(C, float))


def camera_pose(poses: Poses, k: int) -> Any:
    """A gtsam.Pose3 of camera k."""
    return pose(poses.R_local_camera[k], poses.C_local[k])


def datum(start: Poses, first: int) -> Any:
    """Image `first` held where it is."""
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, _DATUM_SIGMA)
    graph.add(gtsam.PriorFactorPose3(first, camera_pose(start, first), noise))
    return graph


def first_values(graph: Any, start: Poses) -> Any:
    """Values of the cameras that have a pose, and of navigation's variables that the graph has, to start from."""
    values, wanted = gtsam.Values(), set(graph.keyVector())
    for k in np.flatnonzero(start.known).tolist():
        place = camera_pose(start, k)
        values.insert(k, place)
        if of_navigation(k) in wanted:
            values.insert(of_navigation(k), place)
    return values


def optimise(graph: Any, values: Any) -> Any:
    """The values at which a graph's error is least (Levenberg & Marquardt)."""
    p = gtsam.LevenbergMarquardtParams()
    p.setOrderingType("METIS")
    return gtsam.LevenbergMarquardtOptimizer(graph, values, p).optimize()


def elimination_order(graph: Any) -> Any:
    """Of a linear graph, by nested dissection, which a survey's wide and flat net of images asks for."""
    return gtsam.Ordering.MetisGaussianFactorGraph(graph)


def read_poses(values: Any, start: Poses) -> Poses:
    """The cameras' poses in values; NaN where they had none to start from."""
    R, C = np.full_like(start.R_local_camera, np.nan), np.full_like(start.C_local, np.nan)
    for k in np.flatnonzero(start.known).tolist():
        found = values.atPose3(k)
        R[k], C[k] = found.rotation().matrix(), found.translation()
    return Poses(R, C)


def navigation_factors(navigation: NavigationPrior) -> Any:
    """What navigation says of n images, in variables of its own: where it would have been but for its drift.

    A navigation variable keeps navigation's attitude and depth; its horizontal position is that of the camera. So
    steps are held in the local frame, whatever the heading sensor's error, and the shape of the track helps to
    orient the map. Offset, depth bias (tide, pressure of the air) and heading bias are shared by the whole track: n
    priors together weigh as much as one measurement of the stated sigma; depth has as much noise besides.
    """
    graph = gtsam.NonlinearFactorGraph()
    poses = navigation.poses
    known = np.flatnonzero(poses.known).tolist()
    count = len(known)
    for k in known:
        R, own = poses.R_local_camera[k], camera_pose(poses, k)
        offset, bias = (s[k] * np.sqrt(count) for s in (navigation.sigma_horizontal, navigation.sigma_depth))
        graph.add(gtsam.PriorFactorPose3(of_navigation(k), own, _noise(_EXACT_RAD, R, offset, bias)))
        attitude = _attitude(navigation, k, count)
        tie = _noise(attitude, R, _EXACT_M, float(navigation.sigma_depth[k]))
        graph.add(gtsam.BetweenFactorPose3(of_navigation(k), k, gtsam.Pose3(), robust(tie, DOUBTFUL)))
    for a, b in itertools.pairwise(known):
        step = relative(navigation, a, b)
        between, R = pose(step.R_i_j, step.t_i_j), poses.R_local_camera[b]
        walk = _noise(_EXACT_RAD, R, walk_m(navigation, a, b) + _EXACT_M, _EXACT_M)
        graph.add(gtsam.BetweenFactorPose3(of_navigation(a), of_navigation(b), between, robust(walk, DOUBTFUL)))
        turn = _noise(step.covariance[:3, :3], R, _ANYWHERE_M, _ANYWHERE_M)
        graph.add(gtsam.BetweenFactorPose3(a, b, between, robust(turn, DOUBTFUL)))
    return graph


def of_navigation(k: int) -> int:
    """Key of navigation's own variable of image k."""
    return gtsam.symbol("n", k)


def _attitude(navigation: NavigationPrior, k: int, count: int) -> Array:
    """Covariance (3, 3) of navigation's attitude about the camera's axes; the heading's error is the track's."""
    R = navigation.R_camera_vehicle
    return R @ np.diag(navigation.sigma_attitude[k] ** 2 * [1, 1, count]) @ R.T


def _noise(rotation: Array | float, R_local_camera: Array, horizontal_m: float, vertical_m: float) -> Any:
    """Noise of a pose: covariance (3, 3) or sigma of its rotation, sigmas of its position along the local axes."""
    R = R_local_camera
    position = R.T @ np.diag([horizontal_m, horizontal_m, vertical_m]) ** 2 @ R
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = rotation if isinstance(rotation, np.ndarray) else np.eye(3) * rotation**2
    covariance[3:, 3:] = position
    return gaussian(covariance)


def plane_rows(R: Array, X_camera: Array, normal: Array) -> Array:
    """By how much points of cameras move along normals when the cameras move: (K, 6), rotation and position, right.

    R : (K, 3, 3) R_local_camera. X_camera : (K, 3). normal : (K, 3) local axes.
    """
    seen = np.einsum("kji,kj->ki", R, normal)
    return np.column_stack([np.cross(X_camera, seen), seen])


def linear(values: Any, blocks: dict[int, Array], b: Array) -> Any:
    """Factor of whitened linear observations: the sum of blocks (K, dim) times the steps of the keys from values is b.

    The values are where the observations were made linear.
    """
    (i, A_i), (j, A_j) = blocks.items()
    noise = gtsam.noiseModel.Unit.Create(len(b))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(i, A_i, j, A_j, b, noise), values)


def robust(noise: Any, threshold: float) -> Any:
    """Huber's kernel of a threshold, sigmas, over a noise."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(threshold), noise)


def gaussian(covariance: Array) -> Any:
    """Noise of a covariance (n, n)."""
    return gtsam.noiseModel.Gaussian.Covariance((covariance + covariance.T) / 2)
