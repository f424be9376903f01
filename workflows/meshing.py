"""The mesh by tile: its leaves from surface, orthomosaic and images, coarser tiles from those below them."""

import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..tasks import grids, mesh, mosaic, nodes, painting, steep_faces, terrain
from ..tasks.grids import Grid
from ..tasks.navigation import Poses
from . import mosaics, solve
from .job import Done, Made, code_version, load, once, stage
from .maps import SURFACE, ground_around, paste
from .maps_inputs import Image, MapJob, Tile, context, pose_digest, rows_of

MESH = "mesh"
_VERSION = code_version(sys.modules[__name__])
_JPEG_QUALITY = 85
_MOST_PX = 4096  # side of a tile's texture
_MOST_SHEET = 0.5  # rows of steep faces, of those of the orthomosaic
_TOLERANCE = 0.25  # of a cell
_SMALLER = 8  # holes of the texture are filled at so many times fewer pixels


class Place(NamedTuple):
    """A tile of the pyramid: level 0 is the finest, columns count to the east, rows to the south."""

    level: int
    column: int
    row: int

    @property
    def parent(self) -> "Place":
        """The tile above."""
        return Place(self.level + 1, self.column // 2, self.row // 2)


def leaves(grid: Grid) -> Iterator[Place]:
    """The tiles of level 0 that cells of a grid lie in."""
    size = mesh.SIDE
    for row in range(-grid.top // size, (grid.height - 1 - grid.top) // size + 1):
        for column in range(grid.left // size, (grid.left + grid.width - 1) // size + 1):
            yield Place(0, column, row)


def levels(finest: Sequence[Place]) -> list[list[Place]]:
    """The whole pyramid, finest first, up to a level with no more than 2 x 2 tiles."""
    found = [list(finest)]
    while len({p.column for p in found[-1]}) > 2 or len({p.row for p in found[-1]}) > 2:
        found.append(sorted({place.parent for place in found[-1]}))
    return found


def leaf_inputs(m: MapJob, place: Place, mosaic_cell_m: float) -> tuple[Grid, Grid, Grid]:
    """The nodes of a leaf, the bathymetry that it needs, and the mosaic pixels that it needs."""
    own = mesh.leaf_grid(place.column, place.row, m.cell_m)
    texture = grids.pad(grids.grid_around(own.bounds, mosaic_cell_m), 1)
    return own, ground_around(own, m.cell_m, m.hiding_m), texture


def leaf(
    m: MapJob,
    place: Place,
    images: Sequence[Image],
    ground: Sequence[tuple[Grid, Done]],
    pictures: Sequence[tuple[Grid, Done]],
    light: Done | None,
    mosaic_cell_m: float,
) -> Done:
    """A tile of level 0, from surface tiles, mosaic tiles and the images that touch it."""
    own, around, wanted = leaf_inputs(m, place, mosaic_cell_m)
    tile = Tile(own, tuple(images))
    solution = solve.solution(m.job, m.adjusted)
    inputs = [f"{image.row}:{image.key}" for image in images] + [pose_digest(solution, rows_of(tile))]
    inputs += [done.key for _, done in (*ground, *pictures)] + [light.key if light else ""]

    def make() -> Made:
        z = np.full(around.shape, np.nan)
        for grid, done in ground:
            paste(around, z, grid, load(m.job, SURFACE, done.key, ("elevation",)).arrays["elevation"])
        inner = grids.window(around, own)
        made = mesh.simplified(z[inner], _TOLERANCE * m.cell_m)
        local = mosaics.local_affine(m.frame, own, z[inner])
        relief = terrain.Terrain(z, around, local)
        slopes = np.stack([slope[inner] for slope in terrain.slopes(relief)]).astype(np.float32)
        ortho = _orthomosaic(m, own, wanted, pictures) if len(made.triangles) else None
        if ortho is None:
            return _made(place, z[inner], slopes, made, None, made.error_m)
        steep = _Steep(m, images, solution.poses, light, relief, mosaic_cell_m)
        return _made(place, z[inner], slopes, made, ortho, made.error_m, steep)

    parameters = [list(place), list(own), m.hiding_m, mosaic_cell_m]
    parameters += [*context(m, tile), *stage(m.job.parameters.mosaic)]
    return once(m.job, MESH, _VERSION, inputs, parameters, make, ("z", "slopes", "nodes", "heights", "triangles", "uv"))


def parent(m: MapJob, place: Place, children: Sequence[tuple[Place, Done]]) -> Done:
    """A tile of a coarser level."""

    def make() -> Made:
        entries = {
            (child.column % 2, child.row % 2): load(m.job, MESH, done.key, ("z", "slopes", "texture"))
            for child, done in children
        }
        z, *slopes = (
            mesh.halved_resolution({at: pick(entry.arrays) for at, entry in entries.items()})
            for pick in (lambda a: a["z"], lambda a: a["slopes"][0], lambda a: a["slopes"][1])
        )
        made = mesh.simplified(z, _TOLERANCE * m.cell_m * 2**place.level)
        below = max(done.info["error_m"] for _, done in children)
        ortho = _halved({at: entry for at, entry in entries.items() if len(entry.arrays["texture"])})
        slopes = np.nan_to_num(np.stack(slopes)).astype(np.float32)
        lost = mesh.lost_detail({at: entry.arrays["z"] for at, entry in entries.items()}, z)
        return _made(place, z, slopes, made, ortho if len(made.triangles) else None, below + lost + made.error_m)

    inputs = [f"{child.column % 2},{child.row % 2}:{done.key}" for child, done in children]
    parameters = [list(place), m.cell_m]
    return once(m.job, MESH, _VERSION, inputs, parameters, make, ("z", "slopes", "nodes", "heights", "triangles", "uv"))


class _Steep(NamedTuple):
    """What the textures of steep faces are made from."""

    m: MapJob
    images: Sequence[Image]
    poses: Poses
    light: Done | None
    relief: terrain.Terrain
    mosaic_cell_m: float


def _made(
    place: Place,
    z: np.ndarray,
    slopes: np.ndarray,
    made: mesh.Surface,
    ortho: np.ndarray | None,
    error_m: float,
    steep: _Steep | None = None,
) -> Made:
    uv = (made.nodes / mesh.SIDE).astype(np.float32)
    nodes_xy, heights, triangles, picture = made.nodes, made.z, made.triangles, ortho
    if steep is not None and ortho is not None:
        nodes_xy, heights, triangles, uv, picture = _with_steep_faces(place, made, uv, ortho, steep)
    arrays = {
        "z": z.astype(np.float32),
        "slopes": slopes,
        "nodes": nodes_xy.astype(np.int16),
        "heights": heights.astype(np.float32),
        "triangles": triangles.astype(np.int32),
        "uv": uv.astype(np.float32),
        "texture": np.zeros(0, np.uint8) if picture is None else as_jpeg(picture),
    }
    known = made.z if len(made.z) else np.zeros(1)
    return Made(
        arrays,
        {
            "triangles": len(triangles),
            "vertices": len(heights),
            "steep": int(len(heights) - len(made.z)),
            "error_m": float(error_m),
            "low_m": float(known.min()),
            "high_m": float(known.max()),
            "ortho_px": 0 if ortho is None else len(ortho),
            "texture_px": [0, 0] if picture is None else list(picture.shape[:2]),
            "bytes": len(arrays["texture"]),
        },
    )


def as_jpeg(picture: np.ndarray) -> np.ndarray:
    """The bytes (N,) of a JPEG file of a picture (rows, columns, 3), red green blue."""
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    return np.asarray(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]).ravel()


def from_jpeg(data: np.ndarray) -> np.ndarray:
    """The picture of `as_jpeg`."""
    return np.asarray(cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB))


def _orthomosaic(m: MapJob, own: Grid, wanted: Grid, pictures: Sequence[tuple[Grid, Done]]) -> np.ndarray | None:
    """The mosaic (n, n, 3) from the first node to the last, holes filled from around them; None where it is empty."""
    rgb, mask = np.zeros((*wanted.shape, 3), np.uint8), np.zeros(wanted.shape, bool)
    for grid, done in pictures:
        shared = grids.intersection(wanted, grid)
        if shared is None:
            continue
        arrays = mosaics.layers(m.job, grid, done, ("rgb", "mask"))
        at, part = grids.window(wanted, shared), grids.window(grid, shared)
        rgb[at], mask[at] = (
            cv2.merge([np.ascontiguousarray(band) for band in arrays["rgb"][:, *part]]),
            arrays["mask"][part],
        )
    if not mask.any():
        return None
    if not mask.all():
        _fill(rgb, mask)
    return _between_nodes(rgb, wanted, own)


def _fill(rgb: np.ndarray, mask: np.ndarray) -> None:
    """Give pixels (rows, columns, 3) without a picture the colours around them, smoothly."""
    small = mask.shape[1] // _SMALLER + 1, mask.shape[0] // _SMALLER + 1
    share = cv2.resize(mask.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    known = cv2.resize(rgb, small, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-3)[..., None]
    known = np.clip(np.rint(known), 0, 255).astype(np.uint8)
    filled = painting.paint_over(known, share < 0.5)
    wide = cv2.resize(filled, mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    cv2.copyTo(wide, (~mask).astype(np.uint8), rgb)


def _between_nodes(rgb: np.ndarray, pixels: Grid, own: Grid) -> np.ndarray:
    """Pixels resampled to a square whose edges run through the outer nodes."""
    cell = pixels.cell_m
    side = mesh.SIDE * own.cell_m / cell
    left = (own.left + 0.5) * own.cell_m / cell - pixels.left
    top = pixels.top - (own.top - 0.5) * own.cell_m / cell
    size = min(_MOST_PX, max(1, round(side)))
    if abs(size - side) < 1e-6 and max(abs(left - round(left)), abs(top - round(top))) < 1e-4:
        return rgb[round(top) : round(top) + size, round(left) : round(left) + size]
    scale = side / size
    shift = np.array([[scale, 0, left + scale / 2 - 0.5], [0, scale, top + scale / 2 - 0.5]])
    if scale > 1.5:
        rgb = cv2.blur(rgb, (round(scale),) * 2)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(rgb, shift, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _halved(quarters: dict[tuple[int, int], Any]) -> np.ndarray | None:
    """The orthomosaics of up to four tiles as one of the size of the largest."""
    if not quarters:
        return None
    size = max(entry.info["ortho_px"] for entry in quarters.values())
    half = max(1, size // 2)
    whole = None
    for (right, down), entry in quarters.items():
        picture = from_jpeg(entry.arrays["texture"])
        part = cv2.resize(picture[: entry.info["ortho_px"]], (half, half), interpolation=cv2.INTER_AREA)
        if whole is None:
            whole = np.tile(part.reshape(-1, 3).mean(0).astype(np.uint8), (2 * half, 2 * half, 1))
        whole[down * half : (down + 1) * half, right * half : (right + 1) * half] = part
    return whole


def _with_steep_faces(
    place: Place, made: mesh.Surface, uv: np.ndarray, ortho: np.ndarray, steep: _Steep
) -> tuple[np.ndarray, ...]:
    """Nodes, heights, triangles, uv and texture with steep faces cut out of images; their vertices are there twice."""
    m, images = steep.m, {image.row: image for image in steep.images}
    X_map = vertex_positions(place, made.nodes, made.z, m.cell_m)
    if not steep_faces.any_steep(X_map, made.triangles):
        return made.nodes, made.z, made.triangles, uv, ortho
    model = mosaics.light_model(m.job, steep.light)
    lens = m.job.calibration.camera
    views, shots = [], {image.row: mosaics.shot(m.job, image, None) for image in steep.images}
    for image in steep.images:
        R, C = steep.poses.R_local_camera[image.row], steep.poses.C_local[image.row]
        views.append((shots[image.row], nodes.lie(steep.relief.local, R, C)))
    times = {row: mosaic.reduction(lens, image.range_m, steep.mosaic_cell_m) for row, image in images.items()}
    own = mesh.leaf_grid(place.column, place.row, m.cell_m)
    found = steep_faces.charts(X_map, made.triangles, steep.relief, own, views, times, steep.mosaic_cell_m)
    size = len(ortho)
    placed = steep_faces.arranged(found, times, size, int(_MOST_SHEET * size))
    if not placed:
        return made.nodes, made.z, made.triangles, uv, ortho
    gamma, tone = m.job.parameters.mosaic.gamma, mosaics.tone(lens, model) if model else None
    sheet = np.zeros((steep_faces.sheet_rows(placed), size, 3), np.uint8)
    for row in sorted({found[k].number for k in placed}):
        picture = mosaic.picture(
            shots[row], lambda row, reduce: mosaics.read_image(m.job, images[row], reduce), times[row]
        )
        for k, at in placed.items():
            if found[k].number != row:
                continue
            wanted = steep_faces.mean_light(ortho, uv[made.triangles[found[k].faces]].reshape(-1, 2), gamma)
            part = steep_faces.cut_out(found[k], at, picture, times[row], tone, gamma, wanted)
            sheet[at.row : at.row + at.height, at.column : at.column + at.width] = part
    split = steep_faces.split(made.triangles, uv, found, placed, times, size)
    picture = np.concatenate([ortho, sheet])
    return made.nodes[split.source], made.z[split.source], split.triangles, split.uv, picture


def vertex_positions(place: Place, nodes_xy: np.ndarray, z: np.ndarray, cell_m: float) -> np.ndarray:
    """Map coordinates (V, 3) of vertices at nodes of a tile: the same bits in each tile that has the node."""
    step = 2**place.level
    column = (place.column * mesh.SIDE + nodes_xy[:, 0].astype(np.int64)) * step
    row = (place.row * mesh.SIDE + nodes_xy[:, 1].astype(np.int64)) * step
    return np.column_stack([(column + 0.5) * cell_m, (-row - 0.5) * cell_m, z])


VERSIONS = {MESH: _VERSION}
