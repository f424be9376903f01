"""mesh.ply and mesh.glb: the surface about a local origin (map coordinates = vertex + offset).

Triangles are counter-clockwise seen from above. Texture coordinates are (u, v) with u to the right and v DOWN from
the top left corner of the texture, in units of its width and height.
"""

import json
import os
import struct
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

_FLOAT, _UINT, _USHORT, _ARRAY, _INDEX = 5126, 5125, 5123, 34962, 34963
_MOST_SHORT: Final = 65535  # vertices; the number 65535 itself ends a strip
_GREY: Final = [0.6, 0.6, 0.6, 1.0]


def write_ply(
    path: str | os.PathLike[str],
    vertices: NDArray[np.floating],
    triangles: NDArray[np.integer],
    colours: NDArray[np.uint8] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary little-endian PLY.

    Parameters
    ----------
    vertices : (N, 3) x east, y north, z up, metres from the local origin.
    triangles : (T, 3) indices of vertices.
    colours : (N, 3) RGB.
    comments : header lines, such as the CRS and the offset of the origin.
    """
    fields = [(name, "<f4") for name in "xyz"]
    fields += [(name, "u1") for name in ("red", "green", "blue")] if colours is not None else []
    points = np.zeros(len(vertices), fields)
    points["x"], points["y"], points["z"] = np.asarray(vertices).T
    if colours is not None:
        points["red"], points["green"], points["blue"] = colours.T
    faces = np.zeros(len(triangles), [("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, triangles
    _write(Path(path), _ply_header(fields, len(points), len(faces), comments), points.tobytes(), faces.tobytes())


def _ply_header(fields: list[tuple[str, str]], points: int, faces: int, comments: Sequence[str]) -> bytes:
    types = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0"]
    # readers take lines of at most 1,023 bytes
    pieces = [piece for comment in comments for line in comment.splitlines() for piece in textwrap.wrap(line, 900)]
    lines += [f"comment {piece}" for piece in pieces]
    lines += [f"element vertex {points}", *(f"property {types[kind]} {name}" for name, kind in fields)]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii", "replace")


class Part(NamedTuple):
    """A piece of a surface with a texture of its own.

    Attributes
    ----------
    vertices : (N, 3) x east, y north, z up, metres from the local origin.
    normals : (N, 3) unit vectors along the same axes.
    triangles : (T, 3) indices of vertices.
    uv : (N, 2) texture coordinates.
    texture : a JPEG file, row 0 at v = 0; None for grey.
    """

    vertices: NDArray[np.floating]
    normals: NDArray[np.floating]
    triangles: NDArray[np.integer]
    uv: NDArray[np.floating]
    texture: bytes | None = None


def write_glb(path: str | os.PathLike[str], parts: Sequence[Part], extras: Mapping[str, Any] | None = None) -> None:
    """Write a binary glTF 2.0; without any triangle it holds an empty scene.

    glTF is y up: a vertex (east, north, up) is stored as (east, up, -north).

    Parameters
    ----------
    extras : put under asset.extras, such as the CRS and the offset of the origin.
    """
    builder = _Gltf(extras or {})
    for part in parts:
        if len(part.triangles):
            builder.add(part)
    _write(Path(path), *builder.chunks())


def _y_up(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.column_stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]]).astype("<f4")


class _Gltf:
    """A glTF document with one binary buffer."""

    def __init__(self, extras: Mapping[str, Any]):
        asset = {"version": "2.0", "generator": "seamosaic", "extras": dict(extras)}
        self.document: dict[str, Any] = {"asset": asset, "scene": 0, "scenes": [{"name": "seabed"}]}
        self.buffer = bytearray()

    def add(self, part: Part) -> None:
        positions = _y_up(part.vertices)
        bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
        attributes = {
            "POSITION": self._accessor(positions, "VEC3", _FLOAT, _ARRAY, bounds),
            "NORMAL": self._accessor(_y_up(part.normals), "VEC3", _FLOAT, _ARRAY),
        }
        look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        if part.texture is not None:
            attributes["TEXCOORD_0"] = self._accessor(np.asarray(part.uv, "<f4"), "VEC2", _FLOAT, _ARRAY)
            look["baseColorTexture"] = {"index": self._texture(part.texture)}
        else:
            look["baseColorFactor"] = _GREY
        small = len(positions) < _MOST_SHORT
        indices = np.asarray(part.triangles, "<u2" if small else "<u4").reshape(-1)
        primitive = {
            "attributes": attributes,
            "indices": self._accessor(indices, "SCALAR", _USHORT if small else _UINT, _INDEX),
            "material": self._listed("materials", {"pbrMetallicRoughness": look, "doubleSided": True}),
        }
        mesh = self._listed("meshes", {"primitives": [primitive]})
        node = self._listed("nodes", {"name": f"seabed-{mesh}", "mesh": mesh})
        self.document["scenes"][0].setdefault("nodes", []).append(node)

    def _listed(self, kind: str, item: Mapping[str, Any]) -> int:
        """The number of an item that is added to a list of the document."""
        items = self.document.setdefault(kind, [])
        items.append(dict(item))
        return len(items) - 1

    def _accessor(
        self, values: NDArray[Any], kind: str, component: int, target: int, bounds: Mapping[str, Any] | None = None
    ) -> int:
        view = self._view(values.tobytes(), {"target": target})
        about = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        return self._listed("accessors", {**about, **(bounds or {})})

    def _texture(self, jpeg: bytes) -> int:
        clamp, linear, mipmap = 33071, 9729, 9987
        if "samplers" not in self.document:
            self._listed("samplers", {"magFilter": linear, "minFilter": mipmap, "wrapS": clamp, "wrapT": clamp})
        image = self._listed("images", {"bufferView": self._view(jpeg, {}), "mimeType": "image/jpeg"})
        return self._listed("textures", {"sampler": 0, "source": image})

    def _view(self, data: bytes, more: Mapping[str, Any]) -> int:
        about = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(data), **more}
        self.buffer += data + bytes(-len(data) % 4)
        return self._listed("bufferViews", about)

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
