"""Steep sides of a mesh, which an orthomosaic shows smeared: each from the image that sees it best.

Steep triangles that hang together are cut out of as few images as see all of them; the cuttings (charts) are laid side
by side below the orthomosaic in a tile's texture.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from . import occlusion
from .grids import Grid
from .nodes import BEST, Lie, Shot, quality_scale
from .projection import departure, pixels
from .seams import Tone
from .terrain import Terrain

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Faces = NDArray[np.integer]

STEEPEST_UP: Final = 0.5  # a face whose normal has less of up: the orthomosaic has less than half of its pixels
_FACING: Final = 0.2  # least cosine between a face's normal and the ray to the camera
_GAIN: Final = 1.2  # a cutting is worth it if it shows so many times more pixels than the orthomosaic
_LEAST_PX: Final = 1024.0  # area of a chart: less is not worth reading an image for
_PAD_PX: Final = 2
_MOST_EVENED: Final = 1.5
_DARKEST: Final = 1e-4


class Chart(NamedTuple):
    """Faces that one image shows.

    Attributes
    ----------
    number : of the image.
    faces : (K,) of the mesh.
    uv : (K, 3, 2) pixels of their corners, at full resolution.
    range_m : their mean distance.
    """

    number: int
    faces: Faces
    uv: Array
    range_m: float


class Place(NamedTuple):
    """Where a chart goes: first column and row in the sheet, and its first pixel and size in the reduced image."""

    column: int
    row: int
    left: int
    top: int
    width: int
    height: int


def any_steep(X_map: Array, triangles: Faces) -> bool:
    """Whether there is anything to cut out, of vertices (V, 3) and triangles (T, 3)."""
    return bool((_ups(X_map[triangles])[1] < STEEPEST_UP).any())


def _ups(corners: Array) -> tuple[Array, Array]:
    """Normals (T, 3), twice the area long, of faces with corners (T, 3, 3); and how much each points up, 0 to 1."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal, normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)


def charts(
    X_map: Array,
    triangles: Faces,
    terrain: Terrain,
    own: Grid,
    views: Sequence[tuple[Shot, Lie]],
    times: dict[int, int],
    pixel_m: float,
) -> list[Chart]:
    """The steep faces that images show better than an orthomosaic of pixel_m does, each in one image.

    X_map : (V, 3) vertices. triangles : (T, 3). terrain : what may hide them, besides themselves. own : the nodes that
    the mesh was made from. times : by an image's number, how many times smaller it is read.
    """
    corners = X_map[triangles]
    normal, up = _ups(corners)
    steep = np.flatnonzero(up < STEEPEST_UP)
    if not len(steep) or not views:
        return []
    least = _GAIN * 0.5 * normal[steep, 2] / pixel_m**2
    seen = [_seen(corners[steep], normal[steep], shot, lie) for shot, lie in views]
    shown = np.stack([found.area / times[shot.number] ** 2 for found, (shot, _) in zip(seen, views, strict=True)])
    area = np.where(shown > least, shown, 0.0)
    # most tiles have no part that is worth it: they need no scene
    parts = [part for part in _connected(triangles[steep]) if area[:, part].sum(1).max() >= _LEAST_PX]
    if not parts:
        return []
    rest = np.ones(len(steep), bool)
    rest[np.concatenate(parts)] = False
    area[:, rest] = 0.0
    view, face = np.nonzero(area)
    C_map = np.stack([_centre(lie) for _, lie in views])
    scene = occlusion.scene(X_map, triangles, terrain, own)
    centre, facing = corners[steep].mean(1), normal[steep]
    behind = occlusion.hidden(scene, centre[face], facing[face], C_map[view], own.cell_m)
    area[view[behind], face[behind]] = 0.0
    made = []
    for part in parts:
        for number, faces in _shared_out(area[:, part]):
            at = part[faces]
            if area[number, at].sum() >= _LEAST_PX:
                found = seen[number]
                made.append(Chart(views[number][0].number, steep[at], found.uv[at], float(found.range_m[at].mean())))
    return made


