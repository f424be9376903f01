"""Mosaic of one tile: the ground textured from the image whose centre is closest (paper IV), in two passes.

Images are given a cost at each place: metres from the place to the image's optical axis, more on ground seen at an
angle, at the image's rim, beside the erased laser and beside what terrain hides (so that seams there are soft too and
keep away from edges), and very much more where the laser was erased or terrain hides the place, so that such pixels
serve only where no other image sees it. The lowest cost wins; within some centimetres of a seam images are blended by
exp(-cost / feather). The first pass (`plan`) does this without any image's colours: on nodes, and pixel by pixel only
in blocks where more than one image counts. The second (`compose`) asks for each image that counts anywhere, once,
and lays it down.

Colours are blended as light. What differs between neighbouring images over decimetres (light that was not quite
removed) is spread over a much wider seam, by their thumbnails: the two bands of Burt and Adelson 1983.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .grids import Grid, window
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

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Tone = Callable[[Array32, Array32, Array32], tuple[Array32, Array32]]
Read = Callable[[int, int], Pixels]

FEATHER_M: Final = 0.02
_REACH_FEATHERS: Final = 6.3  # what costs so much more than another has less than half a 255th, and does not count
_WIDE_FEATHERS: Final = 8  # of the seam between thumbnails
_MOST_EVENED: Final = 1.5
_WEIGHTS: Final = 255
_SHARES: Final = (np.arange(_WEIGHTS + 1) / _WEIGHTS).astype(np.float32)
_LEVELS: Final = 65535
_DARKEST: Final = 1e-4
_PAINT_KNOWN: Final = 1e-3


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


_WHOLE: Final = slice(0, BLOCK), slice(0, BLOCK)


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


class Canvas(NamedTuple):
    """A tile while images are laid on it.

    Attributes
    ----------
    rgb : (3, rows, columns of its blocks) uint8, of the blocks that have all their images.
    waiting : of each block the images that are still to come.
    sums : (128, 128, 3) light of the blocks that have some.
    """

    rgb: Pixels
    waiting: Counter[tuple[int, int]]
    sums: dict[tuple[int, int], Array32]


class Mosaic(NamedTuple):
    """A finished tile.

    Attributes
    ----------
    rgb : (3, height, width) uint8, 0 where nothing was seen.
    mask : (height, width) whether anything was seen.
    source : (height, width) int32, number of the image behind most of each cell, -1 none.
    painted : (height, width) whether the laser lights the cell in every image that sees it, so that its colours are
        those around it.
    """

    rgb: Pixels
    mask: Mask
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


def _block_nodes(place: Ground, seen: Seen, row: int, column: int) -> tuple[slice, slice]:
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
    scale = np.float32(_WEIGHTS) / np.maximum(sum(weights), np.float32(1))
    shares = [(weight * scale).astype(np.uint8) for weight in weights]  # never more than there is
    rest = np.uint8(_WEIGHTS) * seen_at_all - sum(shares)
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
    at = _block_nodes(place, seen, *block)
    return bool((seen.quality[at] == BEST).all() and np.isfinite(seen.cost[at]).all())


def _pixel_cost(place: Ground, shot: Shot, seen: Seen, block: tuple[int, int], feather_m: float) -> Array32:
    """Cost (128, 128) of an image's pixels in a block, inf outside of it."""
    at = _block_nodes(place, seen, *block)
    cost = upsample(seen.cost[at], place.step)
    if not (seen.quality[at] == BEST).all():
        cost = cost + quality_cost(_pixel_quality(place, shot, seen, block, shot.quality), feather_m)
    return np.fmin(cost, np.float32(np.inf))  # NaN is inf


def _pixel_quality(
    place: Ground, shot: Shot, seen: Seen, block: tuple[int, int], quality: Pixels, beyond: int = OUTSIDE
) -> Pixels:
    """Of an image of qualities, or one like it, the values (128, 128) in a block."""
    at, scale = _block_nodes(place, seen, *block), quality_scale(shot.camera)
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


