"""What images see of a tile, on nodes some mosaic pixels apart: before any of them is decoded.

A tile is made of blocks of 128 x 128 mosaic pixels, and a block of nodes; both are counted from the map's origin, so
that a place has the same nodes in every tile. What is known at nodes becomes known at pixels by bilinear
interpolation (`upsample`).
"""

from functools import lru_cache
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..schemas.calibration import Camera
from .camera import normalised, outline
from .frames import LocalAffine
from .grids import Bounds, Grid, axes, grid_around, intersection
from .projection import Departure, departure, look_up, pixels
from .terrain import Terrain, hidden, horizon, resample, slopes

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

BLOCK: Final = 128  # mosaic pixels
ERASED_M: Final = 1e3  # cost of a pixel that the laser lights
HIDDEN_M: Final = 1e4
OUTSIDE, ERASED, USABLE, BEST = 0, 64, 128, 255  # quality of a pixel
_MOST_STEP: Final = 8
_QUALITY_WIDTH: Final = 456  # columns of an image of qualities, about
_RIM_PX: Final = 16  # seams at an image's rim and beside the laser are softened over so many pixels
_RIM_FEATHERS: Final = 6
_OBLIQUE_M: Final = 0.5  # cost of a ray along the ground
_NEAREST_M: Final = 0.05


class Ground(NamedTuple):
    """The nodes of a tile; arrays (rows, columns), with one node more on each side than the blocks have.

    Attributes
    ----------
    blocks : grid of mosaic pixels that the tile's blocks cover.
    nodes : grid whose cells' centres are the nodes.
    step : mosaic pixels from node to node.
    z : map z, m, NaN where there is no surface.
    slope : dz/dx and dz/dy.
    terrain : what may hide it; None for a plane.
    steepest : `terrain.horizon` of the terrain.
    """

    blocks: Grid
    nodes: Grid
    step: int
    z: Array
    slope: tuple[Array, Array]
    terrain: Terrain | None
    steepest: Array


class Shot(NamedTuple):
    """An image that is to be laid on the ground, without its pixels.

    Attributes
    ----------
    number : by which the mosaic names it.
    camera : its interior orientation.
    quality : (h, w) uint8 by `qualities`, on an image some times smaller.
    thumbnail : (rows, columns, 3) its colours, evenly lit, to even out what differs from its neighbours'; None: not.
    """

    number: int
    camera: Camera
    quality: Pixels
    thumbnail: Array32 | None = None


class Lie(NamedTuple):
    """How an image lies to the map: X_camera = A (3, 3) @ (x, y, z of the map) + b (3,)."""

    A: Array
    b: Array


class Seen(NamedTuple):
    """An image at the nodes of the blocks that it may touch; arrays (rows, columns) float32, NaN where not seen.

    Attributes
    ----------
    row, column : of the first block.
    uv : pixel (rows, columns, 2).
    range_m : from the centre of projection.
    cost : of being shown, m, but for its pixel's quality.
    quality : lowest of the pixels around, uint8.
    """

    row: int
    column: int
    uv: Array32
    range_m: Array32
    cost: Array32
    quality: Pixels

    @property
    def u(self) -> Array32:
        """Columns (rows, columns)."""
        return self.uv[..., 0]

    @property
    def v(self) -> Array32:
        """Rows (rows, columns)."""
        return self.uv[..., 1]