def _centre(lie: Lie) -> Array:
    """Where the camera is (3,), map coordinates."""
    return -np.linalg.inv(lie.A) @ lie.b


class _Seen(NamedTuple):
    """Faces in an image: corners (K, 3, 2), pixels that they cover (0 where it does not show them), distance."""

    uv: Array
    area: Array
    range_m: Array


def _seen(corners: Array, normal: Array, shot: Shot, lie: Lie) -> _Seen:
    """Of faces (K, 3, 3) those in the image that face it, whatever is between."""
    X = corners.reshape(-1, 3) @ lie.A.T + lie.b
    ahead = X[:, 2] > 0.05
    safe = np.where(ahead[:, None], X, [0.0, 0.0, 1.0])
    uv = np.stack(pixels(departure(shot.camera), *safe.T), -1).astype(float)
    uv, ahead = uv.reshape(-1, 3, 2), ahead.reshape(-1, 3).all(1)
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    centre = corners.mean(1)
    ray = _centre(lie) - centre
    range_m = np.linalg.norm(ray, axis=1)
    facing = (ray * normal).sum(1) / np.maximum(range_m * np.linalg.norm(normal, axis=1), 1e-12)
    shown = _all_best(shot, uv) & ahead & (facing > _FACING)
    return _Seen(uv, np.where(shown, area, 0.0), range_m)


def _all_best(shot: Shot, uv: Array) -> NDArray[np.bool_]:
    """Which faces (K, 3, 2) are in the image, and all that is around them is away from its rim and from the laser."""
    scale, size = quality_scale(shot.camera), shot.quality.shape[::-1]
    with np.errstate(invalid="ignore"):
        at = np.clip(np.nan_to_num(np.floor((uv + 0.5) / scale), nan=-1), -1, size).astype(int)
    low, high = at.min(1), at.max(1)
    inside = (low >= 0).all(1) & (high < size).all(1)
    (left, top), (right, bottom) = np.clip(low, 0, size).T, np.clip(high + 1, 0, size).T
    less = cv2.integral((shot.quality != BEST).astype(np.uint8))
    return inside & (less[bottom, right] - less[top, right] - less[bottom, left] + less[top, left] == 0)