def reduction(camera: Camera, range_m: float, cell_m: float) -> int:
    """How many times smaller, a power of two, an image may be read for a mosaic's cell at such a distance."""
    ratio = cell_m * math.sqrt(camera.fx * camera.fy) / range_m
    return 2 ** max(0, math.floor(math.log2(max(ratio, 1e-6)) + 0.25))


def compose(plans: Sequence[Plan], read: Read, reductions: dict[int, int], gamma: float = 1.0) -> list[Mosaic]:
    """The tiles of several plans, each image read once.

    Parameters
    ----------
    plans : of the same images.
    read : read(number, times) is the image of a number, (rows, columns, 3) uint8, so many times smaller.
    reductions : how many times, by number.
    gamma : level = light ** (1 / gamma).
    """
    light = ((np.arange(256) / 255) ** gamma).astype(np.float32)
    levels = np.rint(255 * (np.arange(_LEVELS + 1) / _LEVELS) ** (1 / gamma)).astype(np.uint8)
    canvases = [_canvas(p) for p in plans]
    for number, parts in _by_number(plans):
        times, shot = reductions[number], parts[0][1].shot
        image = picture(shot, read, times)
        painted = image if times > _finest(shot) else None
        for k, laid in parts:
            at = (laid.seen.uv + np.float32(0.5)) * np.float32(1 / times) - np.float32(0.5)
            for patch in laid.patches:
                if patch.painted and painted is None:
                    painted = paint_over(image, laid.shot.quality == ERASED)
                source = painted if patch.painted and painted is not None else image
                _lay(canvases[k], patch, _colours(plans[k].place, laid, patch, source, at, light), levels)
    return [_finish(p, canvas) for p, canvas in zip(plans, canvases, strict=True)]


