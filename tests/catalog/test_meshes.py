"""Meshes, read back with trimesh."""

import io
import json
import struct

import numpy as np
import pyproj
import pytest
import trimesh
from PIL import Image
from seamosaic.catalog import meshes
from seamosaic.tasks.open3d_loader import load_open3d

RED, GREEN, BLUE, WHITE = (220, 30, 30), (30, 200, 30), (30, 30, 220), (240, 240, 240)
EAST, NORTH = 4.0, 2.0


def surface(n=21):
    """A slope that rises northwards by a quarter, with triangles counter-clockwise from above."""
    y, x = np.meshgrid(np.linspace(0, NORTH, n), np.linspace(0, EAST, n), indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), y.ravel() / 4])
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def picture():
    """A map with north up: red north-west, green north-east, blue south-west, white south-east."""
    texture = np.zeros((128, 256, 3), np.uint8)
    texture[:64, :128], texture[:64, 128:], texture[64:, :128], texture[64:, 128:] = RED, GREEN, BLUE, WHITE
    return texture


def texture_coordinates(vertices):
    return np.column_stack([vertices[:, 0] / EAST, 1 - vertices[:, 1] / NORTH])


def jpeg(texture):
    stream = io.BytesIO()
    Image.fromarray(texture).save(stream, "JPEG", quality=90)
    return stream.getvalue()


def part(n=21, textured=True, east=0.0):
    vertices, triangles = surface(n)
    normals = np.tile(np.array([0, -0.25, 1]) / np.hypot(1, 0.25), (len(vertices), 1))
    picture_ = jpeg(picture()) if textured else None
    return meshes.Part(vertices + [east, 0, 0], normals, triangles, texture_coordinates(vertices), picture_)


def load(path):
    scene = trimesh.load(path, process=False)
    (mesh,) = scene.geometry.values()
    return mesh


def test_glb_is_y_up_and_of_the_right_size(tmp_path):
    vertices, triangles = surface()
    meshes.write_glb(tmp_path / "mesh.glb", [part(textured=False)])
    mesh = load(tmp_path / "mesh.glb")
    np.testing.assert_allclose(mesh.vertices[:, 0], vertices[:, 0], atol=1e-6)  # x is east
    np.testing.assert_allclose(mesh.vertices[:, 1], vertices[:, 2], atol=1e-6)  # y is up
    np.testing.assert_allclose(mesh.vertices[:, 2], -vertices[:, 1], atol=1e-6)  # z is south
    np.testing.assert_array_equal(mesh.faces, triangles)
    assert mesh.area == pytest.approx(EAST * NORTH * np.hypot(1, 0.25), rel=1e-6)
    # seen from above we look at its front, and the stored normals agree with the triangles
    expected = np.array([0, 1, 0.25]) / np.hypot(1, 0.25)
    np.testing.assert_allclose(mesh.face_normals, np.tile(expected, (len(triangles), 1)), atol=1e-5)
    np.testing.assert_allclose(mesh.vertex_normals, np.tile(expected, (len(vertices), 1)), atol=1e-5)


@pytest.mark.parametrize(
    ("east", "north", "colour"), [(0.2, 0.8, RED), (0.8, 0.8, GREEN), (0.2, 0.2, BLUE), (0.8, 0.2, WHITE)]
)
def test_texture_is_the_right_way_up(tmp_path, east, north, colour):
    meshes.write_glb(tmp_path / "mesh.glb", [part()])
    mesh = load(tmp_path / "mesh.glb")
    place = [east * EAST, mesh.vertices[:, 1].mean(), -north * NORTH]
    nearest = np.argmin(np.linalg.norm(np.delete(mesh.vertices - place, 1, axis=1), axis=1))
    found = trimesh.visual.color.uv_to_color(mesh.visual.uv[[nearest]], mesh.visual.material.baseColorTexture)[0]
    np.testing.assert_allclose(found[:3], colour, atol=12)


def test_glb_metadata_and_texture_format(tmp_path):
    extras = {"crs": "EPSG:32631", "offset": [5e5, 4.7e6, -20.0]}
    meshes.write_glb(tmp_path / "m.glb", [part(5)], extras)
    data = (tmp_path / "m.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    assert document["asset"]["extras"] == extras
    assert document["images"][0]["mimeType"] == "image/jpeg"
    assert load(tmp_path / "m.glb").visual.material.baseColorTexture.size == (256, 128)


def test_parts_have_their_own_textures_and_large_ones_longer_indices(tmp_path):
    parts = [part(5), part(260, textured=False, east=4.0), part(7, east=8.0)]
    meshes.write_glb(tmp_path / "m.glb", parts)
    scene = trimesh.load(tmp_path / "m.glb", process=False)
    found = sorted(scene.geometry.values(), key=lambda mesh: mesh.bounds[0, 0])
    for mesh, given in zip(found, parts, strict=True):
        np.testing.assert_array_equal(mesh.faces, given.triangles)
        np.testing.assert_allclose(mesh.vertices[:, 0], given.vertices[:, 0], atol=1e-6)
        assert (mesh.visual.material.baseColorTexture is None) == (given.texture is None)


def test_ply_keeps_axes_colours_and_comments(tmp_path):
    vertices, triangles = surface(5)
    colours = np.arange(len(vertices) * 3, dtype=np.uint8).reshape(-1, 3)
    meshes.write_ply(
        tmp_path / "m.ply", vertices, triangles, colours, comments=["crs EPSG:32631", "offset 5e5 4.7e6 0"]
    )
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, triangles)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], colours)
    header = (tmp_path / "m.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert header[1] == "format binary_little_endian 1.0"
    assert "comment crs EPSG:32631" in header
    assert "comment offset 5e5 4.7e6 0" in header


def test_programs_that_take_short_header_lines_read_a_ply_with_a_long_crs(tmp_path):
    vertices, triangles = surface(5)
    wkt = pyproj.CRS("+proj=tmerc +lon_0=3.1 +ellps=WGS84 +units=m").to_wkt() * 2
    meshes.write_ply(tmp_path / "m.ply", vertices, triangles, comments=[f"crs {wkt}"])
    header = (tmp_path / "m.ply").read_bytes().partition(b"end_header")[0].splitlines()
    assert max(map(len, header)) < 1000 < len(wkt)
    comments = [line.removeprefix(b"comment ").decode() for line in header if line.startswith(b"comment")]
    assert "".join(comments).replace(" ", "") == f"crs {wkt}".replace(" ", "")
    read = load_open3d().io.read_triangle_mesh(str(tmp_path / "m.ply"))
    assert len(read.triangles) == len(triangles)


def test_an_empty_surface_is_a_readable_file(tmp_path):
    nothing, none = np.zeros((0, 3)), np.zeros((0, 3), int)
    meshes.write_glb(tmp_path / "m.glb", [meshes.Part(nothing, nothing, none, nothing[:, :2])])
    meshes.write_ply(tmp_path / "m.ply", nothing, none)
    assert trimesh.load(tmp_path / "m.glb").is_empty
    assert trimesh.load(tmp_path / "m.ply").is_empty
