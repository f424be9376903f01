"""Two views of the same points: image points are slopes (x/z, y/z) in the camera frames, motions poses of j in i."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def homogeneous(x: Array) -> Array:
    """Points (N, 3) of slopes (N, 2)."""
    return np.column_stack([x, np.ones(len(x))])


def sampson(x_i: Array, x_j: Array, R_i_j: Array, t_i_j: Array) -> Array:
    """Signed Sampson distance (N,) in slopes of matches (N, 2) from the epipolar geometry of a motion."""
    return distances(homogeneous(x_i), homogeneous(x_j), essential(R_i_j, t_i_j))


def essential(R_i_j: Array, t_i_j: Array) -> Array:
    """E (3, 3) with x_j' E x_i = 0."""
    t = t_i_j / np.linalg.norm(t_i_j)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return (cross @ R_i_j).T


def distances(p_i: Array, p_j: Array, E: Array) -> Array:
    """Sampson distances (..., N) of homogeneous points (N, 3) for essential matrices (..., 3, 3)."""
    line_j, line_i = p_i @ E.swapaxes(-1, -2), p_j @ E
    norm = np.sqrt((line_j[..., :2] ** 2).sum(-1) + (line_i[..., :2] ** 2).sum(-1))
    return (p_j * line_j).sum(-1) / np.maximum(norm, 1e-12)


def depths(x_i: Array, x_j: Array, R_i_j: Array, t_i_j: Array) -> tuple[Array, Array]:
    """Depths Z (N,), (N,) in both cameras where the rays of each match come closest; nan for parallel rays."""
    d_i, d_j = homogeneous(x_i), homogeneous(x_j) @ R_i_j.T
    a, b, c = (d_i**2).sum(1), (d_i * d_j).sum(1), (d_j**2).sum(1)
    e, f = d_i @ t_i_j, d_j @ t_i_j
    determinant = a * c - b * b
    safe = np.where(determinant > 1e-12 * a * c, determinant, np.nan)
    return (c * e - b * f) / safe, (b * e - a * f) / safe
