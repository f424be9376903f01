"""Which image is shown where in a mosaic's tile, before any image's colours are read.

Images are given a cost at each place: metres from the place to the image's optical axis, more on ground seen at an
angle, at the image's rim, beside the erased laser and beside what terrain hides (so that seams there are soft too and
keep away from edges), and very much more where the laser was erased or terrain hides the place, so that such pixels
serve only where no other image sees it. The lowest cost wins; within some centimetres of a seam images are blended by
exp(-cost / feather). This is done on nodes, and pixel by pixel only in blocks where more than one image counts.

What differs between neighbouring images over decimetres (light that was not quite removed) is spread over a much
wider seam, by their thumbnails: the two bands of Burt and Adelson 1983.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .grids import Grid
from .nodes import (
    BEST,
    BLOCK,
    ERASED,
    ERASED_M,
    OUTSIDE,
    Ground,
    Lie,
    Seen,
    Shot,
    quality_cost,
    quality_scale,
    sample,
    see,
    small_at,
    upsample,
)

Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Tone = Callable[[Array32, Array32, Array32], tuple[Array32, Array32]]

FEATHER_M: Final = 0.02
WEIGHTS: Final = 255  # of all images at a place together
_REACH_FEATHERS: Final = 6.3  # what costs so much more than another has less than half a 255th, and does not count
_WIDE_FEATHERS: Final = 8  # of the seam between thumbnails
_MOST_EVENED: Final = 1.5
_DARKEST: Final = 1e-4
_WHOLE: Final = slice(0, BLOCK), slice(0, BLOCK)


class Patch(NamedTuple):
    """An image in a block.

    Attributes
    ----------
    row, column : of the block in the tile.
    part : rows and columns of the block's pixels in which it counts, whole steps of nodes.
    weight : of the part, uint8, of 255; None where the image is alone.
    painted : whether pixels are needed that the laser lights.
    """

    row: int
    column: int
    part: tuple[slice, slice]
    weight: Pixels | None
    painted: bool


class Laid(NamedTuple):
    """An image in a tile: what it sees, where it counts, and what its light is multiplied with, less what (at nodes).

    gain and veil are None for colours as they were taken.
    """

    shot: Shot
    seen: Seen
    patches: list[Patch]
    gain: Array32 | None
    veil: Array32 | None


class Plan(NamedTuple):
    """A tile before its colours.

    source (rows, columns of its blocks) int32 is -1 where nothing is seen; painted where only laser light shows the
    place.
    """

    tile: Grid
    place: Ground
    laid: tuple[Laid, ...]
    source: NDArray[np.int32]
    painted: Mask


def plan(
    tile: Grid,
    place: Ground,
    shots: Sequence[tuple[Shot, Lie]],
    tone: Tone | None = None,
    feather_m: float = FEATHER_M,
) -> Plan:
    """Which image is shown where, from shots in the order of their numbers.

    tone(u, v, range_m) gives gain and veil (..., 3) at an image's pixels u, v and distance range_m (...): light is
    multiplied with the one, less the other. None: colours as they were taken.
    """
    found = [(shot, see(place, shot, lie, feather_m)) for shot, lie in shots]
    views = [(shot, seen) for shot, seen in found if seen is not None]
    best = _upper_bound(place, views, feather_m)
    source, painted = np.full(place.blocks.shape, -1, np.int32), np.zeros(place.blocks.shape, bool)
    patches: list[list[Patch]] = [[] for _ in views]
    reach = _REACH_FEATHERS * feather_m + place.nodes.cell_m
    for (row, column), rivals in sorted(_rivals(place, views, best, reach).items()):
        at = slice(row * BLOCK, (row + 1) * BLOCK), slice(column * BLOCK, (column + 1) * BLOCK)
        source[at], painted[at] = _share_out(place, views, rivals, (row, column), feather_m, patches)
    tones = _tones(place, views, patches, best, tone, feather_m)
    laid = [
        Laid(shot, seen, parts, *both) for (shot, seen), parts, both in zip(views, patches, tones, strict=True) if parts
    ]
    return Plan(tile, place, tuple(laid), source, painted)


def _part(place: Ground, seen: Seen) -> tuple[slice, slice]:
    """The tile's nodes that an image's arrays are of."""
    row, column = seen.row * BLOCK // place.step, seen.column * BLOCK // place.step
    return slice(row, row + seen.cost.shape[0]), slice(column, column + seen.cost.shape[1])


def _upper_bound(place: Ground, views: Sequence[tuple[Shot, Seen]], feather_m: float) -> Array32:
    """The most that the best image costs around each node."""
    best = np.full(place.nodes.shape, np.inf, np.float32)
    for _, seen in views:
        at = _part(place, seen)
        best[at] = np.fmin(best[at], seen.cost + quality_cost(seen.quality, feather_m))
    return best


def _rivals(
    place: Ground, views: Sequence[tuple[Shot, Seen]], best: Array32, reach_m: float
) -> dict[tuple[int, int], list[int]]:
    """Of each block the images that may count in it."""
    rivals: dict[tuple[int, int], list[int]] = {}
    per_block = BLOCK // place.step
    around = np.ones((3, 3), np.uint8)
    for k, (shot, seen) in enumerate(views):
        with np.errstate(invalid="ignore"):
            counts = (seen.cost < best[_part(place, seen)] + reach_m) & _in_image(place, shot, seen)
        near = np.asarray(cv2.dilate(counts.astype(np.uint8), around))[1:-1, 1:-1]
        rows, columns = near.shape[0] // per_block, near.shape[1] // per_block
        blocks = near.reshape(rows, per_block, columns, per_block).any((1, 3))
        for row, column in np.argwhere(blocks).tolist():
            rivals.setdefault((row + seen.row, column + seen.column), []).append(k)
    return rivals


def _in_image(place: Ground, shot: Shot, seen: Seen) -> Mask:
    """Nodes in the image or next to it."""
    camera = shot.camera
    rim = 2 * place.nodes.cell_m * max(camera.fx, camera.fy) / seen.range_m + quality_scale(camera)
    inside = (seen.u >= -rim) & (seen.u <= camera.width - 1 + rim)
    return inside & (seen.v >= -rim) & (seen.v <= camera.height - 1 + rim)


def block_nodes(place: Ground, seen: Seen, row: int, column: int) -> tuple[slice, slice]:
    """Of an image's arrays those nodes that a block of the tile is interpolated from."""
    size = BLOCK // place.step
    first = (row - seen.row) * size, (column - seen.column) * size
    return slice(first[0], first[0] + size + 2), slice(first[1], first[1] + size + 2)


