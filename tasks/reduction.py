"""Tie points eliminated from a bundle adjustment: what is left to solve has the poses only (Schur complement).

A survey has a hundred times more tie points than images, and each touches a few images only. So their rows are
linearised and folded into the poses' normal equations by array operations; GTSAM solves these with the factors of
navigation. All increments of poses are GTSAM's: R exp(w), C + R v.
"""

from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from .factors import read_poses
from .laser_ranges import Ranges
from .navigation import Poses
from .tracks import Sights

Array = NDArray[Any]
Indices = NDArray[np.intp]

_FIRST_DAMPING, _MOST_DAMPING = 1e-5, 1e5
_ITERATIONS = 100
_NEAREST_M = 1e-3  # a point at the camera or behind it is taken to be here, which no solution can be


class Observations(NamedTuple):
    """Sights and ranges of tie points.

    Attributes
    ----------
    sights : (M,) of them. x : (M, 2) slopes. sigma : of a slope.
    ranges : (K,) of them. sigma_m : (K,).
    threshold : sigmas, of Cauchy's kernel.
    contact : what joins a camera and a tie point; `contacts` (B,) says which of the M + K rows are of which.
    """

    sights: Sights
    x: Array
    sigma: float
    ranges: Ranges
    sigma_m: Array
    threshold: float
    contact: "Contacts"


class Contacts(NamedTuple):
    """The Q pairs of a camera and a tie point that have rows, sorted by tie point, then camera.

    Attributes
    ----------
    image, track : (Q,). of_row : (M + K,) contact of each sight and range.
    pairs : (P, 2) cameras i < j with tie points in common. first, second : contacts of the same tie point with
        either camera of a pair, all pairs one after the other. ends : (P,) where those of each end.
    """

    image: Indices
    track: Indices
    of_row: Indices
    pairs: Indices
    first: Indices
    second: Indices
    ends: Indices


