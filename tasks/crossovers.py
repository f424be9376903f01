"""Where laser lines of different images cross: both measured the same ground, so there they are at one height.

Each line is reduced to nodes, the means of short pieces of it. At a crossing the two lines span the seabed's plane, and
only the distance of the lines along its normal counts: on level ground that tells height and tilt, on a slope also how
the images lie beside each other. What is carried to a crossing is as sure as the seabed is smooth there; by how much
all of them err together with calibration is measured on their own scatter.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .calibration_crossovers import crossings
from .calibration_field import Points
from .factors import linear, plane_rows
from .navigation import Poses

Array = NDArray[Any]
Indices = NDArray[np.intp]

_PIECE = 0.006  # length of a piece along the columns, slope: 2 cm at 3 m
_LEAST_SOUNDINGS = 3
_LONGEST_PIECES = 3.0  # nodes farther apart than so many pieces have a gap between them
_NODE_SIGMA_M = 0.0005
_FIRST_FACTOR, _FACTOR = 10.0, (1.0, 30.0)  # of the sigmas that nodes state, before and after it is measured
_GATE = 5.0  # sigmas
_SLOPE_SIGMAS = 2.0  # a slope less sure than this is none
_STEEPEST = 2.0
_MAD_TO_SIGMA = 1.4826
_AGREED = 0.8  # share of an image's crossings
LEAST_OF_IMAGE = 3  # crossings that hold an image: height, roll and pitch


class Lines(NamedTuple):
    """Nodes of all laser lines, sorted by image, arm and row.

    Attributes
    ----------
    image, arm : (P,). X_camera : (P, 3) metres. sigma_m : (P,) by the scatter of the soundings around the node.
    longest_m : distance of neighbouring nodes beyond which the line is broken.
    """

    image: Indices
    arm: Indices
    X_camera: Array
    sigma_m: Array
    longest_m: float


class Crossovers(NamedTuple):
    """Crossings of lines of images i and j.

    Attributes
    ----------
    i, j : (K,) images, i < j.
    a, b : (K, 3) the crossing in the frames of cameras i and j. normal : (K, 3) of the seabed, local axes.
    apart_m : (K,) how far line j lies above line i along it. sigma_m : (K,) its 1-sigma.
    """

    i: Indices
    j: Indices
    a: Array
    b: Array
    normal: Array
    apart_m: Array
    sigma_m: Array

    def take(self, keep: NDArray[Any]) -> "Crossovers":
        """Those that a mask or an index array selects."""
        return Crossovers(*(column[keep] for column in self))


def lines(soundings: Mapping[int, tuple[Array, Array]]) -> Lines:
    """The lines of the images with a laser: soundings (L, 3), camera frame, and the arm (L,) of each."""
    parts = [(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros(0))]
    parts += [_nodes(k, *own) for k, own in sorted(soundings.items()) if len(own[0])]
    image, arm, X, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    length = _PIECE * np.sqrt(2.0) * float(np.median(X[:, 2])) if len(X) else 0.0
    return Lines(image, arm, X, sigma, _LONGEST_PIECES * length)


def _nodes(image: int, X: Array, arm: Array) -> tuple[Indices, Indices, Array, Array]:
    """Pieces (N,) of an image's two lines: image, arm, mean and 1-sigma."""
    X = np.asarray(X, float)
    row = X[:, 1] / X[:, 2]
    order = np.lexsort((row, arm))
    X, arm, row = X[order], np.asarray(arm)[order].astype(np.intp), row[order]
    piece = np.floor(row / _PIECE).astype(np.int64)
    _, first, count = np.unique(arm * (1 << 40) + piece, return_index=True, return_counts=True)
    mean = np.add.reduceat(X, first) / count[:, None]
    own = np.repeat(np.arange(len(first)), count)
    along, up = row - (np.add.reduceat(row, first) / count)[own], X[:, 2] - mean[own, 2]
    slope = np.add.reduceat(along * up, first) / np.maximum(np.add.reduceat(along**2, first), 1e-12)
    left = np.add.reduceat((up - slope[own] * along) ** 2, first) / np.maximum(count - 2, 1)
    keep = count >= _LEAST_SOUNDINGS
    sigma = np.hypot(_NODE_SIGMA_M, np.sqrt(left / count))
    return np.full(keep.sum(), image, np.intp), arm[first][keep], mean[keep], sigma[keep]


def find(poses: Poses, made: Lines) -> Crossovers:
    """Where the lines cross with the poses as they are; sigma is what the nodes around a crossing say."""
    known = poses.known[made.image]
    image, arm, X_camera, node_sigma = made.image[known], made.arm[known], made.X_camera[known], made.sigma_m[known]
    X = np.einsum("pij,pj->pi", poses.R_local_camera[image], X_camera) + poses.C_local[image]
    found = crossings(Points(X[:, :2], image, arm.astype(np.int8), node_sigma), X, made.longest_m)
    p, q, f, g = found
    other = image[p[:, 0]] != image[q[:, 0]]
    p, q, f, g = p[other], q[other], f[other], g[other]
    swap = image[p[:, 0]] > image[q[:, 0]]
    p, q = np.where(swap[:, None], q, p), np.where(swap[:, None], p, q)
    f, g = np.where(swap, g, f), np.where(swap, f, g)

    def at(ends: Indices, share: Array, values: Array) -> Array:
        share = share[:, None] if values.ndim > 1 else share
        return (1 - share) * values[ends[:, 0]] + share * values[ends[:, 1]]

    sigma = np.hypot(at(p, f, node_sigma), at(q, g, node_sigma))
    line = image * 2 + arm
    slope, doubt = _gradient(_tangent(X, line, p), _tangent(X, line, q), sigma)
    crossed = Crossovers(
        i=image[p[:, 0]],
        j=image[q[:, 0]],
        a=at(p, f, X_camera),
        b=at(q, g, X_camera),
        normal=normals(slope, doubt),
        apart_m=np.zeros(len(sigma)),
        sigma_m=sigma,
    )
    return apart(poses, crossed)