def _share_out(
    place: Ground,
    views: Sequence[tuple[Shot, Seen]],
    rivals: Sequence[int],
    block: tuple[int, int],
    feather_m: float,
    patches: list[list[Patch]],
) -> tuple[NDArray[np.int32] | int, Mask | bool]:
    """Weights of the images in a block, added to their patches; of each pixel the image and whether it is painted."""
    if len(rivals) == 1 and _clean(place, views[rivals[0]][1], block):
        patches[rivals[0]].append(Patch(*block, _WHOLE, None, False))
        return views[rivals[0]][0].number, False
    costs = [_pixel_cost(place, *views[k], block, feather_m) for k in rivals]
    lowest, first = _lowest(costs)
    seen_at_all = np.isfinite(lowest)
    lowest = np.where(seen_at_all, lowest, np.float32(0))
    no_good = bool((lowest >= ERASED_M).any())
    for k, share, cost in zip(rivals, _shares(costs, lowest, first, seen_at_all, feather_m), costs, strict=True):
        part = _counting(share, place.step)
        if part is not None:
            painted = no_good and bool(((cost >= ERASED_M) & (share > 0)).any())
            patches[k].append(Patch(*block, part, share[part].copy(), painted))
    numbers = np.array([views[k][0].number for k in rivals], np.int32)
    lit = _lit(place, [views[k] for k in rivals], block, first) if no_good else False
    return np.where(seen_at_all, numbers.take(first), np.int32(-1)), lit & seen_at_all


def _lowest(costs: Sequence[Array32]) -> tuple[Array32, NDArray[np.intp]]:
    """The lowest of costs, pixel by pixel, and which of them it is."""
    lowest, first = costs[0], np.zeros(costs[0].shape, np.intp)
    for k, cost in enumerate(costs[1:], 1):
        np.copyto(first, k, where=cost < lowest)
        lowest = np.minimum(lowest, cost)
    return lowest, first


def _shares(
    costs: Sequence[Array32], lowest: Array32, first: NDArray[np.intp], seen_at_all: Mask, feather_m: float
) -> Iterator[Pixels]:
    """Weights of images by their costs, which add up to 255 where any sees the place: what rounding leaves is the
    best image's."""
    weights = [cv2.exp((lowest - cost) * np.float32(1 / feather_m)) for cost in costs]
    scale = np.float32(WEIGHTS) / np.maximum(sum(weights), np.float32(1))
    shares = [(weight * scale).astype(np.uint8) for weight in weights]  # never more than there is
    rest = np.uint8(WEIGHTS) * seen_at_all - sum(shares)
    for k, share in enumerate(shares):
        yield share + rest * (first == k)


