"""Tie points: features matched from image to image, joined to tracks."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Array = NDArray[Any]
Indices = NDArray[np.signedinteger[Any]]


_LONGEST = 40  # sights of a track


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
        track = self.track[kept]
        left = np.zeros(self.tie_points, bool)
        left[track] = True
        return Sights(self.image[kept], (np.cumsum(left) - 1)[track], self.uv[kept])


class PairMatches(NamedTuple):
    """Matches of images i and j: numbers (N, 2) of the features in either image, and their pixels (N, 2)."""

    i: int
    j: int
    features: Indices
    uv_i: Array
    uv_j: Array


def join(matches: list[PairMatches]) -> Sights:
    """Tracks of features that are matched with each other, through however many images; in single precision.

    A track that holds two features of one image has a wrong match in it and is left out.
    """
    if not any(len(m.features) for m in matches):
        return Sights(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2), np.float32))
    # a number for every feature that an image may have: all matches of a mission are many, and sorting them is dear
    each = 1 + max(int(m.features.max(initial=0)) for m in matches)
    count = each * (1 + max(m.j for m in matches))
    number = np.int32 if count < 2**31 else np.int64

    def nodes(side: int) -> NDArray[Any]:
        rows = [(m.i, m.j)[side] for m in matches]
        parts = zip(matches, rows, strict=True)
        return np.concatenate([m.features[:, side].astype(number) + row * each for m, row in parts])

    i, j = nodes(0), nodes(1)
    graph = coo_array((np.ones(len(i), bool), (i, j)), shape=(count, count))
    track = connected_components(graph, directed=False)[1]
    del graph
    uv = np.zeros((count, 2), np.float32)
    for node, side in ((i, "uv_i"), (j, "uv_j")):
        uv[node] = np.concatenate([getattr(m, side) for m in matches])
    seen = np.zeros(count, bool)
    seen[i] = seen[j] = True
    node = np.flatnonzero(seen).astype(number)
    node = node[np.argsort(track[node], kind="stable")]
    image, track, uv = node // each, track[node], uv[node]
    twice = (np.diff(track) == 0) & (np.diff(image) == 0)
    torn = np.zeros(int(track[-1]) + 1, bool)
    torn[track[1:][twice]] = True
    return Sights(image, track, uv).take(~torn[track])


def _shortened(sights: Sights) -> Sights:
    """No track longer than it takes: where a vehicle stays in its place, some of the sights, evenly, tell as much."""
    length, first = np.bincount(sights.track), np.searchsorted(sights.track, np.arange(sights.tie_points))
    place, own = np.arange(len(sights.track)) - first[sights.track], np.maximum(length[sights.track], _LONGEST)
    return sights.take((place * _LONGEST) // own != ((place - 1) * _LONGEST) // own)


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
    sights = _shortened(sights)
    length = np.bincount(sights.track)
    side = max(shape) / cells
    column, row = (np.clip(sights.uv // side, 0, cells - 1).astype(np.int64)).T
    place = (sights.image.astype(np.int64) * cells + row) * cells + column
    order = np.lexsort((sights.track, -length[sights.track], place))
    ranked = place[order]
    rank = np.arange(len(order)) - np.searchsorted(ranked, ranked)
    wanted = np.zeros(sights.tie_points, bool)
    wanted[sights.track[order[rank < most]]] = True
    image, track, uv = sights.take(wanted[sights.track])
    return Sights(image.astype(np.intp), track.astype(np.intp), uv.astype(float))
