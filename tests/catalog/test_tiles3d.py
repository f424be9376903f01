"""The tileset: its tree, boxes and errors, and where on the Earth it lies."""

import json

import numpy as np
import pyproj
import pytest
import trimesh
from seamosaic.catalog import meshes, tiles3d

UTM = pyproj.CRS("EPSG:32631+5714").to_wkt()
ORIGIN = np.array([512_000.0, 4_765_000.0, -20.0])


def _tree():
    leaves = [tiles3d.Node(f"0/{k}.glb", np.array([k, 0, 0.0]), np.array([k + 1, 1, 0.5]), 0.004, ()) for k in (0, 1)]
    return tiles3d.Node("1/0.glb", np.zeros(3), np.array([2, 1, 0.5]), 0.02, tuple(leaves))


def _written(path, crs=UTM):
    tiles3d.write_tileset(path / "tileset.json", [_tree()], crs, ORIGIN, {"offset": ORIGIN.tolist()})
    return json.loads((path / "tileset.json").read_text())


def _tiles(tile):
    yield tile
    for child in tile.get("children", []):
        yield from _tiles(child)


def test_the_tree_refines_from_coarse_to_fine(tmp_path):
    document = _written(tmp_path)
    assert document["asset"]["version"] == "1.1"
    root = document["root"]
    assert root["refine"] == "REPLACE"
    assert [tile.get("content", {}).get("uri") for tile in _tiles(root)] == [None, "1/0.glb", "0/0.glb", "0/1.glb"]
    for tile in _tiles(root):
        box = np.array(tile["boundingVolume"]["box"])
        half = np.abs(box[3:].reshape(3, 3)).sum(0)
        for child in tile.get("children", []):
            assert child["geometricError"] < tile["geometricError"] < document["geometricError"]
            inner = np.array(child["boundingVolume"]["box"])
            assert (np.abs(inner[:3] - box[:3]) + np.abs(inner[3:].reshape(3, 3)).sum(0) <= half + 1e-9).all()
    assert [tile["geometricError"] for tile in _tiles(root)][2:] == [0, 0]


def test_a_tile_without_triangles_leads_to_the_finer_ones(tmp_path):
    tree = _tree()._replace(uri=None)
    tiles3d.write_tileset(tmp_path / "tileset.json", [tree], UTM, ORIGIN, {})
    (tile,) = json.loads((tmp_path / "tileset.json").read_text())["root"]["children"]
    assert "content" not in tile
    assert tile["geometricError"] > 0
    assert [child["content"]["uri"] for child in tile["children"]] == ["0/0.glb", "0/1.glb"]


def test_the_map_lies_where_it_is_on_the_earth(tmp_path):
    matrix = np.array(_written(tmp_path)["root"]["transform"]).reshape(4, 4).T
    to_earth = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    for local in ([0, 0, 0], [120, -80, 1.5]):
        X = (matrix @ [*local, 1])[:3]
        longitude, latitude, height = to_earth.transform(*X)
        expected = pyproj.Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True).transform(
            *(ORIGIN + local)[:2]
        )
        assert (longitude, latitude) == pytest.approx(expected, abs=1e-7)  # a centimetre
        assert height == pytest.approx(ORIGIN[2] + local[2], abs=0.005)


def test_a_local_map_has_no_place(tmp_path):
    assert "transform" not in _written(tmp_path, None)["root"]


def test_content_opens_elsewhere(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.2]])
    part = meshes.Part(vertices, np.tile([0, 0, 1.0], (3, 1)), np.array([[0, 1, 2]]), vertices[:, :2])
    tiles3d.write_content(tmp_path / "0/0_0.glb", part)
    assert len(trimesh.load(tmp_path / "0/0_0.glb", force="mesh").faces) == 1


def test_a_map_without_a_triangle_has_an_empty_tileset(tmp_path):
    tiles3d.write_tileset(tmp_path / "tileset.json", [], UTM, ORIGIN, {})
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    assert (root["children"], root["geometricError"]) == ([], 0)
    assert np.isfinite(root["boundingVolume"]["box"]).all()