def _counting(share: Pixels, step: int) -> tuple[slice, slice] | None:
    """Rows and columns, in whole steps, beyond which an image's share is 0; None where it is so everywhere."""
    left, top, width, height = cv2.boundingRect(share)
    if not width:
        return None
    edges = (top, top + height), (left, left + width)
    rows, columns = (slice(first // step * step, -(-end // step) * step) for first, end in edges)
    return rows, columns


def _clean(place: Ground, seen: Seen, block: tuple[int, int]) -> bool:
    at = block_nodes(place, seen, *block)
    return bool((seen.quality[at] == BEST).all() and np.isfinite(seen.cost[at]).all())


def _pixel_cost(place: Ground, shot: Shot, seen: Seen, block: tuple[int, int], feather_m: float) -> Array32:
    """Cost (128, 128) of an image's pixels in a block, inf outside of it."""
    at = block_nodes(place, seen, *block)
    cost = upsample(seen.cost[at], place.step)
    if not (seen.quality[at] == BEST).all():
        cost = cost + quality_cost(_pixel_quality(place, shot, seen, block, shot.quality), feather_m)
    return np.fmin(cost, np.float32(np.inf))  # NaN is inf


def _pixel_quality(
    place: Ground, shot: Shot, seen: Seen, block: tuple[int, int], quality: Pixels, beyond: int = OUTSIDE
) -> Pixels:
    """Of an image of qualities, or one like it, the values (128, 128) in a block."""
    at, scale = block_nodes(place, seen, *block), quality_scale(shot.camera)
    uv = upsample((seen.uv[at] + np.float32(0.5)) / scale - np.float32(0.5), place.step)
    return np.asarray(sample(quality, uv, beyond), np.uint8)


def _lit(place: Ground, views: Sequence[tuple[Shot, Seen]], block: tuple[int, int], first: NDArray[np.intp]) -> Mask:
    """Pixels of a block that the laser lights in the image, by its place in views, that is shown there."""
    lit = np.zeros(first.shape, bool)
    for k, (shot, seen) in enumerate(views):
        erased = np.asarray(cv2.inRange(shot.quality, np.array(ERASED), np.array(ERASED)), np.uint8)
        lit |= (first == k) & (_pixel_quality(place, shot, seen, block, erased, 0) > 0)
    return lit


def _tones(
    place: Ground,
    views: Sequence[tuple[Shot, Seen]],
    patches: Sequence[Sequence[Patch]],
    best: Array32,
    tone: Tone | None,
    feather_m: float,
) -> list[tuple[Array32 | None, Array32 | None]]:
    """Gain and veil at the nodes of each image that counts, evened out with its neighbours'."""
    if tone is None:
        return [(None, None)] * len(views)
    even, thumbnails = _thumbnails_blended(place, views, best, feather_m)
    result: list[tuple[Array32 | None, Array32 | None]] = []
    for (_, seen), parts, thumbnail in zip(views, patches, thumbnails, strict=True):
        if not parts:
            result.append((None, None))
            continue
        gain, veil = tone(seen.u, seen.v, seen.range_m)
        if thumbnail is not None:
            own = np.maximum(thumbnail, np.float32(_DARKEST))
            ratio = np.clip(even[_part(place, seen)] / own, 1 / _MOST_EVENED, _MOST_EVENED).astype(np.float32)
            gain, veil = gain * ratio, veil * ratio
        result.append((np.nan_to_num(gain), np.nan_to_num(veil)))
    return result


def _thumbnails_blended(
    place: Ground, views: Sequence[tuple[Shot, Seen]], best: Array32, feather_m: float
) -> tuple[Array32, list[Array32 | None]]:
    """Colours (rows, columns, 3) of the thumbnails at the nodes, blended over wide seams; and those of each view."""
    own: list[Array32 | None] = []
    total, weights = np.zeros((*place.nodes.shape, 3), np.float32), np.zeros(place.nodes.shape, np.float32)
    for shot, seen in views:
        own.append(None if shot.thumbnail is None else small_at(shot.thumbnail, shot.camera, seen.u, seen.v))
        if own[-1] is None:
            continue
        at = _part(place, seen)
        with np.errstate(invalid="ignore", over="ignore"):
            weight = np.exp(-np.maximum(seen.cost - best[at], 0) / (_WIDE_FEATHERS * feather_m)) * _from_rim(shot, seen)
        weight = np.nan_to_num(weight).astype(np.float32) + np.float32(1e-12)
        total[at] += own[-1] * weight[..., None]
        weights[at] += weight
    return (total / np.maximum(weights, 1e-12)[..., None]).astype(np.float32), own


def _from_rim(shot: Shot, seen: Seen) -> Array32:
    """0 at the image's rim and outside, 1 a tenth of its size inside."""
    camera = shot.camera
    across = np.minimum(seen.u, camera.width - 1 - seen.u) / (0.1 * camera.width)
    down = np.minimum(seen.v, camera.height - 1 - seen.v) / (0.1 * camera.height)
    return np.clip(np.minimum(across, down), 0, 1).astype(np.float32)