def observations(
    sights: Sights, x: Array, sigma: float, ranges: Ranges, sigma_m: Array, threshold: float
) -> Observations:
    """Observations with what joins what worked out once."""
    image, track = np.concatenate([sights.image, ranges.image]), np.concatenate([sights.track, ranges.track])
    count = int(image.max()) + 1
    code, of_row = np.unique(track * count + image, return_inverse=True)
    image, track = code % count, code // count
    found = []
    for step in range(1, int(np.bincount(track).max())):
        first = np.flatnonzero(track[step:] == track[:-step])
        found.append((first, first + step))
    first, second = (np.concatenate(c) for c in zip(*found, strict=True)) if found else (image[:0], image[:0])
    pair = image[first] * count + image[second]
    order = np.argsort(pair, kind="stable")
    codes, starts = np.unique(pair[order], return_index=True)
    contacts = Contacts(
        image,
        track,
        of_row,
        np.column_stack([codes // count, codes % count]),
        first[order],
        second[order],
        np.append(starts[1:], len(order)),
    )
    return Observations(sights, x, sigma, ranges, sigma_m, threshold, contacts)


class Blocks(NamedTuple):
    """Normal equations of poses and tie points.

    Attributes
    ----------
    U : (n, 6, 6) of poses. V : (N, 3, 3) of tie points. W : (Q, 6, 3) of contacts.
    g_pose : (n, 6), g_point : (N, 3) right-hand sides.
    """

    U: Array
    V: Array
    W: Array
    g_pose: Array
    g_point: Array


def error(o: Observations, poses: Poses, X: Array) -> float:
    """Half the robust sum of squares, as GTSAM counts it."""
    left = np.concatenate([_sights_left(o, poses, X)[0], _ranges_left(o, poses, X)[0]])
    squared = (left**2).sum(1) / o.threshold**2
    return 0.5 * o.threshold**2 * float(np.log1p(squared).sum())


def _seen(poses: Poses, X: Array, image: Indices, track: Indices) -> Array:
    return np.einsum("mji,mj->mi", poses.R_local_camera[image], X[track] - poses.C_local[image])


def _sights_left(o: Observations, poses: Poses, X: Array) -> tuple[Array, Array]:
    """What is left of the sights (M, 2), in sigmas, and the points in the cameras' frames (M, 3)."""
    seen = _seen(poses, X, o.sights.image, o.sights.track)
    seen[:, 2] = np.maximum(seen[:, 2], _NEAREST_M)
    return (seen[:, :2] / seen[:, 2:] - o.x) / o.sigma, seen


def _ranges_left(o: Observations, poses: Poses, X: Array) -> tuple[Array, Array]:
    """What is left of the ranges (K, 2), in sigmas, its second column 0, and directions in the cameras' frames."""
    seen = _seen(poses, X, o.ranges.image, o.ranges.track)
    distance = np.maximum(np.linalg.norm(seen, axis=1), _NEAREST_M)
    left = (distance - o.ranges.range_m) / o.sigma_m
    return np.column_stack([left, np.zeros(len(left))]), seen / distance[:, None]


def linearised(o: Observations, poses: Poses, X: Array) -> Blocks:
    """The normal equations about poses and tie points X (N, 3)."""
    sights_left, seen = _sights_left(o, poses, X)
    ranges_left, direction = _ranges_left(o, poses, X)
    split = len(sights_left)
    left = np.concatenate([sights_left, ranges_left])
    by_seen = np.zeros((len(left), 2, 3))  # derivatives by the point in the camera's frame
    by_seen[:split, 0, 0] = by_seen[:split, 1, 1] = 1 / (seen[:, 2] * o.sigma)
    by_seen[:split, :, 2] = -seen[:, :2] / (seen[:, 2:] ** 2 * o.sigma)
    by_seen[split:, 0] = direction / o.sigma_m[:, None]
    weight = 1 / np.sqrt(1 + (left**2).sum(1) / o.threshold**2)
    by_seen *= weight[:, None, None]
    left = left * weight[:, None]
    image, track = (np.concatenate([getattr(o.sights, c), getattr(o.ranges, c)]) for c in ("image", "track"))
    at = np.concatenate([seen, direction])  # turning the camera does not change a range
    by_pose = np.empty((len(left), 2, 6))
    by_pose[..., :3] = np.cross(by_seen, at[:, None, :])
    by_pose[..., 3:] = -by_seen
    by_point = by_seen @ poses.R_local_camera[image].transpose(0, 2, 1)
    return Blocks(
        _summed(by_pose.transpose(0, 2, 1) @ by_pose, image, len(poses.C_local)),
        _summed(by_point.transpose(0, 2, 1) @ by_point, track, len(X)),
        _summed(by_pose.transpose(0, 2, 1) @ by_point, o.contact.of_row, len(o.contact.image)),
        -_summed(np.einsum("mrk,mr->mk", by_pose, left), image, len(poses.C_local)),
        -_summed(np.einsum("mrk,mr->mk", by_point, left), track, len(X)),
    )


def _summed(values: Array, group: Indices, count: int) -> Array:
    """Sums of values (M, ...) by their group."""
    order = np.argsort(group, kind="stable")
    present, starts = np.unique(group[order], return_index=True)
    found = np.zeros((count, *values.shape[1:]))
    if len(order):
        found[present] = np.add.reduceat(values[order], starts)
    return found


class Reduced(NamedTuple):
    """The poses' equations as a GTSAM graph, and what gives the tie points back."""

    graph: Any
    V_inverse: Array
    blocks: Blocks


def reduced(o: Observations, blocks: Blocks, damping: float) -> Reduced:
    """Tie points eliminated; all diagonals grow by a share `damping` first (Levenberg & Marquardt)."""
    contact = o.contact
    U, V = (_damped(values, damping) for values in (blocks.U, blocks.V))
    V_inverse = np.linalg.inv(V)
    K = np.linalg.cholesky((V_inverse + V_inverse.transpose(0, 2, 1)) / 2)
    Y = (blocks.W @ K[contact.track]).transpose(0, 2, 1).copy()  # (Q, 3, 6): V^-1 = K K'
    diagonal = U - _summed(Y.transpose(0, 2, 1) @ Y, contact.image, len(U))
    right = np.einsum("qab,qb->qa", blocks.W, np.einsum("nab,nb->na", V_inverse, blocks.g_point)[contact.track])
    g = blocks.g_pose - _summed(right, contact.image, len(U))
    graph = gtsam.GaussianFactorGraph()
    for k in np.flatnonzero(np.einsum("nii->n", blocks.U) > 0).tolist():
        graph.add(gtsam.HessianFactor(k, diagonal[k], g[k], 0.0))
    start, nothing, zero = 0, np.zeros((6, 6)), np.zeros(6)
    for (i, j), end in zip(contact.pairs.tolist(), contact.ends.tolist(), strict=True):
        first, second = Y[contact.first[start:end]], Y[contact.second[start:end]]
        across = -first.reshape(-1, 6).T @ second.reshape(-1, 6)
        graph.add(gtsam.HessianFactor(i, j, nothing, across, zero, nothing, zero, 0.0))
        start = end
    return Reduced(graph, V_inverse, blocks)


def _damped(values: Array, damping: float) -> Array:
    found = values.copy()
    at = np.arange(values.shape[1])
    found[:, at, at] *= 1 + damping
    return found


def moved(o: Observations, made: Reduced, X: Array, step: Array) -> Array:
    """The tie points X (N, 3) after the poses made their step (n, 6)."""
    pulled = np.einsum("qab,qa->qb", made.blocks.W, step[o.contact.image])
    right = made.blocks.g_point - _summed(pulled, o.contact.track, len(X))
    return X + np.einsum("nab,nb->na", made.V_inverse, right)


class State(NamedTuple):
    """Where an adjustment is: GTSAM's values of all poses, the cameras among them, and tie points X (N, 3)."""

    values: Any
    poses: Poses
    X: Array


def solve(fixed: Any, start: State, o: Observations, tolerance: float) -> State:
    """The state in which the error of some factors of poses and of the observations is least.

    Levenberg & Marquardt.

    Parameters
    ----------
    fixed : GTSAM graph of what holds poses besides. tolerance : relative decrease of the error that ends it.

    Raises
    ------
    RuntimeError
        There is something that nothing holds.
    """
    state, damping, ordering = start, _FIRST_DAMPING, None
    before = fixed.error(state.values) + error(o, state.poses, state.X)
    for _ in range(_ITERATIONS):
        blocks, held = linearised(o, state.poses, state.X), fixed.linearize(state.values)
        after = np.inf
        while damping < _MOST_DAMPING:
            made = reduced(o, blocks, damping)
            made.graph.push_back(held)
            ordering = ordering or elimination_order(made.graph)
            trial = _stepped(o, state, made, made.graph.optimize(ordering))
            after = fixed.error(trial.values) + error(o, trial.poses, trial.X)
            if after <= before:
                break
            damping *= 10
        if not after <= before:
            return state
        gain, before, state, damping = before - after, after, trial, damping / 10
        if gain <= tolerance * before:
            return state
    return state


def elimination_order(graph: Any) -> Any:
    """By nested dissection, which a survey's wide and flat net of images asks for."""
    return gtsam.Ordering.MetisGaussianFactorGraph(graph)


def _stepped(o: Observations, state: State, made: Reduced, delta: Any) -> State:
    step = np.zeros((len(state.poses.C_local), 6))
    for k in np.flatnonzero(state.poses.known).tolist():
        if delta.exists(k):
            step[k] = delta.at(k)
    values = state.values.retract(delta)
    return State(values, read_poses(values, state.poses), moved(o, made, state.X, step))
