"""What the adjustment left: of each image, of each pair of images, and which images hold together at all."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .crossovers import Crossovers
from .tracks import Sights

Array = NDArray[Any]
Indices = NDArray[np.intp]


class Residuals(NamedTuple):
    """Root mean squares of an adjustment of n images.

    Attributes
    ----------
    image_px : (n,) distance of an image's tie points from where it sees them; NaN without any.
    sighted : (P, 2) images with tie points in common. shared : (P,) how many. pair_px : (P,) as image_px, of these.
    crossed : (Q, 2) images whose laser lines cross. crossings : (Q,) how often. apart_m : (Q,) distance of the lines.
    """

    image_px: Array
    sighted: Indices
    shared: Indices
    pair_px: Array
    crossed: Indices
    crossings: Indices
    apart_m: Array


def of(count: int, sights: Sights, residual_px: Array, found: Crossovers) -> Residuals:
    """Residuals (M, 2) of sights and of crossovers, by image and by pair."""
    square = (residual_px**2).sum(1)
    with np.errstate(invalid="ignore"):
        image = np.sqrt(np.bincount(sights.image, square, count) / np.bincount(sights.image, minlength=count))
    keys, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    for step in range(1, int(np.bincount(sights.track).max(initial=0))):
        same = np.flatnonzero(sights.track[step:] == sights.track[:-step])
        keys.append(sights.image[same].astype(np.int64) * count + sights.image[same + step])
        values.append((square[same] + square[same + step]) / 2)
    sighted, shared, pair_px = _rms(np.concatenate(keys), np.concatenate(values), count)
    crossed, crossings, apart = _rms(found.i.astype(np.int64) * count + found.j, found.apart_m**2, count)
    return Residuals(image, sighted, shared, pair_px, crossed, crossings, apart)


def _rms(key: NDArray[np.int64], square: Array, count: int) -> tuple[Indices, Indices, Array]:
    """Pairs (P, 2), how many values each has, and the root of their mean."""
    pair, own, number = np.unique(key, return_inverse=True, return_counts=True)
    return np.column_stack(np.divmod(pair, count)), number, np.sqrt(np.bincount(own, square, len(pair)) / number)


def blocks(count: int, links: Indices) -> Indices:
    """Number (n,) of the block that each image belongs to: what the pairs `links` (P, 2) hold together."""
    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.intp)
