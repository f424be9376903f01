"""The length of a camera's motion by the laser (paper III.E): depths it measured over depths triangulated."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[Any]

_RADIUS = 0.03  # slope within which a sounding tells a feature's depth: 9 cm at 3 m
_LEAST_FEATURES = 5


class Scale(NamedTuple):
    """What the laser says of a motion's length: the factor, its relative sigma, and the votes' relative spread."""

    scale: float
    sigma: float
    spread: float


def laser_scale(views: list[tuple[Array, Array, Array]]) -> Scale:
    """Scale of a motion from (slopes (N, 2), depths (N,), soundings (L, 3)) of each image.

    The paper takes the one feature nearest to a laser point; here every feature within a small angle of soundings
    votes with the logarithm of the depth ratio, and the weighted median decides. All nan where there are too few.
    """
    logs, weights = [np.zeros(0)], [np.zeros(0)]
    for x, depth, soundings in views:
        if len(soundings) and len(x):
            slopes = soundings[:, :2] / soundings[:, 2:]
            distance, nearest = KDTree(slopes).query(x, k=min(4, len(slopes)), distance_upper_bound=_RADIUS)
            distance, nearest = distance.reshape(len(x), -1), nearest.reshape(len(x), -1)
            near = np.isfinite(distance[:, -1]) & (depth > 0)
            laser_depth = np.median(soundings[nearest[near], 2], axis=1)
            logs.append(np.log(laser_depth / depth[near]))
            weights.append(1 / (0.005**2 + (0.3 * distance[near, 0]) ** 2))
    ratio, weight = np.concatenate(logs), np.concatenate(weights)
    if len(ratio) < _LEAST_FEATURES:
        return Scale(float("nan"), float("nan"), float("nan"))
    median = _weighted_median(ratio, weight)
    spread = 1.4826 * _weighted_median(np.abs(ratio - median), weight)
    effective = weight.sum() ** 2 / (weight**2).sum()
    sigma = max(spread, 0.002) * 1.2533 / np.sqrt(effective) + 5e-4
    return Scale(float(np.exp(median)), float(sigma), spread)


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
