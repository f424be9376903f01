"""Orthomosaic of one tile: the surface textured from the image whose centre is closest (paper IV).

A tile is begun with `start`, given its images one at a time with `add_view`, and ended with `finish`; it holds no
image. Each image is given a cost in each cell: metres from the cell to the image's optical axis, more at the
image's rim and beside the erased laser (so that seams there are soft too), and very much more where the laser was
erased or terrain hides the cell, so that such pixels serve only where no other image sees the place. The lowest
cost wins; within some centimetres of a seam images are blended by exp(-cost / feather), which does not
depend on their order.
"""

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .camera import normalised, outline
from .grids import Grid, axes, grid_around, intersection, window
from .projection import Departure, departure, look_up, pixels
from .terrain import Terrain, hidden, resample

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
Pixels = NDArray[np.uint8]

_ERASED_M: Final = 1e3  # cost of a pixel that was painted over the laser
_HIDDEN_M: Final = 1e4
_RIM_PX: Final = 16  # seams at an image's rim and beside the laser are softened over so many pixels
_RIM_FEATHERS: Final = 6
_REACH_FEATHERS: Final = 16  # an image that costs so much more than another does not count
_PAINT_SHRINK: Final = 4
_PAINT_KNOWN: Final = 1e-3


class View(NamedTuple):
    """One image and where it was taken from.

    Attributes
    ----------
    image : (H, W, 3) uint8; the mosaic has its channels in the same order.
    erase : (H, W) pixels that the laser lights.
    camera : its interior orientation.
    R_local_camera : (3, 3) rotation from camera to local axes.
    C_local : (3,) centre of projection, local, m.
    number : by which the mosaic names the image.
    """

    image: Pixels
    erase: Mask
    camera: Camera
    R_local_camera: Array
    C_local: Array
    number: int


class Canvas(NamedTuple):
    """A tile being composed; arrays (height, width).

    Attributes
    ----------
    tile : grid of the mosaic.
    terrain : what it lies on; None for a plane, where nothing hides anything.
    z : map z of the cells, m, NaN where there is no surface.
    cost : lowest so far, m; inf for none.
    weight : sum of the images' exp(-(their cost - cost) / feather).
    colour : (height, width, 3) sum of the colours with these weights.
    source : number of the image of the lowest cost, -1 none.
    feather_m : cost by which a weight falls to 1/e.
    z_min, z_max : of z, m.
    """

    tile: Grid
    terrain: Terrain | None
    z: Array
    cost: Array32
    weight: Array32
    colour: Array32
    source: NDArray[np.int32]
    feather_m: float
    z_min: float
    z_max: float


class Mosaic(NamedTuple):
    """A finished tile.

    Attributes
    ----------
    rgb : (3, height, width) uint8, 0 where nothing was seen.
    mask : (height, width) whether anything was seen.
    source : (height, width) int32, number of the image behind most of each cell, -1 none.
    """

    rgb: Pixels
    mask: Mask
    source: NDArray[np.int32]


def start(tile: Grid, terrain: Terrain, feather_m: float = 0.02) -> Canvas:
    """An empty tile over terrain.

    The terrain's grid should reach two of its cells beyond the tile, and, so that occlusion is the same in every
    tile, as far as terrain can throw a shadow: relief times the tangent of the camera's half field of view.
    """
    return empty_canvas(tile, terrain, resample(terrain.elevation, terrain.grid, tile), feather_m)


def empty_canvas(tile: Grid, terrain: Terrain | None, z: Array, feather_m: float) -> Canvas:
    """A canvas on given heights z (height, width)."""
    return Canvas(
        tile,
        terrain,
        z,
        np.full(tile.shape, np.inf, np.float32),
        np.zeros(tile.shape, np.float32),
        np.zeros((*tile.shape, 3), np.float32),
        np.full(tile.shape, -1, np.int32),
        feather_m,
        float(np.fmin.reduce(z, axis=None)),
        float(np.fmax.reduce(z, axis=None)),
    )


def add_view(canvas: Canvas, view: View) -> Canvas:
    """The canvas with one image more; its arrays are updated in place."""
    assert canvas.terrain is not None
    local = canvas.terrain.local
    A = view.R_local_camera.T @ local.matrix
    return composite(canvas, view, A, view.R_local_camera.T @ (local.offset - view.C_local))


def composite(canvas: Canvas, view: View, A: Array, b: Array) -> Canvas:
    """Adds an image for which X_camera = A (3, 3) @ (x, y, z of the canvas) + b (3,)."""
    part = _footprint(canvas, view.camera, A, b)
    if part is None:
        return canvas
    rows, columns = window(canvas.tile, part)
    table, worth = departure(view.camera), canvas.cost[rows, columns] + _REACH_FEATHERS * canvas.feather_m
    cell, X, Y, Z = _candidates(table, part, canvas.z[rows, columns], worth, A, b)
    u, v = pixels(table, X, Y, Z)
    cost = np.hypot(X, Y).astype(np.float32) + look_up(_pixel_costs(view.erase, canvas.feather_m), u, v)
    if canvas.terrain is not None:
        cost += _HIDDEN_M * hidden(canvas.terrain, part, -np.linalg.inv(A) @ b).ravel()[cell]
    height, width = view.erase.shape
    counts = np.flatnonzero((u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1) & (cost < worth.ravel()[cell]))
    scale = canvas.tile.cell_m * math.sqrt(view.camera.fx * view.camera.fy) / Z[counts]
    colour = _sample(paint_over(view.image, view.erase), u[counts], v[counts], scale)
    row, column = np.divmod(cell[counts], part.width)
    at = (row + rows.start) * canvas.tile.width + column + columns.start
    _blend(canvas, at, cost[counts], colour, view.number)
    return canvas


