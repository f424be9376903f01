"""Tie points eliminated from a bundle adjustment: what is left to solve has the poses only (Schur complement).

A survey has a hundred times more tie points than images, and each touches a few images only. So their rows are
linearised and folded into the poses' normal equations by array operations; GTSAM solves these with the factors of
navigation. All increments of poses are GTSAM's: R exp(w), C + R v.
"""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import tree_covariances
from .factors import elimination_order, read_poses
from .laser_ranges import Ranges
from .navigation import Poses
from .tracks import Sights

Array = NDArray[Any]
Indices = NDArray[np.intp]

_FIRST_DAMPING, _MOST_DAMPING, _HARDER = 1e-5, 1e10, 100.0
_ITERATIONS = 100
_ROWS_AT_ONCE = 4096
_ANCHOR = 1e5  # information of the place of one camera, 1 / m^2: 3 mm
_NOTHING_LEFT = 1e-9  # share of the anchor's covariance: as much as to be held to 100 m
_NEAREST_M = 1e-3  # a point at the camera or behind it is taken to be here, which no solution can be


class Observations(NamedTuple):
    """Sights and ranges of tie points as M rows, sorted by tie point, then camera.

    Attributes
    ----------
    image, track : (M,). is_range : (M,) bool. value : (M, 2) slopes, or the range, metres, and 0. sigma : (M,) of it.
    normal : (M, 3) camera frame: along it the range is taken, where it is not 0; else along the line of sight.
    threshold : sigmas, of Cauchy's kernel.
    tracks, contacts : groups of rows of one tie point, of one tie point in one camera.
    pairs : (P, 2) cameras i < j with tie points in common. first, second : contacts of the same tie point with
        either camera of a pair, all pairs one after the other. ends : (P,) where those of each end.
    """

    image: Indices
    track: Indices
    is_range: NDArray[np.bool_]
    value: Array
    sigma: Array
    normal: Array
    threshold: float
    tracks: "Groups"
    contacts: "Groups"
    pairs: Indices
    first: Indices
    second: Indices
    ends: Indices


class Groups(NamedTuple):
    """Runs of equal numbers: the number of each run, and where it starts."""

    number: Indices
    start: Indices


