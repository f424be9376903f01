"""More matches of two images whose motion is known: the ratio test has no say where geometry tells the place.

Around the matches that agree on the motion the seabed has a known depth, so each feature's place in the other image
is known to some pixels; of the few features there, the most similar one on the epipolar line is its match.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .epipolar import depths, sampson
from .features import Features, unit_root
from .motion import Motion

Array = NDArray[Any]

_NEIGHBOURS = 5
_REACH_PX = 12.0  # of the place that the depth around predicts: 1 % of the range at half a base
_EPIPOLAR_PX = 2.0
_CANDIDATES = 8
_RATIO = 0.9
_ALIKE_SHARE = 0.05  # of the matches known to be right, this share may be less alike than a guided one


def match(
    a: Features, b: Features, x_a: Array, x_b: Array, known: NDArray[np.intp], found: Motion, focal_px: float
) -> NDArray[np.intp]:
    """Matches (M, 2), numbers of the features in either image, mutual and on the epipolar lines of a motion.

    There may be fewer of them than were known, as these have wrong ones among them that lie on their lines by chance;
    those known where there are next to none.

    Parameters
    ----------
    x_a, x_b : (N, 2) slopes of all features. known : (K, 2) matches that agree with the motion.
    """
    right = known[_in_front(x_a, x_b, known, found)]
    if len(right) < _NEIGHBOURS:
        return known
    depth = depths(x_a[right[:, 0]], x_b[right[:, 1]], found.R_i_j, found.t_i_j)[0]
    reach = _REACH_PX / focal_px
    seen = np.flatnonzero(_may_be_seen(x_a, x_b, (depth.min(), depth.max()), found, reach))
    place = _predicted(x_a[seen], x_a[right[:, 0]], depth, found)
    distance, candidate = KDTree(x_b).query(place, k=_CANDIDATES, distance_upper_bound=reach)
    rows, columns = np.nonzero(np.isfinite(distance))
    rows, candidate = seen[rows], np.asarray(candidate)[rows, columns]
    on_line = np.abs(sampson(x_a[rows], x_b[candidate], found.R_i_j, found.t_i_j)) * focal_px < _EPIPOLAR_PX
    rows, candidate = rows[on_line], candidate[on_line]
    root_a, root_b = unit_root(a.descriptors), unit_root(b.descriptors)
    alike = np.einsum("nk,nk->n", root_a[rows], root_b[candidate])
    of_known = np.einsum("nk,nk->n", root_a[known[:, 0]], root_b[known[:, 1]])
    enough = alike > np.quantile(of_known, _ALIKE_SHARE)
    rows, candidate, alike = rows[enough], candidate[enough], alike[enough]
    best_of_a, best_of_b = _distinct(rows, alike), _distinct(candidate, alike)
    chosen = best_of_a & best_of_b
    led = np.column_stack([rows[chosen], candidate[chosen]])
    return led if len(led) >= _NEIGHBOURS else known


def _in_front(x_a: Array, x_b: Array, known: NDArray[np.intp], found: Motion) -> NDArray[np.bool_]:
    depth_a, depth_b = depths(x_a[known[:, 0]], x_b[known[:, 1]], found.R_i_j, found.t_i_j)
    return np.asarray((depth_a > 0) & (depth_b > 0))


def _may_be_seen(x: Array, x_b: Array, depths_m: tuple[float, float], found: Motion, reach: float) -> NDArray[np.bool_]:
    """Which features x (N, 2) of image a may lie where image b has some, x_b (M, 2), between two depths."""
    low, high = x_b.min(0) - reach, x_b.max(0) + reach
    places = np.stack([_moved(x, np.full(len(x), Z), found) for Z in depths_m])
    return ((places.min(0) < high) & (places.max(0) > low)).all(1)


def _predicted(x: Array, x_a: Array, depth: Array, found: Motion) -> Array:
    """Slopes (N, 2) in image b of features x (N, 2) of image a, as deep as the nearest matches x_a (K, 2) are."""
    nearest = np.asarray(KDTree(x_a).query(x, k=_NEIGHBOURS)[1])
    return _moved(x, np.median(depth[nearest], axis=1), found)


def _moved(x: Array, Z: Array, found: Motion) -> Array:
    """Slopes (N, 2) in image b of places x (N, 2) of image a at depths Z (N,)."""
    X_b = (np.column_stack([x, np.ones(len(x))]) * Z[:, None] - found.t_i_j) @ found.R_i_j
    return X_b[:, :2] / np.where(X_b[:, 2:] > 0, X_b[:, 2:], 1e-3)  # behind: far out of the image


def _distinct(owner: NDArray[np.intp], alike: Array) -> NDArray[np.bool_]:
    """Which candidates (M,) are their owner's most similar, and clearly more so than its next."""
    order = np.lexsort((-alike, owner))
    first = np.ones(len(order), bool)
    first[1:] = owner[order][1:] != owner[order][:-1]
    second = np.zeros(len(order), bool)
    second[1:] = first[:-1] & ~first[1:]
    ok = first.copy()
    at = np.flatnonzero(second)
    better, worse = 1 - alike[order[at - 1]], 1 - alike[order[at]]
    ok[at - 1] = better < _RATIO**2 * worse
    chosen = np.zeros(len(owner), bool)
    chosen[order[ok]] = True
    return chosen
