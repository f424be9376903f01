"""Points of the seabed from matches between two images whose poses are known (source 2, image matching)."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..schemas.calibration import Camera
from .camera import focal_px, rays
from .navigation import Poses

Array = NDArray[Any]

_MATCH_SIGMA_PX = 0.5
_TYPICAL_M = 3.0  # behind a port the pixels a slope are within a hundredth of these at any distance
_MAX_GAP_PX = 4.0
_NEIGHBOURS = 8
_STEEPEST = 1.5  # rise over run between a point and its neighbours
_MIN_PARALLAX = 0.02  # radians; below it depth is little more than a guess
_WORST_SIGMA = 0.05  # of the range: what is less certain says nothing that its surroundings do not


class TiePoints(NamedTuple):
    """Triangulated matches.

    Attributes
    ----------
    X_local : (N, 3) metres.
    range_m : (N,) from the first image.
    metres_per_px : (N,) by which a pixel's error along the baseline moves a point.
    """

    X_local: Array
    range_m: Array
    metres_per_px: Array

    @property
    def sigma_m(self) -> Array:
        """(N,) 1-sigma of the elevation from the matches' own noise."""
        return _MATCH_SIGMA_PX * math.sqrt(2) * self.metres_per_px


def triangulate(camera: Camera, uv_i: Array, uv_j: Array, poses: Poses, i: int, j: int) -> TiePoints:
    """Points midway where the rays of matches (M, 2) in pixels pass each other; rays that miss are left out."""
    (o_i, d_i), (o_j, d_j) = (_local_rays(camera, uv, poses, k) for uv, k in ((uv_i, i), (uv_j, j)))
    between, cosine = o_j - o_i, np.einsum("nk,nk->n", d_i, d_j)
    along_i, along_j = np.einsum("nk,nk->n", between, d_i), np.einsum("nk,nk->n", between, d_j)
    sine_squared = np.maximum(1 - cosine**2, 1e-12)
    range_i = (along_i - cosine * along_j) / sine_squared
    range_j = (cosine * along_i - along_j) / sine_squared
    P_i, P_j = o_i + range_i[:, None] * d_i, o_j + range_j[:, None] * d_j
    focal = focal_px(camera, _TYPICAL_M)
    gap_px = np.linalg.norm(P_i - P_j, axis=1) / np.maximum(range_i, 1e-6) * focal
    parallax = np.sqrt(sine_squared)
    keep = (range_i > 0) & (range_j > 0) & (gap_px < _MAX_GAP_PX) & (parallax > _MIN_PARALLAX)
    distance = range_i[keep]
    found = certain(TiePoints((P_i[keep] + P_j[keep]) / 2, distance, distance / parallax[keep] / focal))
    return TiePoints(*(values[_like_neighbours(found)] for values in found))


def certain(points: TiePoints, pose_sigma_px: float = 0.0) -> TiePoints:
    """Those that are known well enough to say more than their surroundings do.

    pose_sigma_px : what the poses may be wrong by, as an error of pixels along the baseline.
    """
    kept = np.hypot(points.sigma_m, pose_sigma_px * points.metres_per_px) < _WORST_SIGMA * points.range_m
    return TiePoints(*(values[kept] for values in points))


def _like_neighbours(points: TiePoints) -> NDArray[np.bool_]:
    """Which points (N,) lie on the surface of their neighbours.

    A wrong match along the epipolar line passes every test of the two rays, but its point stands alone, decimetres
    above or below the seabed; terrain as steep as a boulder's side is let pass.
    """
    X = points.X_local
    if len(X) <= _NEIGHBOURS:
        return np.zeros(len(X), bool)
    distance, nearest = (np.asarray(found) for found in KDTree(X[:, :2]).query(X[:, :2], k=_NEIGHBOURS + 1))
    off = np.abs(X[:, 2] - np.median(X[nearest[:, 1:], 2], axis=1))
    return np.asarray(off < 5 * points.sigma_m + _STEEPEST * np.median(np.asarray(distance)[:, 1:], axis=1))


def _local_rays(camera: Camera, uv: Array, poses: Poses, k: int) -> tuple[Array, Array]:
    found = rays(camera, uv)
    R = poses.R_local_camera[k]
    return found.origin @ R.T + poses.C_local[k], found.direction @ R.T
