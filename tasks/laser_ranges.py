"""How far tie points are from the cameras whose laser passes near them.

A tie point seldom lies on a laser line, but the seabed between them is a known shape: tie points around it tell how
it slopes. So the sounding's height, carried along that slope to the tie point, is the height of the tie point, and
with the direction in which the camera sees it gives its range. Terrain departs from the slope the more the farther it
is carried; by how much is measured on the ranges themselves.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .navigation import Poses

Array = NDArray[Any]
Indices = NDArray[np.intp]

_REACH = 0.06  # slope, from a tie point to the nearest sounding: 18 cm at 3 m
_NEIGHBOURS = 12
_WIDEST = 1.5  # reaches within which a tie point has its neighbours, for the seabed's slope to be known there
_STEEPEST = 3.0
_SOUNDING_SIGMA_M = 0.001
FIRST_ROUGHNESS = 0.12
_ROUGHNESS = 0.01, 0.5
_NEAREST = 3


class Ranges(NamedTuple):
    """Distances from cameras to tie points, by their laser.

    Attributes
    ----------
    image, track : (K,) camera and tie point. range_m : (K,) between them.
    away_m : (K,) from the tie point to the nearest sounding. slope : (K, 2) of the seabed there, east and north.
    """

    image: Indices
    track: Indices
    range_m: Array
    away_m: Array
    slope: Array

    def take(self, keep: NDArray[Any]) -> "Ranges":
        """Those that a mask or an index array selects."""
        return Ranges(*(column[keep] for column in self))


def slopes(X: Array, tree: KDTree) -> tuple[Array, Array]:
    """The seabed at points X (N, 3), more than 12 and in a tree of their x and y, by the plane of their neighbours.

    Its rise to the east and north (N, 2), and how far the farthest of these neighbours is (N,).
    """
    distance, nearest = (np.asarray(found) for found in tree.query(X[:, :2], k=_NEIGHBOURS, workers=-1))
    around = X[nearest] - X[nearest].mean(1, keepdims=True)
    xy, z = around[:, :, :2], around[:, :, 2]
    normal = np.einsum("nki,nkj->nij", xy, xy)
    # as if one more neighbour stood level at the same distance: few in a row do not tell the slope across it
    normal += np.eye(2) * np.trace(normal, axis1=1, axis2=2)[:, None, None] / (2 * _NEIGHBOURS) + 1e-12 * np.eye(2)
    found = np.linalg.solve(normal, np.einsum("nki,nk->ni", xy, z)[..., None])[..., 0]
    return np.clip(found, -_STEEPEST, _STEEPEST), distance[:, -1]


def measure(poses: Poses, X: Array, soundings: Mapping[int, Array], most: int) -> Ranges:
    """Ranges to tie points X (N, 3), local, from the soundings (L, 3) of images in their camera frames.

    most : ranges of an image; those to the tie points nearest to its soundings are taken. Where tie points are few and
        far between, nothing tells how the seabed runs from them to the laser, and there are no ranges.
    """
    found = [(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0), np.zeros(0), np.zeros((0, 2)))]
    if len(X) > _NEIGHBOURS:
        tree = KDTree(X[:, :2])
        slope, width = slopes(X, tree)
        for k, own in soundings.items():
            if len(own) and np.isfinite(poses.C_local[k]).all():
                track, range_m, away_m = _of_image(poses, k, own, X, slope, tree, most, width)
                found.append((np.full(len(track), k, np.intp), track, range_m, away_m, slope[track]))
    return Ranges(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _of_image(poses: Poses, k: int, own: Array, X: Array, slope: Array, tree: KDTree, most: int, width: Array):
    """Tie points (K,) of known slope near the laser of image k, their ranges and how far each is from a sounding."""
    R, C = poses.R_local_camera[k], poses.C_local[k]
    ground = own @ R.T + C
    centre = ground[:, :2].mean(0)
    reach = _REACH * float(np.median(own[:, 2]))
    radius = np.linalg.norm(ground[:, :2] - centre, axis=1).max() + reach
    near = np.array(tree.query_ball_point(centre, radius, return_sorted=True), np.intp)
    near = near[width[near] < _WIDEST * reach]
    seen = (X[near] - C) @ R
    near, seen = near[seen[:, 2] > 0], seen[seen[:, 2] > 0]
    lit, count = KDTree(own[:, :2] / own[:, 2:]), min(_NEAREST, len(own))
    distance, which = lit.query(seen[:, :2] / seen[:, 2:], k=count, distance_upper_bound=_REACH)
    distance, which = np.reshape(distance, (len(near), count)), np.reshape(which, (len(near), count))
    order = np.argsort(distance[:, -1], kind="stable")[:most]
    order = order[np.isfinite(distance[order, -1])]
    track, beside = near[order], ground[which[order]]
    step = X[track][:, None, :2] - beside[..., :2]
    # half of the way with the slope at either end, so that curved ground is followed, too
    at_sounding = slope[tree.query(beside[..., :2])[1]]
    height = np.median(beside[..., 2] + 0.5 * (step * (slope[track][:, None] + at_sounding)).sum(-1), axis=1)
    direction = X[track] - C
    range_m = np.linalg.norm(direction, axis=1) * (height - C[2]) / direction[:, 2]
    return track, range_m, np.linalg.norm(step, axis=2).min(1, initial=np.inf)


def sigma(away_m: Array, roughness: float) -> Array:
    """1-sigma (K,) of ranges, metres."""
    return np.hypot(_SOUNDING_SIGMA_M, roughness * away_m)


def roughness(poses: Poses, X: Array, ranges: Ranges) -> float:
    """By how much terrain departs from the slope, metres a metre, from what is left of the ranges."""
    if len(ranges.track) < 3 * _NEIGHBOURS:
        return FIRST_ROUGHNESS
    left = np.linalg.norm(X[ranges.track] - poses.C_local[ranges.image], axis=1) - ranges.range_m
    share = 1.4826 * np.median(np.abs(left) / np.hypot(ranges.away_m, 0.01))
    return float(np.clip(share, *_ROUGHNESS))