def _candidates(
    table: Departure, part: Grid, z: Array, worth: Array32, A: Array, b: Array
) -> tuple[Indices, Array, Array, Array]:
    """Cells (K,), flat, in the image and no farther from its axis than worth, and their X, Y, Z in the camera frame.

    What is left out could not count: the distance to the axis is the least that a pixel costs.
    """
    x, y = axes(part)
    X, Y, Z = (A[k, 2] * z + (A[k, 0] * x + b[k]) + A[k, 1] * y[:, None] for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        across, down = X / Z, Y / Z
    (left, top), (right, bottom) = table.bounds
    near = (Z > 0) & (across >= left) & (across <= right) & (down >= top) & (down <= bottom) & (np.hypot(X, Y) < worth)
    cell = np.flatnonzero(near)
    return cell, X.ravel()[cell], Y.ravel()[cell], Z.ravel()[cell]


def finish(canvas: Canvas) -> Mosaic:
    """The tile's colours, its mask and the image behind each cell."""
    mask = canvas.weight > 0
    mean = canvas.colour / np.maximum(canvas.weight, 1e-30)[..., None]
    rgb = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    return Mosaic(np.ascontiguousarray(np.moveaxis(rgb, 2, 0)), mask, canvas.source)


def _blend(canvas: Canvas, at: Indices, cost: Array32, colour: Pixels, number: int) -> None:
    """Adds colours (K, 3) to flat cells; sums so far are of weights relative to the lowest cost, and shrink with it."""
    lowest, weight, source = canvas.cost.reshape(-1), canvas.weight.reshape(-1), canvas.source.reshape(-1)
    sums, old = canvas.colour.reshape(-1, 3), lowest[at]
    best = np.minimum(old, cost)
    keep, add = np.exp((best - old) / canvas.feather_m), np.exp((best - cost) / canvas.feather_m)
    weight[at] = weight[at] * keep + add
    sums[at] = sums[at] * keep[:, None] + colour * add[:, None]
    source[at] = np.where(cost < old, np.int32(number), source[at])
    lowest[at] = best


def _footprint(canvas: Canvas, camera: Camera, A: Array, b: Array) -> Grid | None:
    """The part of the tile with every cell that the image can see, from its outline on lowest and highest ground."""
    slopes, inverse = normalised(camera, outline(camera, 9)), np.linalg.inv(A)
    C, direction = -inverse @ b, np.column_stack([slopes, np.ones(len(slopes))]) @ inverse.T
    if (direction[:, 2] > -0.1).any() or not C[2] > canvas.z_max:
        return canvas.tile  # the horizon is in the picture, or the ground is beside the camera
    ground = [C + direction * ((z - C[2]) / direction[:, 2])[:, None] for z in (canvas.z_min, canvas.z_max)]
    x, y = np.concatenate(ground)[:, :2].T
    # 5 % for what bulges between the outline's points
    margin = 2 * canvas.tile.cell_m + 0.05 * max(np.ptp(x), np.ptp(y))
    bounds = x.min() - margin, y.min() - margin, x.max() + margin, y.max() + margin
    return intersection(canvas.tile, grid_around(bounds, canvas.tile.cell_m))


def _pixel_costs(erase: Mask, feather_m: float) -> Array32:
    """Cost in metres of each pixel (H, W) for where it is in its image."""
    usable = np.pad(~erase, 1).astype(np.uint8)
    depth = cv2.distanceTransform(usable, cv2.DIST_L2, 3)[1:-1, 1:-1]
    soft = _RIM_FEATHERS * feather_m * (1 - np.minimum(depth, _RIM_PX) / _RIM_PX)
    return (soft + _ERASED_M * erase).astype(np.float32)


def paint_over(image: Pixels, erase: Mask) -> Pixels:
    """The image (H, W, 3) with erased pixels filled from around them, coarse to fine (push-pull, Gortler 1996)."""
    if not erase.any():
        return image
    size = max(1, image.shape[1] // _PAINT_SHRINK), max(1, image.shape[0] // _PAINT_SHRINK)
    kept = np.where(erase[..., None], np.uint8(0), image)
    weight = cv2.resize((~erase).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    levels: list[tuple[NDArray, NDArray]] = [
        (cv2.resize(kept, size, interpolation=cv2.INTER_AREA).astype(np.float32), weight)
    ]
    while levels[-1][1].min() < _PAINT_KNOWN and min(levels[-1][1].shape) > 1:
        colour, weight = levels[-1]
        levels.append((cv2.pyrDown(colour), cv2.pyrDown(weight)))
    filled = levels[-1][0] / np.maximum(levels[-1][1], 1e-6)[..., None]
    for colour, weight in reversed(levels[:-1]):
        filled = cv2.pyrUp(filled, dstsize=weight.shape[::-1]) * (1 - weight)[..., None] + colour
    smooth = cv2.resize(np.clip(np.rint(filled), 0, 255).astype(np.uint8), image.shape[1::-1])
    return np.where(erase[..., None], smooth, image)


def _sample(image: Pixels, u: Array32, v: Array32, scale: Array) -> Pixels:
    """Colours (K, 3) at pixels u, v; where a cell takes in many pixels (scale), from a smoothed, halved image."""
    level = np.clip(np.rint(np.log2(scale)), 0, 8).astype(np.int8)
    colour, halved = np.zeros((len(u), 3), np.uint8), np.asarray(image)
    for k in range(int(level.max(initial=0)) + 1):
        here = np.flatnonzero(level == k)
        if len(here):
            colour[here] = look_up(halved, u[here] / np.float32(2**k), v[here] / np.float32(2**k))
        halved = np.asarray(cv2.pyrDown(halved))
    return colour