def picture(shot: Shot, read: Read, times: int) -> Pixels:
    """An image so many times smaller; without laser light where its pixels are larger than those it is known by."""
    finest = min(times, _finest(shot))
    image = read(shot.number, finest)
    if finest == times:
        return image
    size = tuple(-(-side * finest // times) for side in image.shape[1::-1])
    small = cv2.resize(paint_over(image, shot.quality == ERASED), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _finest(shot: Shot) -> int:
    """How many times smaller an image may be read so that its pixels are lit by the laser or not, a power of two."""
    return 2 ** int(math.log2(quality_scale(shot.camera)))


def _by_number(plans: Sequence[Plan]) -> Iterator[tuple[int, list[tuple[int, Laid]]]]:
    """Of each image its parts in the plans."""
    found: dict[int, list[tuple[int, Laid]]] = {}
    for k, made in enumerate(plans):
        for laid in made.laid:
            found.setdefault(laid.shot.number, []).append((k, laid))
    yield from sorted(found.items())


def _colours(place: Ground, laid: Laid, patch: Patch, image: Pixels, at: Array32, light: Array32) -> Array32:
    """An image's colours (..., 3) in a patch, as light, by where (rows, columns, 2) its nodes are in the image."""
    nodes = _patch_nodes(place, laid.seen, patch)
    colour = cv2.LUT(sample(image, upsample(at[nodes], place.step)), light)
    if laid.gain is None or laid.veil is None:
        return np.asarray(colour, np.float32)
    gain, veil = (upsample(values[nodes], place.step) for values in (laid.gain, laid.veil))
    return np.asarray(cv2.subtract(cv2.multiply(colour, gain), veil), np.float32)


def _patch_nodes(place: Ground, seen: Seen, patch: Patch) -> tuple[slice, slice]:
    """Of an image's arrays those nodes that a patch is interpolated from."""

    def within(block: slice, part: slice) -> slice:
        return slice(block.start + part.start // place.step, block.start + part.stop // place.step + 2)

    rows, columns = _block_nodes(place, seen, patch.row, patch.column)
    return within(rows, patch.part[0]), within(columns, patch.part[1])


def _canvas(made: Plan) -> Canvas:
    waiting = Counter((patch.row, patch.column) for laid in made.laid for patch in laid.patches)
    return Canvas(np.zeros((3, *made.place.blocks.shape), np.uint8), waiting, {})


def _lay(canvas: Canvas, patch: Patch, colour: Array32, levels: Pixels) -> None:
    """Adds an image's colours to a block, as light, and makes levels of it once it has all."""
    block = patch.row, patch.column
    total = canvas.sums.pop(block, None)
    if patch.weight is None:
        total = colour
    else:
        total = np.zeros((BLOCK, BLOCK, 3), np.float32) if total is None else total
        total[patch.part] += cv2.multiply(colour, cv2.LUT(cv2.merge([patch.weight] * 3), _SHARES))
    canvas.waiting[block] -= 1
    if canvas.waiting[block]:
        canvas.sums[block] = total
    else:
        rows, columns = (slice(n * BLOCK, (n + 1) * BLOCK) for n in block)
        canvas.rgb[:, rows, columns] = cv2.split(cv2.LUT(_as_16_bits(total), levels))


def _finish(made: Plan, canvas: Canvas) -> Mosaic:
    """The tile without what its blocks have beyond it."""
    at = window(made.place.blocks, made.tile)
    source = np.ascontiguousarray(made.source[at])
    return Mosaic(np.ascontiguousarray(canvas.rgb[:, *at]), source >= 0, source, np.ascontiguousarray(made.painted[at]))


def _as_16_bits(light: NDArray) -> NDArray[np.uint16]:
    full_scale = np.full(4, _LEVELS, float)
    return np.asarray(cv2.multiply(light, full_scale, dtype=cv2.CV_16U), np.uint16)


def paint_over(image: Pixels, erase: Mask) -> Pixels:
    """The image (H, W, 3) with erased pixels filled from around them, coarse to fine (push-pull, Gortler 1996).

    erase (h, w) may be of a smaller image.
    """
    if not erase.any():
        return image
    kept = (~erase).astype(np.uint8)
    full = np.asarray(cv2.resize(kept, image.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
    levels: list[tuple[NDArray, NDArray]] = [_known_shrunk(image, erase, full)]
    while levels[-1][1].min() < _PAINT_KNOWN and min(levels[-1][1].shape) > 1:
        colour, weight = levels[-1]
        levels.append((cv2.pyrDown(colour), cv2.pyrDown(weight)))
    filled = levels[-1][0] / np.maximum(levels[-1][1], 1e-6)[..., None]
    for colour, weight in reversed(levels[:-1]):
        filled = cv2.pyrUp(filled, dstsize=weight.shape[::-1]) * (1 - weight)[..., None] + colour
    smooth = cv2.resize(np.clip(np.rint(filled), 0, 255).astype(np.uint8), image.shape[1::-1])
    return np.asarray(cv2.copyTo(image, full, smooth), np.uint8)


def _known_shrunk(image: Pixels, erase: Mask, full: Pixels) -> tuple[NDArray, NDArray]:
    """The image as small as erase, of its pixels that are kept (full) alone, and their share."""
    size = erase.shape[1], erase.shape[0]
    if image.shape[0] % erase.shape[0] == 0 and image.shape[1] * erase.shape[0] == image.shape[0] * erase.shape[1]:
        share = (~erase).astype(np.float32)  # a small pixel is kept whole or not at all
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) * share[..., None], share
    kept = np.asarray(cv2.copyTo(image, full, np.zeros_like(image)))
    share = cv2.resize(full * np.uint8(_WEIGHTS), size, interpolation=cv2.INTER_AREA).astype(np.float32) / _WEIGHTS
    return cv2.resize(kept, size, interpolation=cv2.INTER_AREA).astype(np.float32), share
