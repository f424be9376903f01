"""Tie points: features matched from image to image, joined to tracks."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Array = NDArray[Any]
Indices = NDArray[np.intp]


class Sights(NamedTuple):
    """What images see of tie points; sorted by track, then image.

    Attributes
    ----------
    image : (M,) row of the frames table. track : (M,) number of the tie point, 0 .. tie_points - 1.
    uv : (M, 2) pixels.
    """

    image: Indices
    track: Indices
    uv: Array

    @property
    def tie_points(self) -> int:
        """How many tie points."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def kept(self, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which sights (M,) `take` leaves: of those that a mask selects, the ones of tie points that two images see."""
        seen = np.bincount(self.track[keep], minlength=self.tie_points)
        return keep & (seen[self.track] > 1)

    def take(self, keep: NDArray[np.bool_]) -> "Sights":
        """The sights that a mask (M,) selects, of tie points that two images still see, numbered anew."""
        kept = self.kept(keep)
        return Sights(self.image[kept], np.unique(self.track[kept], return_inverse=True)[1], self.uv[kept])


class PairMatches(NamedTuple):
    """Matches of images i and j: numbers (N, 2) of the features in either image, and their pixels (N, 2)."""

    i: int
    j: int
    features: Indices
    uv_i: Array
    uv_j: Array


def join(matches: list[PairMatches]) -> Sights:
    """Tracks of features that are matched with each other, through however many images.

    A track that holds two features of one image has a wrong match in it and is left out.
    """
    if not matches:
        return Sights(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2)))
    sides = [(m.i, m.features[:, 0], m.uv_i) for m in matches] + [(m.j, m.features[:, 1], m.uv_j) for m in matches]
    image = np.concatenate([np.full(len(number), row) for row, number, _ in sides]).astype(np.int64)
    number = np.concatenate([number for _, number, _ in sides]).astype(np.int64)
    uv = np.concatenate([uv for _, _, uv in sides]).astype(float)
    _, first, node = np.unique(image << 32 | number, return_index=True, return_inverse=True)
    half = len(node) // 2
    graph = coo_array((np.ones(half, bool), (node[:half], node[half:])), shape=(len(first),) * 2)
    track = connected_components(graph, directed=False)[1]
    image, uv = image[first], uv[first]
    order = np.lexsort((image, track))
    image, track, uv = image[order], track[order], uv[order]
    twice = (np.diff(track) == 0) & (np.diff(image) == 0)
    torn = np.zeros(int(track[-1]) + 1, bool)
    torn[track[1:][twice]] = True
    return Sights(image, track, uv).take(~torn[track])


def thin(sights: Sights, shape: tuple[int, int], cells: int, most: int) -> Sights:
    """Tracks enough to hold every image: of each cell of each image the longest tracks.

    Parameters
    ----------
    shape : height and width of the images, pixels.
    cells : along the longer side of an image.
    most : tracks that a cell of an image asks for.
    """
    if not sights.tie_points:
        return sights
    length = np.bincount(sights.track)
    side = max(shape) / cells
    column, row = (np.clip(sights.uv // side, 0, cells - 1).astype(np.int64)).T
    place = (sights.image.astype(np.int64) * cells + row) * cells + column
    order = np.lexsort((sights.track, -length[sights.track], place))
    ranked = place[order]
    rank = np.arange(len(order)) - np.searchsorted(ranked, ranked)
    wanted = np.zeros(sights.tie_points, bool)
    wanted[sights.track[order[rank < most]]] = True
    return sights.take(wanted[sights.track])
