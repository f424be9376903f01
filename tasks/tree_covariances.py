"""Covariances of all poses at once, from the tree of cliques into which GTSAM eliminates their equations.

GTSAM's own marginals walk from the root to each pose anew. One walk does for all: what the poses of a clique have in
common with those of its parent is known by the time the clique is reached.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

Array = NDArray[Any]
Indices = NDArray[np.intp]

_POSE = 6


class Covariances(NamedTuple):
    """Of n poses: own (n, 6, 6), and with the pose that was eliminated last (n, 6, 6); NaN of those not in the tree."""

    own: Array
    with_last: Array


def covariances(tree: Any, count: int, last: int) -> Covariances:
    """Covariances of poses 0 to `count` - 1.

    Parameters
    ----------
    tree : GTSAM's GaussianBayesTree, all of whose variables have six dimensions. last : the one eliminated last.
    """
    found = Covariances(*(np.full((count, _POSE, _POSE), np.nan) for _ in range(2)))
    waiting = [(root, np.zeros(0, np.intp), np.zeros((0, 0)), np.zeros((0, _POSE))) for root in tree.roots()]
    while waiting:
        clique, above, joint, across = waiting.pop()
        conditional = clique.conditional()
        keys, R = np.array(conditional.keys(), np.intp), conditional.R()
        size = len(R) // _POSE
        own = keys[:size]
        rows = _rows(above, keys[size:])
        R_inverse = dtrtri(R)[0]
        G = R_inverse @ conditional.S()
        joint = _joint(R_inverse, G, joint[np.ix_(rows, rows)])
        if last in own:
            across = joint[:, _rows(keys, np.array([last]))]
        else:
            across = np.concatenate([-G @ across[rows], across[rows]])
        at = np.flatnonzero(own < count)
        found.own[own[at]] = joint[: len(R), : len(R)].reshape(size, _POSE, size, _POSE)[at, :, at]
        found.with_last[own[at]] = across[: len(R)].reshape(size, _POSE, _POSE)[at]
        waiting += [(clique[k], keys, joint, across) for k in range(clique.nrChildren())]
    return found


def _rows(keys: Indices, wanted: Indices) -> Indices:
    """Rows of wanted poses where those of `keys` stand one after the other."""
    order = np.argsort(keys, kind="stable")
    place = order[np.searchsorted(keys, wanted, sorter=order)] if len(wanted) else wanted
    return (place[:, None] * _POSE + np.arange(_POSE)).ravel()


def _joint(R_inverse: Array, G: Array, above: Array) -> Array:
    """Covariance of a clique whose own are R_inverse e - G x with x of covariance `above`."""
    shared = G @ above
    return np.block([[R_inverse @ R_inverse.T + shared @ G.T, -shared], [-shared.T, above]])