def observations(
    sights: Sights, x: Array, sigma: float, ranges: Ranges, sigma_m: Array, normal: Array, threshold: float
) -> Observations:
    """Rows of sights with slopes x (M, 2) and of ranges with their sigmas (K,) and normals (K, 3); what joins what."""
    image, track = np.concatenate([sights.image, ranges.image]), np.concatenate([sights.track, ranges.track])
    order = np.lexsort((image, track))
    image, track = image[order], track[order]
    count = int(image.max(initial=0)) + 1
    contacts, tracks = _groups(track * count + image), _groups(track)
    pairs, first, second, ends = _pairs(contacts.number % count, contacts.number // count)
    value = np.concatenate([x, np.column_stack([ranges.range_m, np.zeros(len(sigma_m))])])
    return Observations(
        image=image,
        track=track,
        is_range=order >= len(x),
        value=value[order],
        sigma=np.concatenate([np.full(len(x), sigma), sigma_m])[order],
        normal=np.concatenate([np.zeros((len(x), 3)), normal])[order],
        threshold=threshold,
        tracks=tracks,
        contacts=contacts,
        pairs=pairs,
        first=first,
        second=second,
        ends=ends,
    )


def _groups(numbers: Indices) -> Groups:
    start = np.flatnonzero(np.diff(numbers, prepend=-1))
    return Groups(numbers[start], start)


def _pairs(image: Indices, track: Indices) -> tuple[Indices, Indices, Indices, Indices]:
    """Pairs of cameras and their contacts, as `Observations` has them, from the camera and point of each contact."""
    found, count = [], int(image.max(initial=0)) + 1
    for step in range(1, int(np.bincount(track, minlength=1).max())):
        first = np.flatnonzero(track[step:] == track[:-step])
        found.append((first, first + step))
    first, second = (np.concatenate(c) for c in zip(*found, strict=True)) if found else (image[:0], image[:0])
    code = image[first] * count + image[second]
    order = np.argsort(code, kind="stable")
    pairs = _groups(code[order])
    both = np.column_stack([pairs.number // count, pairs.number % count])
    return both, first[order], second[order], np.append(pairs.start, len(order))[1:]


class Blocks(NamedTuple):
    """Normal equations of poses and tie points.

    Attributes
    ----------
    U : (n, 6, 6) of poses. V : (N, 3, 3) of tie points. W : (Q, 3, 6) of contacts, tie point by pose.
    g_pose : (n, 6), g_point : (N, 3) right-hand sides.
    """

    U: Array
    V: Array
    W: Array
    g_pose: Array
    g_point: Array


def error(o: Observations, poses: Poses, X: Array) -> float:
    """Half the robust sum of squares, as GTSAM counts it."""
    total = 0.0
    for part in _parts(o):
        squared = (_left(part.o, _seen(part.o, poses, X)) ** 2).sum(1)
        total += float(np.log1p(squared / o.threshold**2).sum())
    return 0.5 * o.threshold**2 * total


class _Part(NamedTuple):
    """Some whole tie points: their rows as observations, their numbers, their contacts, and where these start."""

    o: Observations
    number: Indices
    track_starts: Indices
    contacts: slice
    contact_starts: Indices


def _parts(o: Observations) -> Iterator[_Part]:
    """All observations, so few at a time that what is worked on stays small, and in the processor's cache."""
    tracks, contacts = o.tracks, o.contacts
    first = 0
    while first < len(tracks.start):
        last = max(first + 1, int(np.searchsorted(tracks.start, tracks.start[first] + _ROWS_AT_ONCE, "right")) - 1)
        begin = int(tracks.start[first])
        end = int(tracks.start[last]) if last < len(tracks.start) else len(o.track)
        low, high = np.searchsorted(contacts.start, [begin, end]).tolist()
        own = slice(begin, end)
        names = "image", "track", "is_range", "value", "sigma", "normal"
        yield _Part(
            o._replace(**{name: getattr(o, name)[own] for name in names}),
            tracks.number[first:last],
            tracks.start[first:last] - begin,
            slice(low, high),
            contacts.start[low:high] - begin,
        )
        first = last


def _seen(o: Observations, poses: Poses, X: Array) -> Array:
    """The tie points (M, 3) in the cameras' frames."""
    off = X[o.track] - poses.C_local[o.image]
    seen = np.einsum("mji,mj->mi", poses.R_local_camera[o.image], off)
    seen[:, 2] = np.maximum(seen[:, 2], _NEAREST_M)
    return seen


def _left(o: Observations, seen: Array) -> Array:
    """What is left of the rows (M, 2), in sigmas."""
    found = seen[:, :2] / seen[:, 2:]
    found[o.is_range, 0], found[o.is_range, 1] = (seen * _toward(o, seen))[o.is_range].sum(1), 0.0
    return (found - o.value) / o.sigma[:, None]


def _toward(o: Observations, seen: Array) -> Array:
    """Directions (M, 3), camera frames, along which ranges are taken."""
    own = (o.normal != 0).any(1, keepdims=True)
    return np.where(own, o.normal, seen / np.linalg.norm(seen, axis=1, keepdims=True))


def linearised(o: Observations, poses: Poses, X: Array) -> Blocks:
    """The normal equations about poses and tie points X (N, 3)."""
    count = len(poses.C_local)
    made = Blocks(
        U=np.zeros((count, 6, 6)),
        V=np.zeros((len(X), 3, 3)),
        W=np.empty((len(o.contacts.start), 3, 6)),
        g_pose=np.zeros((count, 6)),
        g_point=np.zeros((len(X), 3)),
    )
    for part in _parts(o):
        _add(made, part, poses, X)
    return made


def _add(made: Blocks, part: _Part, poses: Poses, X: Array) -> None:
    o = part.o
    seen = _seen(o, poses, X)
    left = _left(o, seen)
    weight = 1 / np.sqrt(1 + (left**2).sum(1) / o.threshold**2)
    by_seen = _by_seen(o, seen) * (weight / o.sigma)[:, None, None]
    left *= weight[:, None]
    by_pose = np.concatenate([np.cross(by_seen, seen[:, None, :]), -by_seen], axis=2)
    by_point = by_seen @ poses.R_local_camera[o.image].transpose(0, 2, 1)
    made.V[part.number] = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_point, part.track_starts)
    made.g_point[part.number] = -np.add.reduceat(np.einsum("mrk,mr->mk", by_point, left), part.track_starts)
    made.W[part.contacts] = np.add.reduceat(by_point.transpose(0, 2, 1) @ by_pose, part.contact_starts)
    order = np.argsort(o.image, kind="stable")
    images, A = _groups(o.image[order]), by_pose[order]
    made.U[images.number] += np.add.reduceat(A.transpose(0, 2, 1) @ A, images.start)
    made.g_pose[images.number] -= np.add.reduceat(np.einsum("mrk,mr->mk", A, left[order]), images.start)


def _by_seen(o: Observations, seen: Array) -> Array:
    """Derivatives (M, 2, 3) of the values by the point in the camera's frame."""
    found = np.zeros((len(seen), 2, 3))
    found[:, 0, 0] = found[:, 1, 1] = 1 / seen[:, 2]
    found[:, :, 2] = -seen[:, :2] / seen[:, 2:] ** 2
    found[o.is_range] = 0.0
    found[o.is_range, 0] = _toward(o, seen)[o.is_range]
    return found


class Reduced(NamedTuple):
    """The poses' equations as a GTSAM graph, and what gives the tie points back.

    Attributes
    ----------
    K : (N, 3, 3) with V^-1 = K K'. right : (N, 3) K' g_point. Y : (Q, 3, 6) K' W of the contacts.
    """

    graph: Any
    K: Array
    right: Array
    Y: Array


def reduced(o: Observations, blocks: Blocks, damping: float) -> Reduced:
    """Tie points eliminated; all diagonals grow by `damping` first (Levenberg). The blocks' W is written over."""
    image, track = o.image[o.contacts.start], o.track[o.contacts.start]
    U, V = (_damped(values, damping) for values in (blocks.U, blocks.V))
    V_inverse = np.linalg.inv(V)
    K = np.linalg.cholesky((V_inverse + V_inverse.transpose(0, 2, 1)) / 2)
    right, Y = np.einsum("nji,nj->ni", K, blocks.g_point), blocks.W
    for start in range(0, len(Y), _ROWS_AT_ONCE):
        own = slice(start, start + _ROWS_AT_ONCE)
        Y[own] = K[track[own]].transpose(0, 2, 1) @ Y[own]
    graph, order = gtsam.GaussianFactorGraph(), np.argsort(image, kind="stable")
    own = _groups(image[order])
    ends = np.append(own.start, len(order))[1:]
    for k, start, end in zip(own.number.tolist(), own.start.tolist(), ends.tolist(), strict=True):
        contacts = order[start:end]
        A, b = Y[contacts].reshape(-1, 6), right[track[contacts]].ravel()
        graph.add(gtsam.HessianFactor(k, U[k] - A.T @ A, blocks.g_pose[k] - A.T @ b, 0.0))
    start, nothing, zero = 0, np.zeros((6, 6)), np.zeros(6)
    for (i, j), end in zip(o.pairs.tolist(), o.ends.tolist(), strict=True):
        first, second = (Y[side[start:end]].reshape(-1, 6) for side in (o.first, o.second))
        graph.add(gtsam.HessianFactor(i, j, nothing, -first.T @ second, zero, nothing, zero, 0.0))
        start = end
    return Reduced(graph, K, right, Y)


def _damped(values: Array, damping: float) -> Array:
    found = values.copy()
    at = np.arange(values.shape[1])
    found[:, at, at] += damping
    return found


def moved(o: Observations, made: Reduced, X: Array, step: Array) -> Array:
    """The tie points X (N, 3) after the poses made their step (n, 6)."""
    left, image = made.right.copy(), o.image[o.contacts.start]
    starts = np.searchsorted(o.contacts.start, o.tracks.start)
    left[o.tracks.number] -= np.add.reduceat(np.einsum("qab,qb->qa", made.Y, step[image]), starts)
    return X + np.einsum("nab,nb->na", made.K, left)


class State(NamedTuple):
    """Where an adjustment is: GTSAM's values of all poses, the cameras among them, and tie points X (N, 3)."""

    values: Any
    poses: Poses
    X: Array


def solve(fixed: Any, start: State, o: Observations, tolerance: float, afloat: bool) -> State:
    """The state in which the error of some factors of poses and of the observations is least.

    Levenberg's way: damping is the same in all directions, for a share of the diagonal, which the tie points make
    large, would keep the map from moving as a whole.

    Parameters
    ----------
    fixed : GTSAM graph of what holds poses besides. tolerance : relative decrease of the error that ends it.
    afloat : whether the map as a whole is held to decimetres only. It is left where the start has it, which nothing
        but navigation has a say in: see `covariances`.
    """
    state, damping, ordering = start, _FIRST_DAMPING, None
    before = fixed.error(state.values) + error(o, state.poses, state.X)
    for _ in range(_ITERATIONS):
        held, trial, after = fixed.linearize(state.values), state, np.inf
        while not after <= before:
            if damping > _MOST_DAMPING:
                return state
            with suppress(RuntimeError):  # too weakly held for Cholesky's way: damping helps
                trial, ordering = _tried(o, held, state, damping, _ANCHOR if afloat else 0.0, ordering)
                after = fixed.error(trial.values) + error(o, trial.poses, trial.X)
            damping *= 1 if after <= before else _HARDER
        gain, before, state, damping = before - after, after, trial, damping / _HARDER
        if gain <= tolerance * before:
            return state
    return state


def _tried(o: Observations, held: Any, state: State, damping: float, anchor: float, ordering: Any) -> tuple[State, Any]:
    """The state after one step, and the order of elimination, found if none is given."""
    made = reduced(o, linearised(o, state.poses, state.X), damping)
    made.graph.push_back(held)
    made.graph.add(_anchor(state.poses, anchor))
    ordering = ordering or elimination_order(made.graph)
    return _stepped(o, state, made, made.graph.optimize(ordering)), ordering


def _middle(poses: Poses) -> int:
    """The camera in the middle of those that have a pose."""
    known = np.flatnonzero(poses.known)
    return int(known[len(known) // 2])


def _anchor(poses: Poses, information: float) -> Any:
    """A factor that holds one camera where it is."""
    weight = np.diag([0.0, 0.0, 0.0, *[information] * 3])
    return gtsam.HessianFactor(_middle(poses), weight, np.zeros(6), 0.0)


def covariances(fixed: Any, state: State, o: Observations) -> Array:
    """Covariances (n, 6, 6) of the poses; NaN of those that have none.

    That a map may move as a whole by decimetres, but its parts by tenths of millimetres, is too much for GTSAM's
    Cholesky factors, and its QR needs several times the memory. So one camera is held as if it were known to
    millimetres, and what that takes off the covariances is given back (matrix inversion lemma).

    Raises
    ------
    RuntimeError
        There is something that nothing holds.
    """
    graph = reduced(o, linearised(o, state.poses, state.X), 0.0).graph
    graph.push_back(fixed.linearize(state.values))
    middle = _middle(state.poses)
    order = elimination_order(graph)
    keys = [order.at(k) for k in range(order.size())]
    graph.add(_anchor(state.poses, _ANCHOR))
    tree = graph.eliminateMultifrontal(gtsam.Ordering([*(key for key in keys if key != middle), middle]))
    found, with_anchor = tree_covariances.covariances(tree, len(state.poses.C_local), middle)
    left = np.eye(3) / _ANCHOR - found[middle, 3:, 3:]
    if np.linalg.eigvalsh(left)[0] < _NOTHING_LEFT / _ANCHOR:
        raise RuntimeError("nothing but the anchor holds the map")
    across = with_anchor[:, :, 3:]
    return found + across @ np.linalg.inv(left) @ across.transpose(0, 2, 1)


def _stepped(o: Observations, state: State, made: Reduced, delta: Any) -> State:
    step = np.zeros((len(state.poses.C_local), 6))
    for k in np.flatnonzero(state.poses.known).tolist():
        if delta.exists(k):
            step[k] = delta.at(k)
    values = state.values.retract(delta)
    return State(values, read_poses(values, state.poses), moved(o, made, state.X, step))
