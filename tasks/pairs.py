"""Which images are worth matching: those whose footprints overlap, by what is known of the poses so far."""

from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .camera import outline, project, rays
from .navigation import Poses

Array = NDArray[Any]

# base over height: a shorter one says little of depth, and on a longer one steep ground looks too different
_SHORTEST_BASE, _GOOD_BASE, _LONGEST_BASE = 0.05, 0.25, 0.7
_LEAST_OVERLAP = 0.15
_NEAREST = 4  # times as many pairs as are wanted of an image: where there are more, the nearest are looked at


class Pairs(NamedTuple):
    """Pairs of images, i < j.

    Attributes
    ----------
    images : (P, 2) int.
    overlap : (P,) share of the smaller footprint that both see.
    """

    images: NDArray[np.intp]
    overlap: Array


def footprints(camera: Camera, poses: Poses, range_m: Array, points_per_side: int = 3) -> Array:
    """Outline (n, M, 2) of each image on a level seabed, local metres.

    range_m (n,) is the height of each camera above that seabed. Rays are kept from rising above 80 degrees off the
    vertical, so that a wild attitude gives a large footprint and not an infinite one.
    """
    border = rays(camera, outline(camera, points_per_side)).direction
    direction = np.einsum("nij,mj->nmi", poses.R_local_camera, border)
    down = np.maximum(-direction[..., 2], np.cos(np.radians(80)))
    return poses.C_local[:, None, :2] + direction[..., :2] / down[..., None] * range_m[:, None, None]


def overlapping(outlines: Array, margin_m: Array, min_overlap: float, max_per_image: int) -> Pairs:
    """Pairs whose footprints (n, M, 2), each grown by margin_m (n,) for what its pose may be wrong, overlap enough.

    Of each image the `max_per_image` largest overlaps with earlier images, and as many with later ones, are kept.
    Rows of NaN (no pose) pair with nothing.
    """
    known = np.flatnonzero(np.isfinite(outlines).all((1, 2)))
    hulls = shapely.convex_hull(shapely.linestrings(outlines[known]))
    grown = np.asarray(shapely.buffer(hulls, margin_m[known], quad_segs=2))
    left, right = shapely.STRtree(grown).query(grown, predicate="intersects")
    left, right = left[left < right], right[left < right]
    if len(left) > _NEAREST * max_per_image * len(grown):  # a vehicle that stays in its place: all see the same
        centre = shapely.get_coordinates(shapely.centroid(grown))
        away = np.linalg.norm(centre[left] - centre[right], axis=1)
        left, right = _largest_of_each(np.column_stack([left, right]), -away, _NEAREST * max_per_image).images.T
    shared = shapely.area(shapely.intersection(grown[left], grown[right]))
    overlap = shared / np.minimum(shapely.area(grown[left]), shapely.area(grown[right]))
    pairs = np.column_stack([known[left], known[right]])
    enough = overlap >= min_overlap
    return _largest_of_each(pairs[enough], overlap[enough], max_per_image)


def for_depth(outlines: Array, images: NDArray[np.intp], base_to_height: Array, max_per_image: int) -> Pairs:
    """Of pairs (P, 2), those that tell most of the depth: large overlaps on a base that is neither short nor long.

    base_to_height : (P,) distance of the two cameras over their height. Of each image the `max_per_image` best are
    kept; `overlap` of the result is what they were chosen by.
    """
    rows, number = np.unique(images, return_inverse=True)  # others may have no pose
    hulls = np.asarray(shapely.convex_hull(shapely.linestrings(outlines[rows])))
    one, other = hulls[number.reshape(-1, 2)].T
    overlap = shapely.area(shapely.intersection(one, other)) / np.minimum(shapely.area(one), shapely.area(other))
    wide = np.clip(base_to_height / _GOOD_BASE, 0, 1)
    good = (overlap > _LEAST_OVERLAP) & (base_to_height > _SHORTEST_BASE) & (base_to_height < _LONGEST_BASE)
    return _largest_of_each(images[good], (overlap * wide)[good], max_per_image)


def _largest_of_each(pairs: NDArray[np.intp], overlap: Array, count: int) -> Pairs:
    """Keep a pair when it is among the `count` largest overlaps of i with later images, or of j with earlier ones."""
    keep = np.zeros(len(pairs), bool)
    for side in (0, 1):
        order = np.lexsort((-overlap, pairs[:, side]))
        image = pairs[order, side]
        starts = np.searchsorted(image, image)
        keep[order[np.arange(len(order)) - starts < count]] = True
    order = np.lexsort((pairs[keep, 1], pairs[keep, 0]))
    return Pairs(pairs[keep][order], overlap[keep][order])


def sequential(count: int, reach: int) -> Pairs:
    """Each image with the next `reach`: all that can be said before anything is known of the poses."""
    i, step = np.meshgrid(np.arange(count), np.arange(1, reach + 1), indexing="ij")
    inside = (i + step) < count
    pairs = np.column_stack([i[inside], (i + step)[inside]])
    return Pairs(pairs.astype(np.intp), np.ones(len(pairs)))


def expected(camera: Camera, uv: Array, poses: Poses, source: int, target: int, range_m: float) -> Array:
    """Pixels (N, 2) at which image `target` sees what image `source` sees at pixels (N, 2).

    By the poses known so far, on a level seabed range_m below the source.
    """
    direction = rays(camera, uv).direction @ poses.R_local_camera[source].T
    down = np.maximum(-direction[:, 2:], np.cos(np.radians(80)))
    ground = poses.C_local[source] + direction / down * range_m
    return project(camera, (ground - poses.C_local[target]) @ poses.R_local_camera[target])


def inside(camera: Camera, uv: Array, margin_px: float) -> NDArray[np.bool_]:
    """Which pixels (N, 2) lie in the image, or not more than a margin beside it."""
    size = np.array([camera.width, camera.height])
    return np.asarray(((uv > -margin_px) & (uv < size + margin_px)).all(1))