def _tangent(X: Array, line: Indices, ends: Indices) -> Array:
    """Vectors (K, 3) along the lines around the segments `ends` (K, 2), a node farther to either side if there is."""
    before, after = np.maximum(ends[:, 0] - 1, 0), np.minimum(ends[:, 1] + 1, len(X) - 1)
    before = np.where(line[before] == line[ends[:, 0]], before, ends[:, 0])
    after = np.where(line[after] == line[ends[:, 1]], after, ends[:, 1])
    return X[after] - X[before]


def _gradient(u: Array, v: Array, sigma_m: Array) -> tuple[Array, Array]:
    """Rise (K, 2) to the east and north of the plane through directions u and v (K, 3), and its 1-sigma (K,)."""
    determinant = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    east = (u[:, 2] * v[:, 1] - v[:, 2] * u[:, 1]) / determinant
    north = (u[:, 0] * v[:, 2] - v[:, 0] * u[:, 2]) / determinant
    size = np.linalg.norm(u[:, :2], axis=1) * np.linalg.norm(v[:, :2], axis=1) / np.abs(determinant)
    shorter = np.minimum(np.linalg.norm(u[:, :2], axis=1), np.linalg.norm(v[:, :2], axis=1))
    return np.column_stack([east, north]), size * sigma_m / shorter


def normals(slope: Array, sigma: Array) -> Array:
    """Upward normals (K, 3) of planes that rise by slope (K, 2) to the east and north, known to sigma (K,).

    What noise alone gives is taken off the slopes: else level ground would seem to hold images sideways.
    """
    square = (slope**2).sum(1)
    sure = np.sqrt(np.maximum(0.0, 1 - (_SLOPE_SIGMAS * sigma) ** 2 / np.maximum(square, 1e-12)))
    sure /= np.maximum(1.0, np.sqrt(square) / _STEEPEST)
    up = np.column_stack([-slope * sure[:, None], np.ones(len(slope))])
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def apart(poses: Poses, found: Crossovers) -> Crossovers:
    """The same crossings with how far the lines are apart by these poses."""
    X_i, X_j = (
        np.einsum("kij,kj->ki", poses.R_local_camera[k], X) + poses.C_local[k]
        for k, X in ((found.i, found.a), (found.j, found.b))
    )
    return found._replace(apart_m=((X_j - X_i) * found.normal).sum(1))


def believable(found: Crossovers, unknowns: int) -> Crossovers:
    """Crossovers with the sigma that their scatter says, without those that no surface can explain.

    unknowns : of the adjustment that left them; 0 before the first one.
    """
    if not len(found.i):
        return found
    ratio = np.abs(found.apart_m) / found.sigma_m
    freedom = np.sqrt(max(0.3, 1 - unknowns / len(ratio)))
    factor = float(np.clip(_MAD_TO_SIGMA * np.median(ratio) / freedom, *_FACTOR))
    if not unknowns:
        factor = max(factor, _FIRST_FACTOR)
    return found.take(ratio < _GATE * factor)._replace(sigma_m=factor * found.sigma_m[ratio < _GATE * factor])


def add(graph: Any, values: Any, poses: Poses, found: Crossovers, threshold: float) -> None:
    """Add factors to a graph, one for each pair of images: at their crossings both are on one surface.

    values : hold the poses. threshold : of Cauchy's kernel, sigmas.
    """
    off = found.apart_m / found.sigma_m
    weight = 1 / np.sqrt(1 + (off / threshold) ** 2) / found.sigma_m
    A_i = -plane_rows(poses.R_local_camera[found.i], found.a, found.normal) * weight[:, None]
    A_j = plane_rows(poses.R_local_camera[found.j], found.b, found.normal) * weight[:, None]
    b = -found.apart_m * weight
    order = np.lexsort((found.j, found.i))
    pair = np.column_stack([found.i, found.j])[order]
    for own in np.split(order, np.flatnonzero(np.any(np.diff(pair, axis=0), axis=1)) + 1) if len(order) else []:
        i, j = int(found.i[own[0]]), int(found.j[own[0]])
        graph.add(linear(values, {i: A_i[own], j: A_j[own]}, b[own]))


def holds(every: Crossovers, kept: Crossovers, count: int) -> NDArray[np.bool_]:
    """Which of `count` images crossings hold: enough for height, roll and pitch, and nearly all of them believable.

    every, kept : before and after `believable`. Where an image is in a wrong place some of its crossings still agree.
    """
    found, agreed = (
        np.bincount(some.i, minlength=count) + np.bincount(some.j, minlength=count) for some in (every, kept)
    )
    return (agreed >= LEAST_OF_IMAGE) & (agreed >= _AGREED * found)
