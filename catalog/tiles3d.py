"""mesh-3dtiles/: the surface as OGC 3D Tiles 1.1, a pyramid of glTF files and the tileset.json that names them.

Vertices are about one local origin, x east, y north, z up; the tileset's root places them on the Earth.
"""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyproj
from numpy.typing import NDArray

from .meshes import Part, write_glb
from .rasters import horizontal_wkt

Array = NDArray[np.float64]
_STEP_M: Final = 10.0  # over which the directions of the map's axes are measured
_THICKEST_M: Final = 0.01  # a box needs some height


class Node(NamedTuple):
    """A tile of the pyramid.

    Attributes
    ----------
    uri : of its file, in the folder; None for a tile that has nothing but finer ones.
    low, high : (3,) corners of its box from the local origin, m.
    error_m : how far it is from the finest tiles at most.
    children : the tiles of the next finer level that replace it.
    """

    uri: str | None
    low: Array
    high: Array
    error_m: float
    children: tuple["Node", ...]


def write_content(path: str | os.PathLike[str], part: Part) -> None:
    """Write the file of a tile."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_glb(path, [part])


def write_tileset(
    path: str | os.PathLike[str], roots: Sequence[Node], crs_wkt: str | None, origin: Array, extras: Mapping[str, Any]
) -> None:
    """Write tileset.json.

    Parameters
    ----------
    roots : the coarsest tiles.
    crs_wkt : of the map; None for a local frame, which has no place on the Earth.
    origin : (3,) map coordinates of the local origin. The elevation is taken for one above the ellipsoid: viewers show
        the map too high or too low by how much its vertical reference is off.
    """
    nowhere = np.zeros(3)  # without a triangle the tileset is an empty one
    low = np.min([node.low for node in roots] or [nowhere], 0)
    high = np.max([node.high for node in roots] or [nowhere], 0)
    coarsest = 2 * max((node.error_m for node in roots), default=0.0)
    root: dict[str, Any] = {
        "boundingVolume": {"box": _box(low, high)},
        "geometricError": coarsest,
        "refine": "REPLACE",
        "children": [_tile(node) for node in roots],
    }
    if crs_wkt is not None:
        root["transform"] = earth_from_local(crs_wkt, origin).T.ravel().tolist()
    asset = {"version": "1.1", "generator": "seamosaic", "extras": dict(extras)}
    document = {"asset": asset, "geometricError": 2 * coarsest, "root": root}
    Path(path).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _tile(node: Node) -> dict[str, Any]:
    children = [_tile(child) for child in node.children]
    return {
        "boundingVolume": {"box": _box(node.low, node.high)},
        # a tile without finer ones is never refined
        "geometricError": node.error_m if children else 0.0,
        **({"content": {"uri": node.uri}} if node.uri else {}),
        **({"children": children} if children else {}),
    }


def _box(low: Array, high: Array) -> list[float]:
    half = np.maximum((high - low) / 2, _THICKEST_M)
    return [*((low + high) / 2).tolist(), *np.diag(half).ravel().tolist()]


def earth_from_local(crs_wkt: str, origin: Array) -> Array:
    """(4, 4) from the local frame (x, y along the map's axes, z up) to Earth-centred, Earth-fixed coordinates."""
    to_earth = pyproj.Transformer.from_crs(horizontal_wkt(crs_wkt), "EPSG:4326", always_xy=True)
    fixed = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    steps = np.vstack([np.zeros(3), _STEP_M * np.eye(3)])
    x, y, z = (steps + origin).T
    X = np.column_stack(fixed.transform(*to_earth.transform(x, y), z))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (X[1:] - X[0]).T / _STEP_M, X[0]
    return matrix
