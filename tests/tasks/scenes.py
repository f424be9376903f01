"""Cameras over a made seabed, for the tests of motions and poses."""

import numpy as np
from scipy.spatial.transform import Rotation
from seamosaic.tasks.navigation import Poses

FOCAL_PX = 1500.0
DOWN = np.diag([1.0, -1.0, -1.0])


def height(relief_m, x, y):
    """Elevation of a seabed 3 m below z = 0 with long waves of a relief."""
    return -3 + relief_m * (np.sin(2.1 * x) * np.cos(1.7 * y) + 0.5 * np.sin(4.3 * y + x))


def seabed(relief_m, seed=0, size_m=12.0, count=40_000):
    """Points (N, 3) on a seabed 3 m below z = 0 with long waves of a relief."""
    xy = np.random.default_rng(seed).uniform(-size_m / 2, size_m / 2, (count, 2))
    return np.column_stack([xy, height(relief_m, *xy.T)])


def cameras(C, tilt_deg=2.0, seed=1):
    """Cameras looking down, heading north, with some tilt and yaw."""
    C = np.asarray(C, float)
    tilts = np.random.default_rng(seed).normal(0, tilt_deg, (len(C), 3))
    return Poses(DOWN @ Rotation.from_euler("xyz", tilts, degrees=True).as_matrix(), C)


def view(points, poses, k, half=(0.40, 0.30)):
    """Slopes (N, 2) of the points in camera k and which it sees."""
    X = (points - poses.C_local[k]) @ poses.R_local_camera[k]
    x = X[:, :2] / X[:, 2:]
    return x, (np.abs(x) < half).all(1) & (X[:, 2] > 0)


def matches(points, poses, i, j, rng, noise_px=0.4, outliers=0.1, most=400):
    """Matched slopes (M, 2), (M, 2) of cameras i and j, some of them wrong."""
    (x_i, seen_i), (x_j, seen_j) = view(points, poses, i), view(points, poses, j)
    both = np.flatnonzero(seen_i & seen_j)[:most]
    a, b = (x[both] + rng.normal(0, noise_px / FOCAL_PX, (len(both), 2)) for x in (x_i, x_j))
    wrong = rng.random(len(both)) < outliers
    b[wrong] = rng.uniform(-0.3, 0.3, (wrong.sum(), 2))
    return a, b


def laser(points, poses, k, rng, noise_m=0.001):
    """Soundings (L, 3) in the frame of camera k, along two diagonals."""
    x, seen = view(points, poses, k)
    on_cross = np.minimum(np.abs(x[:, 0] - x[:, 1]), np.abs(x[:, 0] + x[:, 1])) < 0.01
    X = (points[seen & on_cross] - poses.C_local[k]) @ poses.R_local_camera[k]
    return X * (1 + rng.normal(0, noise_m / 3, (len(X), 1)))


def true_motion(poses, i, j):
    """R_i_j, t_i_j."""
    R_i = poses.R_local_camera[i]
    return R_i.T @ poses.R_local_camera[j], R_i.T @ (poses.C_local[j] - poses.C_local[i])


def cross(relief_m, poses, k, rng, noise_m=0.001, count=300):
    """Soundings (2 count, 3) in the frame of camera k, evenly along two diagonals of its image."""
    t = np.linspace(-0.3, 0.3, count)
    x = np.concatenate([np.column_stack([t, t]), np.column_stack([t, -t])])
    ray = np.column_stack([x, np.ones(len(x))])
    direction, C = ray @ poses.R_local_camera[k].T, poses.C_local[k]
    Z = np.full(len(x), 3.0)
    for _ in range(30):
        ground = C + direction * Z[:, None]
        Z += (height(relief_m, *ground[:, :2].T) - ground[:, 2]) / direction[:, 2]
    return ray * (Z + rng.normal(0, noise_m, len(Z)))[:, None]
