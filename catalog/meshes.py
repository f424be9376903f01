"""mesh.ply and mesh.glb: the surface about a local origin (map coordinates = vertex + offset).

Triangles are counter-clockwise seen from above. Texture coordinates are (u, v) with u to the right and v DOWN from
the top left corner of the texture, in units of its width and height.
"""

import io
import json
import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_JPEG_QUALITY: Final = 90
_FLOAT, _UINT, _ARRAY, _INDEX = 5126, 5125, 34962, 34963
_GREY: Final = [0.6, 0.6, 0.6, 1.0]


def write_ply(
    path: str | os.PathLike[str],
    vertices: NDArray[np.floating],
    triangles: NDArray[np.integer],
    colours: NDArray[np.uint8] | None = None,
    uv: NDArray[np.floating] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY.

    Parameters
    ----------
    vertices : (N, 3) x east, y north, z up, metres from the local origin.
    triangles : (T, 3) indices of vertices.
    colours : (N, 3) RGB.
    uv : (N, 2) texture coordinates; stored as s, t with t up, as PLY readers expect.
    comments : header lines, such as the CRS and the offset of the origin.
    """
    fields = [(name, "<f4") for name in "xyz"]
    fields += [(name, "<f4") for name in "st"] if uv is not None else []
    fields += [(name, "u1") for name in ("red", "green", "blue")] if colours is not None else []
    points = np.zeros(len(vertices), fields)
    points["x"], points["y"], points["z"] = np.asarray(vertices).T
    if uv is not None:
        points["s"], points["t"] = uv[:, 0], 1 - uv[:, 1]
    if colours is not None:
        points["red"], points["green"], points["blue"] = colours.T
    faces = np.zeros(len(triangles), [("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, triangles
    _write(Path(path), _ply_header(fields, len(points), len(faces), comments), points.tobytes(), faces.tobytes())


def _ply_header(fields: list[tuple[str, str]], points: int, faces: int, comments: Sequence[str]) -> bytes:
    types = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {line}" for comment in comments for line in comment.splitlines()]
    lines += [f"element vertex {points}", *(f"property {types[kind]} {name}" for name, kind in fields)]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii", "replace")


def write_glb(
    path: str | os.PathLike[str],
    vertices: NDArray[np.floating],
    triangles: NDArray[np.integer],
    uv: NDArray[np.floating] | None = None,
    texture_rgb: NDArray[np.uint8] | None = None,
    extras: Mapping[str, Any] | None = None,
) -> None:
    """Write a binary glTF 2.0 with a JPEG texture.

    glTF is y up: a vertex (east, north, up) is stored as (east, up, -north).

    Parameters
    ----------
    vertices : (N, 3) x east, y north, z up, metres from the local origin.
    triangles : (T, 3) indices of vertices; without any, the file holds an empty scene.
    uv, texture_rgb : (N, 2) and (h, w, 3) uint8, row 0 at v = 0; both or neither.
    extras : put under asset.extras, such as the CRS and the offset of the origin.
    """
    if (uv is None) != (texture_rgb is None):
        raise ValueError("a texture needs texture coordinates, and the reverse")
    builder = _Gltf(extras or {})
    if len(triangles):
        z_up = np.asarray(vertices, float)
        builder.add_mesh(_y_up(z_up), _y_up(_normals(z_up, triangles)), triangles, uv, texture_rgb)
    _write(Path(path), *builder.chunks())


def _y_up(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.column_stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]]).astype("<f4")


def _normals(vertices: NDArray[np.float64], triangles: NDArray[np.integer]) -> NDArray[np.float64]:
    """Unit normals (N, 3): the area-weighted mean of the triangles around each vertex; up where there is none."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.column_stack(
        [np.bincount(triangles.ravel(), np.repeat(faces[:, k], 3), len(vertices)) for k in range(3)]
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


class _Gltf:
    """A glTF document with one binary buffer."""

    def __init__(self, extras: Mapping[str, Any]):
        asset = {"version": "2.0", "generator": "seamosaic", "extras": dict(extras)}
        self.document: dict[str, Any] = {"asset": asset, "scene": 0, "scenes": [{"name": "seabed"}]}
        self.buffer = bytearray()

    def add_mesh(
        self,
        positions: NDArray[np.float32],
        normals: NDArray[np.float32],
        triangles: NDArray[np.integer],
        uv: NDArray[np.floating] | None,
        texture_rgb: NDArray[np.uint8] | None,
    ) -> None:
        bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
        attributes = {
            "POSITION": self._accessor(positions, "VEC3", _FLOAT, _ARRAY, bounds),
            "NORMAL": self._accessor(normals, "VEC3", _FLOAT, _ARRAY),
        }
        surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        if uv is not None and texture_rgb is not None:
            attributes["TEXCOORD_0"] = self._accessor(np.asarray(uv, "<f4"), "VEC2", _FLOAT, _ARRAY)
            surface["baseColorTexture"] = {"index": self._texture(texture_rgb)}
        else:
            surface["baseColorFactor"] = _GREY
        indices = self._accessor(np.asarray(triangles, "<u4").reshape(-1), "SCALAR", _UINT, _INDEX)
        self.document["materials"] = [{"name": "seabed", "pbrMetallicRoughness": surface, "doubleSided": True}]
        self.document["meshes"] = [
            {"name": "seabed", "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}
        ]
        self.document["nodes"] = [{"name": "seabed", "mesh": 0}]
        self.document["scenes"][0]["nodes"] = [0]

    def _accessor(
        self, values: NDArray[Any], kind: str, component: int, target: int, bounds: Mapping[str, Any] | None = None
    ) -> int:
        view = self._view(values.tobytes(), {"target": target})
        accessors = self.document.setdefault("accessors", [])
        accessors.append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind, **(bounds or {})}
        )
        return len(accessors) - 1

    def _texture(self, texture_rgb: NDArray[np.uint8]) -> int:
        stream = io.BytesIO()
        Image.fromarray(texture_rgb).save(stream, "JPEG", quality=_JPEG_QUALITY)
        self.document["images"] = [{"bufferView": self._view(stream.getvalue(), {}), "mimeType": "image/jpeg"}]
        clamp, linear, mipmap = 33071, 9729, 9987
        self.document["samplers"] = [{"magFilter": linear, "minFilter": mipmap, "wrapS": clamp, "wrapT": clamp}]
        self.document["textures"] = [{"sampler": 0, "source": 0}]
        return 0

    def _view(self, data: bytes, more: Mapping[str, Any]) -> int:
        views = self.document.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(data), **more})
        self.buffer += data + bytes(-len(data) % 4)
        return len(views) - 1

    def chunks(self) -> list[bytes]:
        """The GLB file: header, JSON chunk and, where there is anything, the binary chunk."""
        if self.buffer:
            self.document["buffers"] = [{"byteLength": len(self.buffer)}]
        text = json.dumps(self.document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        body = [struct.pack("<I4s", len(text), b"JSON"), text]
        if self.buffer:
            body += [struct.pack("<I4s", len(self.buffer), b"BIN\0"), bytes(self.buffer)]
        return [struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, body))), *body]


def _write(path: Path, *parts: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}")
    try:
        with temporary.open("wb") as file:
            file.writelines(parts)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
