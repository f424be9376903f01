"""mesh.ply, mesh.glb and mesh-3dtiles of a small mission."""

import json
import shutil

import numpy as np
import rasterio
import trimesh
from seamosaic.schemas.parameters import Parameters
from seamosaic.tasks.grids import Grid
from seamosaic.workflows import mesh_products, meshing
from seamosaic.workflows.job import Done
from seamosaic.workflows.run import run


def _whole(path):
    """Vertices (V, 3) x east, y north, z up, each place once, and triangles of all parts of a GLB."""
    parts = list(trimesh.load(path).geometry.values())
    vertices = np.concatenate([np.asarray(part.vertices) for part in parts])
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = np.concatenate([part.faces + k for part, k in zip(parts, first, strict=False)])
    places, number = np.unique(vertices, axis=0, return_inverse=True)
    return places[:, [0, 2, 1]] * [1, -1, 1], number.ravel()[triangles]


def test_the_mesh_has_no_crack_between_tiles_and_lies_on_the_bathymetry(reef):
    vertices, triangles = _whole(reef.result.path / "mesh.glb")
    edges, faces = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0, return_counts=True)
    assert faces.max() == 2
    with rasterio.open(reef.result.path / "bathymetry.tif") as file:
        z, cell = file.read(1, masked=True).filled(np.nan), file.res[0]
    column, row = np.rint(vertices[:, 0] / cell - 0.5).astype(int), np.rint(-vertices[:, 1] / cell - 0.5).astype(int)
    np.testing.assert_allclose(vertices[:, 2], z[row, column], atol=1e-5)
    # rims are where the neighbouring cells have no data, or at the map's edge
    hollow = np.pad(np.isnan(z), 1, constant_values=True)
    beside = np.any([hollow[row + i, column + j] for i in range(3) for j in range(3)], axis=0)
    assert beside[np.unique(edges[faces == 1])].all()
    quality = reef.result.quality.mesh
    assert len(triangles) == quality.triangles
    assert quality.level == 0
    assert cell / 8 < quality.error_m < cell
    coloured = trimesh.load(reef.result.path / "mesh.ply", process=False)
    assert (len(coloured.vertices), len(coloured.faces)) == (quality.vertices, quality.triangles)
    assert np.ptp(coloured.visual.vertex_colors[:, :3], axis=0).min() > 50


def test_tiles_of_the_mesh_are_all_there(reef):
    folder = reef.result.path / "mesh-3dtiles"
    tileset = json.loads((folder / "tileset.json").read_text())
    waiting, names = [tileset["root"]], []
    while waiting:
        tile = waiting.pop()
        waiting += tile.get("children", [])
        names += [tile["content"]["uri"]] if "content" in tile else []
    assert sorted(names) == sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.glb"))
    assert len(names) == reef.result.quality.mesh.tiles


def test_textures_of_the_mesh_are_made_as_small_as_asked(reef, tmp_path):
    shutil.copytree(reef.out, tmp_path / "out")
    parameters = Parameters.model_validate({"mesh": {"texture_px": 256}})
    result = run(str(reef.mission), tmp_path / "out", parameters, scheduler="sync")
    assert sum(step.count_computed for step in result.steps) == 0
    pixels = [
        sum(
            part.visual.material.baseColorTexture.width * part.visual.material.baseColorTexture.height
            for part in trimesh.load(path / "mesh.glb").geometry.values()
        )
        for path in (reef.result.path, result.path)
    ]
    assert 256**2 / 4.2 < pixels[1] < 256**2 * 1.02 < pixels[0]


def test_a_mission_too_large_for_one_file_is_a_coarser_level_of_its_pyramid():
    finest = list(meshing.leaves(Grid(0.02, -300, 900, 1500, 1200)))
    assert len(finest) == 7 * 6
    levels = meshing.levels(finest)
    assert [len(level) for level in levels] == [42, 12, 6, 4]
    pyramid = {
        place: Done("mesh", str(place), True, 0.0, {"triangles": 9000, "vertices": 5000, "error_m": 0.01})
        for level in levels
        for place in level
    }
    assert [mesh_products.level_of_file(pyramid, most) for most in (378_000, 377_999, 60_000, 10)] == [0, 1, 2, 3]