def block_grid(tile: Grid) -> Grid:
    """The whole blocks that cover a tile."""
    west, south, east, north = (
        tile.left // BLOCK,
        (tile.top - tile.height) // BLOCK,
        -(-(tile.left + tile.width) // BLOCK),
        -(-tile.top // BLOCK),
    )
    return Grid(tile.cell_m, west * BLOCK, north * BLOCK, (east - west) * BLOCK, (north - south) * BLOCK)


def flat_ground(tile: Grid) -> Ground:
    """Nodes of a tile on the plane z = 0."""
    blocks, nodes = _grids(tile, _MOST_STEP)
    level = np.zeros(nodes.shape)
    return Ground(blocks, nodes, _MOST_STEP, level, (level, level), None, level)


def ground(tile: Grid, terrain: Terrain) -> Ground:
    """Nodes of a tile on terrain.

    They are as far apart as its cells, or less. The terrain's grid should reach six of its cells beyond the tile,
    and, so that occlusion is the same in every tile, as far as terrain can throw a shadow: relief times the tangent
    of the camera's half field of view.
    """
    step = _MOST_STEP
    while step > 1 and step * tile.cell_m > terrain.grid.cell_m:
        step //= 2
    blocks, nodes = _grids(tile, step)
    x, y = (resample(values, terrain.grid, nodes) for values in slopes(terrain))
    z = resample(terrain.elevation, terrain.grid, nodes)
    return Ground(blocks, nodes, step, z, (np.nan_to_num(x), np.nan_to_num(y)), terrain, horizon(terrain))


def _grids(tile: Grid, step: int) -> tuple[Grid, Grid]:
    blocks = block_grid(tile)
    rows, columns = blocks.height // step + 2, blocks.width // step + 2
    return blocks, Grid(tile.cell_m * step, blocks.left // step - 1, blocks.top // step + 1, columns, rows)


def upsample(values: NDArray, step: int) -> NDArray:
    """Values (rows, columns, ...) at nodes, at the pixels of the blocks between them, without the nodes around."""
    if step == 1:
        return values[1:-1, 1:-1]
    size = values.shape[1] * step, values.shape[0] * step
    return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[step:-step, step:-step]


def sample(image: NDArray, uv: Array32, beyond: float | None = None) -> NDArray:
    """An image at its pixels uv (rows, columns, 2), bilinear; outside of it beyond, or as at its rim."""
    mode = cv2.BORDER_REPLICATE if beyond is None else cv2.BORDER_CONSTANT
    no_second_map: Any = None  # which OpenCV's type stubs ask for
    return cv2.remap(image, uv, no_second_map, cv2.INTER_LINEAR, borderMode=mode, borderValue=[beyond or 0.0] * 4)


def quality_scale(camera: Camera) -> int:
    """Pixels of an image to a pixel of its image of qualities."""
    return max(1, camera.width // _QUALITY_WIDTH)


def qualities(erase: Mask, scale: int) -> Pixels:
    """Quality of the pixels (h, w) of an image scale times smaller than the camera's; erase: those the laser lights.

    Best in the middle, less at the rim and beside the laser, down to USABLE.
    """
    usable = np.pad(~erase, 1).astype(np.uint8)
    depth = cv2.distanceTransform(usable, cv2.DIST_L2, 3)[1:-1, 1:-1] - 1
    share = np.minimum(depth / max(_RIM_PX / scale, 2), 1)
    return np.where(erase, ERASED, USABLE + (BEST - USABLE) * share).astype(np.uint8)


def quality_cost(quality: Pixels, feather_m: float) -> Array32:
    """Metres that pixels cost by their quality; inf outside of the image."""
    return np.asarray(cv2.LUT(quality, _quality_costs(feather_m)), np.float32)


@lru_cache(maxsize=4)
def _quality_costs(feather_m: float) -> Array32:
    level = np.arange(256)
    cost = _RIM_FEATHERS * feather_m * (BEST - np.clip(level, USABLE, BEST)) / (BEST - USABLE)
    cost += np.where(level < USABLE - 1, ERASED_M, 0)
    return np.where(level < ERASED - 1, np.inf, cost).astype(np.float32)


def lie(local: LocalAffine, R_local_camera: Array, C_local: Array) -> Lie:
    """How an image lies to the map by its pose in the local frame."""
    return Lie(R_local_camera.T @ local.matrix, R_local_camera.T @ (local.offset - C_local))


def see(place: Ground, shot: Shot, lie: Lie, feather_m: float) -> Seen | None:
    """What an image sees of a tile's nodes; None for nothing."""
    table, part = departure(shot.camera), _blocks_seen(place, shot.camera, lie)
    if part is None:
        return None
    row, column = (place.blocks.top - part.top) // BLOCK, (part.left - place.blocks.left) // BLOCK
    nodes = _grids(part, place.step)[1]
    first = row * BLOCK // place.step, column * BLOCK // place.step
    at = slice(first[0], first[0] + nodes.height), slice(first[1], first[1] + nodes.width)
    if not np.isfinite(place.z[at]).any():
        return None
    x, y = axes(nodes)
    X, Y, Z = (lie.A[k, 2] * place.z[at] + (lie.A[k, 0] * x + lie.b[k]) + lie.A[k, 1] * y[:, None] for k in range(3))
    u, v = _pixels_or_nan(table, X, Y, Z)
    shown = np.isfinite(u)
    if not shown.any():
        return None
    away2 = X * X + Y * Y
    range_m = np.sqrt(away2 + Z * Z)
    cost = np.sqrt(away2) + np.where(shown, 0, np.nan)
    if place.terrain is not None:
        C = -np.linalg.inv(lie.A) @ lie.b
        cost += _oblique(place, at, nodes, C) + _hiding(place, nodes, C, feather_m)
    quality = _quality_around(place, shot, u, v, float(np.median(Z[shown])))
    return Seen(row, column, np.dstack([u, v]), range_m.astype(np.float32), cost.astype(np.float32), quality)


def _pixels_or_nan(table: Departure, X: Array, Y: Array, Z: Array) -> tuple[Array32, Array32]:
    (left, top), (right, bottom) = table.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        across, down = X / Z, Y / Z
        within = (Z > _NEAREST_M) & (across >= left) & (across <= right) & (down >= top) & (down <= bottom)
    found = np.full((2, X.size), np.nan, np.float32)
    at = np.flatnonzero(within)
    found[:, at] = pixels(table, X.ravel()[at], Y.ravel()[at], Z.ravel()[at])
    return found[0].reshape(X.shape), found[1].reshape(X.shape)


def _oblique(place: Ground, at: tuple[slice, slice], nodes: Grid, C_map: Array) -> Array:
    """Cost of rays that meet the ground at an angle: the image that faces a steep side shows it."""
    x, y = axes(nodes)
    east, north, above = C_map[0] - x, (C_map[1] - y)[:, None], C_map[2] - place.z[at]
    slope_x, slope_y = (values[at] for values in place.slope)
    along = above - slope_x * east - slope_y * north
    length = np.sqrt((east**2 + north**2 + above**2) * (1 + slope_x**2 + slope_y**2))
    return _OBLIQUE_M * (1 - np.maximum(along / length, 0))


def _hiding(place: Ground, nodes: Grid, C_map: Array, feather_m: float) -> Array | float:
    """Cost of being hidden, and of being near to what is."""
    assert place.terrain is not None
    share = hidden(place.terrain, place.steepest, nodes, C_map)
    if not share.any():
        return 0.0
    near = cv2.blur((share > 0.5).astype(np.float32), (7, 7), borderType=cv2.BORDER_REPLICATE)
    return _RIM_FEATHERS * feather_m * near + HIDDEN_M * (share > 0.5)


def _quality_around(place: Ground, shot: Shot, u: Array32, v: Array32, range_m: float) -> Pixels:
    """The lowest quality of the pixels that are shown around each node."""
    scale, focal = quality_scale(shot.camera), max(shot.camera.fx, shot.camera.fy)
    reach = int(np.ceil(place.nodes.cell_m * focal / range_m / scale)) + 1
    window = np.ones((2 * reach + 1,) * 2, np.uint8)
    lowest = cv2.erode(shot.quality, window, borderType=cv2.BORDER_CONSTANT, borderValue=[OUTSIDE])
    flat = [np.nan_to_num((w.ravel() + 0.5) / scale - 0.5, nan=-9).astype(np.float32) for w in (u, v)]
    return look_up(np.asarray(lowest), flat[0], flat[1], beyond=OUTSIDE).reshape(u.shape)


def small_at(small: Array32, camera: Camera, u: Array32, v: Array32) -> Array32:
    """Values (..., 3) of a small picture (rows, columns, 3) of an image at its pixels u, v (...)."""
    rows, columns = small.shape[:2]
    at = [
        ((w.ravel() + 0.5) * (n / size) - 0.5) for w, n, size in ((u, columns, camera.width), (v, rows, camera.height))
    ]
    return look_up(small, *(np.nan_to_num(w).astype(np.float32) for w in at)).reshape(*u.shape, 3)


def _blocks_seen(place: Ground, camera: Camera, lie: Lie) -> Grid | None:
    """The blocks with every pixel that the image can see, from its outline on lowest and highest ground."""
    if not np.isfinite(place.z).any():
        return None
    low, high = float(np.nanmin(place.z)), float(np.nanmax(place.z))
    directions, inverse = normalised(camera, outline(camera, 9)), np.linalg.inv(lie.A)
    C, direction = -inverse @ lie.b, np.column_stack([directions, np.ones(len(directions))]) @ inverse.T
    if (direction[:, 2] > -0.1).any() or not C[2] > high:
        return place.blocks  # the horizon is in the picture, or the ground is beside the camera
    on_ground = [C + direction * ((z - C[2]) / direction[:, 2])[:, None] for z in (low, high)]
    x, y = np.concatenate(on_ground)[:, :2].T
    # 5 % for what bulges between the outline's points
    margin = 2 * place.nodes.cell_m + 0.05 * max(np.ptp(x), np.ptp(y))
    around = Bounds(x.min() - margin, y.min() - margin, x.max() + margin, y.max() + margin)
    part = intersection(place.blocks, grid_around(around, place.blocks.cell_m))
    return None if part is None else block_grid(part)
