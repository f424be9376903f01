"""Finds the crossovers of a survey: where lines of light, matches and the altimeter measure the same ground."""

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .calibration_field import Beside, Crossings, Feet, Matches, Points

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_LONGEST_SEGMENT_M = 0.08
_FLATTEST = 0.3  # sine of the least angle at which lines cross
_BESIDE_SLOPE = 0.02
_FOOT_M = 0.05
_MOST_BESIDE_A_PAIR = 20


def crossings(points: Points, X_local: Array, longest_m: float = _LONGEST_SEGMENT_M) -> Crossings:
    """Crossings, seen from above, of lines of light; of different images, or of both arms of one.

    Parameters
    ----------
    points : by image, arm and row. X_local : (P, 3) metres.
    longest_m : distance of neighbouring points beyond which the line is broken.
    """
    first = np.flatnonzero((np.diff(points.image) == 0) & (np.diff(points.arm) == 0))
    length = np.linalg.norm(X_local[first + 1, :2] - X_local[first, :2], axis=1)
    first = first[np.isfinite(length) & (length < longest_m) & (length > 0)]
    ends = np.stack([X_local[first, :2], X_local[first + 1, :2]], axis=1)
    segments = np.asarray(shapely.linestrings(ends))
    a, b = shapely.STRtree(segments).query(segments, predicate="intersects")
    line = points.image * 2 + points.arm
    keep = (a < b) & (line[first[a]] != line[first[b]])
    a, b = a[keep], b[keep]
    u, v = ends[a, 1] - ends[a, 0], ends[b, 1] - ends[b, 0]
    w = ends[b, 0] - ends[a, 0]
    cross = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    steep = np.abs(cross) > _FLATTEST * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    a, b, u, v, w, cross = (part[steep] for part in (a, b, u, v, w, cross))
    f = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / cross
    g = (w[:, 0] * u[:, 1] - w[:, 1] * u[:, 0]) / cross
    two = np.array([0, 1])
    return Crossings(first[a][:, None] + two, first[b][:, None] + two, f, g)


def beside_lines(points: Points, matches: Matches, slopes: Array, slopes_i: Array, slopes_j: Array) -> Beside:
    """Matches whose image in i or j lies next to a laser point of that image.

    Parameters
    ----------
    slopes : (P, 2) x/z, y/z of the laser points. slopes_i, slopes_j : (M, 2) of the matches.
    """
    parts = []
    for side, (image, x) in enumerate(((matches.i, slopes_i), (matches.j, slopes_j))):
        for k in np.unique(image):
            own, lit = np.flatnonzero(image == k), np.flatnonzero(points.image == k)
            if not len(lit):
                continue
            apart, nearest = KDTree(slopes[lit]).query(x[own], distance_upper_bound=_BESIDE_SLOPE)
            near = np.isfinite(apart)
            parts.append(
                (own[near], np.full(near.sum(), side), lit[np.asarray(nearest)[near]], np.asarray(apart)[near])
            )
    if not parts:
        none = np.zeros(0, np.intp)
        return Beside(none, none, none, np.zeros(0))
    match, side, point, apart = (np.concatenate(field) for field in zip(*parts, strict=True))
    return Beside(match.astype(np.intp), side.astype(np.intp), point.astype(np.intp), apart)


def feet(X_local: Array, of: Indices | None, reference: Array, image: Indices, from_reference: Array) -> Feet:
    """Altimeter readings that fall next to something measured, seen from above.

    Parameters
    ----------
    X_local : (P, 3) laser points or matches, metres, NaN where unknown.
    of : (P, 2) images that see each; a reading takes only what its own image sees. None: whatever image sees it.
    reference : (n, 3) reference points of the images, local, metres.
    image : (S,) image nearest in time to each reading. from_reference : (S, 3) its foot from that image's reference.
    """
    foot, known = reference[image] + from_reference, np.isfinite(X_local).all(1)
    spot, apart = np.zeros(len(foot), np.intp), np.full(len(foot), np.inf)
    if of is None:
        groups = [(np.ones(len(foot), bool), known)]
    else:
        groups = [(image == k, known & (of == k).any(1)) for k in np.unique(image)]
    for own, seen in groups:
        if own.any() and seen.any():
            apart[own], nearest = KDTree(X_local[seen, :2]).query(foot[own, :2], distance_upper_bound=_FOOT_M)
            spot[own] = np.append(np.flatnonzero(seen), 0)[nearest]
    near = np.isfinite(apart)
    return Feet(image[near], from_reference[near], spot[near], apart[near])


def thinned(matches: Matches, beside: Beside, under: Feet, most: int) -> Indices:
    """Indices of the matches to keep: those under the altimeter, and of each pair up to twenty of those beside a line
    and `most` others."""
    near = np.zeros(len(matches.i), bool)
    near[beside.match] = True
    key = matches.i * (int(matches.j.max(initial=0)) + 1) + matches.j
    kept = []
    rng = np.random.default_rng(0)
    for pair in np.unique(key):
        own = np.flatnonzero(key == pair)
        kept += [rng.permutation(own[near[own]])[:_MOST_BESIDE_A_PAIR], rng.permutation(own[~near[own]])[:most]]
    return np.unique(np.concatenate([*kept, under.spot])) if kept else np.zeros(0, np.intp)
