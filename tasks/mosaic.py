"""Mosaic of one tile: the ground textured from the image whose centre is closest (paper IV), in two passes.

The first (`seams.plan`) tells which image is shown where without any image's colours. The second (`compose`) asks for
each image that counts anywhere, once, and lays it down. Colours are blended as light.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .grids import window
from .nodes import BLOCK, ERASED, Ground, Seen, Shot, quality_scale, sample, upsample
from .painting import paint_over
from .seams import WEIGHTS, Laid, Patch, Plan, block_nodes

Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Read = Callable[[int, int], Pixels]

_SHARES: Final = (np.arange(WEIGHTS + 1) / WEIGHTS).astype(np.float32)
_LEVELS: Final = 65535


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

    rows, columns = block_nodes(place, seen, patch.row, patch.column)
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