def _connected(triangles: Faces) -> list[Faces]:
    """Faces (T, 3) in groups that hang together by edges."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    face = np.repeat(np.arange(len(triangles)), 3)
    _, number = np.unique(edges, axis=0, return_inverse=True)
    order = np.argsort(number.ravel(), kind="stable")
    same = number.ravel()[order][1:] == number.ravel()[order][:-1]
    a, b = face[order][:-1][same], face[order][1:][same]
    joined = sparse.coo_matrix((np.ones(len(a)), (a, b)), (len(triangles),) * 2)
    _, group = sparse.csgraph.connected_components(joined, directed=False)
    return np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])


def _shared_out(area: Array) -> list[tuple[int, Faces]]:
    """Of pixels (views, K) which view gets which faces: the one that shows most first, then for the rest again."""
    left, found = area.copy(), []
    while left.any():
        view = int(left.sum(1).argmax())
        faces = np.flatnonzero(left[view] > 0)
        found.append((view, faces))
        left[:, faces] = 0
    return found


def arranged(found: Sequence[Chart], times: dict[int, int], width: int, most_rows: int) -> dict[int, Place]:
    """Places of charts, by their position in found, row by row on a sheet of a width, for as many as fit on it.

    times : of each image, how many times smaller it is read.
    """
    boxes = {}
    for k, chart in enumerate(found):
        uv = (chart.uv.reshape(-1, 2) + 0.5) / times[chart.number] - 0.5
        low, high = np.floor(uv.min(0)).astype(int) - _PAD_PX, np.ceil(uv.max(0)).astype(int) + _PAD_PX
        boxes[k] = (*low.tolist(), *(high - low + 1).tolist())
    placed, column, row, tallest = {}, 0, 0, 0
    for k in sorted(boxes, key=lambda k: -boxes[k][3]):
        left, top, wide, high = boxes[k]
        if column + wide > width:
            column, row, tallest = 0, row + tallest, 0
        if wide > width or row + high > most_rows:
            continue
        placed[k] = Place(column, row, left, top, wide, high)
        column, tallest = column + wide, max(tallest, high)
    return placed


def sheet_rows(placed: dict[int, Place]) -> int:
    """Rows that a sheet needs."""
    return max((place.row + place.height for place in placed.values()), default=0)


def cut_out(
    chart: Chart, place: Place, image: Pixels, times: int, tone: Tone | None, gamma: float, wanted: Array
) -> Pixels:
    """A chart's pixels (height, width, 3), with its water and lamps taken off and as bright as around it.

    image : the chart's image, so many times smaller. wanted : (3,) mean light that the orthomosaic has there.
    """
    rows, columns = (
        np.clip(np.arange(first, first + size), 0, most - 1)
        for first, size, most in ((place.top, place.height, image.shape[0]), (place.left, place.width, image.shape[1]))
    )
    crop = image[np.ix_(rows, columns)]
    if tone is None:
        return crop
    light = ((np.arange(256) / 255) ** gamma).astype(np.float32)[crop]
    u, v = np.meshgrid(*((axis.astype(np.float32) + 0.5) * times - 0.5 for axis in (columns, rows)))
    gain, veil = tone(u.astype(np.float32), v.astype(np.float32), np.full(u.shape, chart.range_m, np.float32))
    light = light * gain - veil
    corners = ((chart.uv.mean(1) + 0.5) / times - 0.5 - [place.left, place.top]).round().astype(int)
    own = np.maximum(light[corners[:, 1], corners[:, 0]].mean(0), _DARKEST)
    light = light * np.clip(wanted / own, 1 / _MOST_EVENED, _MOST_EVENED)
    return np.rint(255 * np.clip(light, 0, 1) ** (1 / gamma)).astype(np.uint8)


class Split(NamedTuple):
    """A mesh whose charts have vertices of their own, the last `len(source) - vertices` ones.

    Attributes
    ----------
    source : (V,) the vertex of the mesh before that each is.
    triangles : (T, 3).
    uv : (V, 2) in the texture with the sheet below it, 0 to 1, downwards.
    """

    source: Faces
    triangles: Faces
    uv: Array


def split(
    triangles: Faces, uv: Array, found: Sequence[Chart], placed: dict[int, Place], times: dict[int, int], rows: int
) -> Split:
    """The mesh with its charts on their sheet.

    uv : (V, 2) in the orthomosaic alone, a square of so many rows, that the sheet is put below.
    """
    whole = rows + sheet_rows(placed)
    triangles, places = triangles.copy(), [uv * [1, rows / whole]]
    source: list[Faces] = [np.arange(len(uv))]
    count = len(uv)
    for k, at in placed.items():
        chart, reduced = found[k], times[found[k].number]
        own, first, number = np.unique(triangles[chart.faces], return_index=True, return_inverse=True)
        pixel = ((chart.uv + 0.5) / reduced - [at.left, at.top] + [at.column, at.row + rows]).reshape(-1, 2)
        source.append(own)
        places.append(pixel[first] / [rows, whole])
        triangles[chart.faces] = number.reshape(-1, 3) + count
        count += len(own)
    return Split(np.concatenate(source), triangles, np.concatenate(places))


def mean_light(texture: Pixels, uv: Array, gamma: float) -> Array:
    """Mean light (3,) of a picture (rows, columns, 3) at places (N, 2) from 0 to 1, rows downwards."""
    rows, columns = texture.shape[:2]
    at = np.clip((uv * [columns, rows]).astype(int), 0, [columns - 1, rows - 1])
    return ((texture[at[:, 1], at[:, 0]] / 255) ** gamma).mean(0)
