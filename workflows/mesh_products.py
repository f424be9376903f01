"""mesh.ply, mesh.glb and mesh-3dtiles/ from the pyramid of mesh tiles."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyproj

from ..catalog import meshes, metadata, tiles3d
from ..catalog.meshes import Part
from ..schemas.products import MeshQuality
from .job import Done, load
from .meshing import MESH, Place, as_jpeg, from_jpeg, vertex_positions
from .results import Results

_MOST_BYTES = 45_000_000  # of a glb
_BYTES_A_VERTEX, _BYTES_A_TRIANGLE = 32, 12
_FOLDER = "mesh-3dtiles"


def write(results: Results, folder: Path, crs_wkt: str) -> MeshQuality:
    """All three; what they came to."""
    pyramid, mapped = results.mapped.mesh, results.mapped
    west, _, _, north = mapped.ground.grid.bounds
    origin = np.array([west, north, 0.0])
    about = {"crs": crs_wkt, "offset": origin.tolist()}
    _write_tiles(results, folder / _FOLDER, None if results.opened.crs is None else crs_wkt, origin, about)
    level = level_of_file(pyramid, results.job.parameters.mesh.max_triangles)
    chosen = {place: done for place, done in pyramid.items() if place.level == level and done.info["triangles"]}
    shrink = _shrink(list(chosen.values()), results.job.parameters.mesh.texture_px)
    parts = [_part(results, place, done, origin, shrink) for place, done in chosen.items()]
    meshes.write_glb(folder / "mesh.glb", parts, about | {"axes": "x east, y up, z south"})
    vertices, triangles, colours = _joined(results, chosen, parts)
    crs = metadata.authority_code(pyproj.CRS.from_wkt(crs_wkt)) or crs_wkt
    comments = [f"offset {west:.6f} {north:.6f} 0.000000", f"crs {crs}"]
    meshes.write_ply(folder / "mesh.ply", vertices, triangles, colours, comments=comments)
    finest = sum(done.info["triangles"] for place, done in pyramid.items() if not place.level)
    return MeshQuality(
        vertices=len(vertices),
        triangles=len(triangles),
        level=level,
        error_m=max((done.info["error_m"] for done in chosen.values()), default=None),
        tiles=sum(bool(done.info["triangles"]) for done in pyramid.values()),
        finest_triangles=finest,
    )


def level_of_file(pyramid: dict[Place, Done], max_triangles: int) -> int:
    """The finest level that is not too large, or the coarsest."""
    last = max(place.level for place in pyramid)
    for level in range(last):
        chosen = [done.info for place, done in pyramid.items() if place.level == level]
        triangles, vertices = (sum(info[name] for info in chosen) for name in ("triangles", "vertices"))
        size = _BYTES_A_VERTEX * vertices + _BYTES_A_TRIANGLE * triangles
        if triangles <= max_triangles and size < _MOST_BYTES / 2:
            return level
    return last


def _shrink(chosen: Sequence[Done], texture_px: int) -> int:
    """How many times smaller, a power of two, textures have to be for a file of bounded size."""
    pixels = sum(done.info["texture_px"][0] * done.info["texture_px"][1] for done in chosen)
    geometry = sum(
        _BYTES_A_VERTEX * done.info["vertices"] + _BYTES_A_TRIANGLE * done.info["triangles"] for done in chosen
    )
    most_bytes, size = _MOST_BYTES - geometry, sum(done.info["bytes"] for done in chosen)
    shrink = 1
    # smaller pictures have more detail in a pixel: count on half as much again
    while pixels > shrink**2 * texture_px**2 or size * (1 if shrink == 1 else 1.5) > shrink**2 * most_bytes:
        shrink *= 2
    return shrink


def _part(results: Results, place: Place, done: Done, origin: np.ndarray, shrink: int = 1) -> Part:
    arrays = load(results.job, MESH, done.key).arrays
    x, y = arrays["slopes"][:, arrays["nodes"][:, 1], arrays["nodes"][:, 0]].astype(float)
    normals = np.column_stack([-x, -y, np.ones(len(x))])
    texture = arrays["texture"]
    return Part(
        vertex_positions(place, arrays["nodes"], arrays["heights"], results.mapped.ground.grid.cell_m) - origin,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        arrays["triangles"],
        arrays["uv"],
        _smaller(texture, shrink).tobytes() if len(texture) else None,
    )


def _smaller(jpeg: np.ndarray, shrink: int) -> np.ndarray:
    if shrink == 1:
        return jpeg
    picture = from_jpeg(jpeg)
    size = [max(1, -(-n // shrink)) for n in picture.shape[1::-1]]
    return as_jpeg(np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA)))


def _joined(
    results: Results, chosen: dict[Place, Done], parts: Sequence[Part]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One mesh of all parts: vertices (V, 3), each node once, triangles (T, 3) and colours (V, 3)."""
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8)
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = np.concatenate([part.triangles + k for part, k in zip(parts, first, strict=False)])
    positions = np.concatenate([part.vertices for part in parts])
    colours = np.concatenate([_colours(part) for part in parts])
    # vertices of a node have the same bits, and steep faces' second ones come after the orthomosaic's
    _, kept, number = np.unique(positions[:, :2], axis=0, return_index=True, return_inverse=True)
    return positions[kept], number.ravel()[triangles], colours[kept]


def _colours(part: Part) -> np.ndarray:
    if part.texture is None:
        return np.full((len(part.vertices), 3), 153, np.uint8)
    picture = from_jpeg(np.frombuffer(part.texture, np.uint8))
    rows, columns = picture.shape[:2]
    at = np.clip((part.uv * [columns, rows]).astype(int), 0, [columns - 1, rows - 1])
    return picture[at[:, 1], at[:, 0]]


def _write_tiles(
    results: Results, folder: Path, crs_wkt: str | None, origin: np.ndarray, about: dict[str, Any]
) -> None:
    """Every tile as a file of its own, and the tileset."""
    pyramid = results.mapped.mesh
    written: dict[Place, tiles3d.Node] = {}
    for place, done in sorted(pyramid.items()):  # the finest first
        below, uri = tuple(_children(written, place)), None
        low, high = [child.low for child in below], [child.high for child in below]
        if done.info["triangles"]:
            uri = f"{place.level}/{place.column}_{place.row}.glb"
            part = _part(results, place, done, origin)
            tiles3d.write_content(folder / uri, part)
            low, high = [part.vertices.min(0), *low], [part.vertices.max(0), *high]
        if low:  # what is too narrow for a triangle at this level leads to the finer ones
            error_m = done.info["error_m"] if uri else results.mapped.ground.grid.cell_m * 2**place.level
            written[place] = tiles3d.Node(uri, np.min(low, 0), np.max(high, 0), error_m, below)
    top = max((place.level for place in written), default=0)
    roots = [node for place, node in written.items() if place.level == top]
    folder.mkdir(exist_ok=True)
    tiles3d.write_tileset(folder / "tileset.json", roots, crs_wkt, origin, about)


def _children(written: dict[Place, tiles3d.Node], place: Place) -> Iterator[tiles3d.Node]:
    for down in (0, 1):
        for right in (0, 1):
            child = Place(place.level - 1, 2 * place.column + right, 2 * place.row + down)
            if child in written:
                yield written[child]
