"""The main job end to end on small simulated missions, with the real Dask schedulers."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import laspy
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import trimesh
import xarray
import yaml
from rio_cogeo import cog_validate
from seamosaic.catalog import memory, trajectories
from seamosaic.catalog.missions import open_mission
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.problems import InvalidInput
from seamosaic.schemas.products import PRODUCTS
from seamosaic.tasks import derivatives, grids
from seamosaic.tasks.camera import ground_sample_distance
from seamosaic.workflows import maps, mesh_products, plan, products
from seamosaic.workflows.calibrate_inputs import read_calibration
from seamosaic.workflows.evaluate import evaluate
from seamosaic.workflows.mapping import NothingToMap
from seamosaic.workflows.run import run

from tests.products import differing
from tests.simulated import small_mission


def _computed(result):
    return {step.name: step.count_computed for step in result.steps}


def test_every_product_is_there_and_opens_elsewhere(reef):
    folder = reef.result.path
    assert folder.name == "v1"
    for product in PRODUCTS:
        assert (folder / product.name).stat().st_size > 0, product.name
    for name in (
        "bathymetry",
        "uncertainty",
        "density",
        "source",
        "mosaic",
        "mosaic-source",
        "mosaic-painted",
        "mosaic-planar",
    ):
        assert cog_validate(folder / f"{name}.tif", quiet=True)[0], name
    with laspy.open(folder / "soundings.laz") as cloud:
        assert cloud.header.point_count == reef.result.quality.soundings.count > 1000
    for name in ("mesh.ply", "mesh.glb"):
        assert len(trimesh.load(folder / name, force="mesh").faces) > 100
    assert set(pyogrio.list_layers(folder / "survey.gpkg")[:, 0]) == {"footprints", "track", "contours", "coverage"}
    with xarray.open_dataset(folder / "bathymetry.nc") as layers:
        assert "elevation" in layers
    assert "<html" in (folder / "report.html").read_text()


def test_terrain_layers_of_tiles_have_the_bits_of_the_whole_map(reef, small_tiles):
    """Each run's layers against those of its whole bathymetry.tif at once."""
    for result in (reef.result, small_tiles):
        with rasterio.open(result.path / "bathymetry.tif") as file:
            z, cell = file.read(1, masked=True).filled(np.nan).astype(float), file.res[0]
        whole = derivatives.layers(z, cell, derivatives.Ring(1, 5), derivatives.Ring(5, 25))
        for name, values in whole.items():
            with rasterio.open(result.path / f"terrain/{name}.tif") as file:
                written = file.read(1, masked=True).filled(np.nan)
                assert file.tags().get("RING", "").startswith("5 to 25 cells, 0.1") == (name == "bpi-broad")
            assert np.isfinite(written).sum() > 1000
            assert np.array_equal(written, values, equal_nan=True), name


def test_terrain_layers_follow_their_rings_alone(reef, tmp_path):
    shutil.copytree(reef.out, tmp_path / "out")
    parameters = Parameters.model_validate({"terrain": {"broad": {"inner": 0.2, "outer": 0.4, "unit": "metres"}}})
    result = run(str(reef.mission), tmp_path / "out", parameters, scheduler="sync")
    assert {step for step, count in _computed(result).items() if count} == {"terrain"}
    scale = result.quality.terrain.bpi_broad
    assert scale.outer_cells == round(0.4 / result.quality.bathymetry.cell_m)
    assert scale.outer_m == pytest.approx(0.4, abs=result.quality.bathymetry.cell_m)
    too_wide = Parameters.model_validate({"terrain": {"broad": {"inner": 0, "outer": 90, "unit": "metres"}}})
    with pytest.raises(InvalidInput, match=r"terrain.broad.outer.*smaller ring"):
        run(str(reef.mission), tmp_path / "out", too_wide, scheduler="sync")


def test_contours_of_the_survey_lie_on_the_bathymetry(reef):
    _, _, geometries, (elevations,) = pyogrio.raw.read(reef.result.path / "survey.gpkg", layer="contours")
    assert len(geometries) > 5
    off = []
    with rasterio.open(reef.result.path / "bathymetry.tif") as file:
        for wkb, elevation in zip(geometries, elevations, strict=True):
            points = shapely.get_coordinates(shapely.from_wkb(wkb))
            found = np.array([value[0] for value in file.sample(points[::7])])
            off.append(np.abs(found[found > -9000] - elevation))
    assert np.median(np.concatenate(off)) < 0.02
    assert np.quantile(np.concatenate(off), 0.95) < 0.1
    interval = reef.result.quality.terrain.contour_interval_m
    assert np.allclose(elevations / interval, np.rint(elevations / interval))


def test_products_agree_with_the_truth(reef):
    """Both-sided: a map better than its photographs would be a copy of the truth."""
    measured = evaluate(reef.result.path, reef.mission)
    trajectory, bathymetry = measured["trajectory"], measured["bathymetry"]
    assert 1e-5 < trajectory["rigid_rms_m"] < 0.06
    assert trajectory["absolute_rms_m"] < 3 * 0.4
    assert abs(bathymetry["abs_bias_m"]) < 3 * 0.0323
    assert 5e-4 < bathymetry["median_abs_m"] < 0.01


def test_the_laser_is_gone_from_the_mosaic(reef):
    with rasterio.open(reef.result.path / "mosaic.tif") as file:
        red, green, blue = file.read().astype(int)
        excess = (green - np.maximum(red, blue))[file.dataset_mask() > 0]
    assert (excess > 60).mean() < 2e-3


def test_what_only_the_laser_shows_is_marked(reef):
    with (
        rasterio.open(reef.result.path / "mosaic-painted.tif") as marked,
        rasterio.open(reef.result.path / "mosaic.tif") as mosaic,
    ):
        painted, there = marked.read(1) > 0, mosaic.dataset_mask() > 0
    assert not (painted & ~there).any()
    share = reef.result.quality.mosaic.painted_share
    assert painted.sum() / there.sum() == pytest.approx(share, rel=1e-6)
    assert 1e-4 < share < 0.1  # the cross in images at the edge of a survey of 8


def test_mosaic_source_counts_rows_of_the_trajectory(reef):
    rows = trajectories.read(reef.result.path / "trajectory.csv")
    with rasterio.open(reef.result.path / "mosaic-source.tif") as file:
        numbers = set(np.unique(file.read(1)).tolist())
    assert numbers <= {-1, *range(len(rows))}
    assert len(numbers) > len(rows) / 2


def test_provenance_names_every_input_step_and_output(reef):
    provenance = json.loads((reef.result.path / "metadata/provenance.json").read_text())
    inputs = {path.relative_to(reef.mission).as_posix() for path in reef.mission.rglob("*") if path.is_file()}
    assert set(provenance["inputs"]) == {name for name in inputs if not name.startswith("truth/")}
    counts = {step["name"]: step["count_total"] for step in provenance["steps"]}
    assert counts["extract"] == 8
    assert counts["adjust"] == 1
    assert provenance["parameters"]["grid"]["cell_m"] >= 0.02
    assert {"bathymetry.tif", "report.html"} <= set(provenance["outputs"])


def test_a_second_run_computes_nothing_and_makes_no_version(reef):
    again = run(str(reef.mission), reef.out, Parameters(), scheduler="sync")
    assert again.steps == ()  # it was not even looked at
    assert (again.path, again.new) == (reef.result.path, False)


def test_coarse_cells_are_the_same_whatever_is_held_at_a_time(reef, tmp_path, monkeypatch):
    parameters, found = Parameters.model_validate({"grid": {"cell_m": 0.3}}), []
    for most in (maps._FINE_CELLS, 40):
        out = tmp_path / str(most)
        shutil.copytree(reef.out, out)
        monkeypatch.setattr(maps, "_FINE_CELLS", most)
        with rasterio.open(run(str(reef.mission), out, parameters, scheduler="sync").path / "bathymetry.tif") as raster:
            found.append(raster.read())
    assert np.isfinite(found[0][0]).sum() > 50
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)


def test_a_mission_is_never_written_to(reef):
    for out in (reef.mission, reef.mission / "maps"):
        with pytest.raises(InvalidInput, match="a folder of the mission itself"):
            run(str(reef.mission), out, Parameters(), scheduler="sync")
    assert not (reef.mission / "maps").exists()


def test_another_cell_size_makes_the_bathymetry_only(reef, tmp_path, monkeypatch):
    """Mosaics, mesh and soundings are those of the version before, file by file."""
    out = tmp_path / "out"
    shutil.copytree(reef.out, out)
    for owner, name in ((products, "_write_mosaic"), (products, "_write_soundings"), (mesh_products, "write")):
        monkeypatch.setattr(owner, name, None)
    parameters = Parameters.model_validate({"grid": {"cell_m": 0.05}})
    result = run(str(reef.mission), out, parameters, scheduler="sync")
    computed = _computed(result)
    kept = ("extract", "match", "adjust", "ties", "dense", "agreement", "lighting", "planar-align", "mosaic", "mesh")
    assert {step: computed[step] for step in kept} == dict.fromkeys(kept, 0)
    assert computed["surface"] == computed["terrain"] > 0
    assert (computed["cells"] > 0) == (reef.result.quality.bathymetry.cell_m > 0.05)  # coarser ones are made of these
    assert result.path.name == "v2"
    with (
        rasterio.open(result.path / "bathymetry.tif") as new,
        rasterio.open(out / result.path.parent.name / "v1/bathymetry.tif") as old,
    ):
        assert (new.res[0], old.res[0]) == (0.05, reef.result.quality.bathymetry.cell_m)
        assert abs(round(new.bounds.left / 0.05) * 0.05 - new.bounds.left) < 1e-6
    old, new = (json.loads((path / "metadata/provenance.json").read_text()) for path in (reef.result.path, result.path))
    shared = {name for name in old["outputs"] if old["outputs"][name] == new["outputs"].get(name)}
    assert {"mosaic.tif", "mosaic-planar.tif", "mesh.glb", "mesh-3dtiles/tileset.json", "soundings.laz"} <= shared
    assert "bathymetry.tif" not in shared
    assert result.quality.mesh == reef.result.quality.mesh


def test_another_image_makes_only_what_depends_on_it(reef, tmp_path):
    """Another file with the same pixels: its extraction, its pairs and the adjustment; poses are what they were."""
    mission, out = tmp_path / "mission", tmp_path / "out"
    shutil.copytree(reef.mission, mission)
    shutil.copytree(reef.out, out)
    opened = open_mission(str(mission))
    wanted = plan.first_pairs(plan.plan(opened, Parameters()), opened, Parameters())
    image = mission / str(opened.frames["image"].values[0])
    image.write_bytes(image.read_bytes() + bytes(8))
    result = run(str(mission), out, Parameters(), scheduler="sync")
    computed, total = _computed(result), {step.name: step.count_total for step in result.steps}
    assert (computed["extract"], computed["adjust"]) == (1, 1)
    assert computed["match"] == sum(0 in pair.rows for pair in wanted) < total["match"] == len(wanted)
    assert 0 < computed["ties"] <= computed["match"] < total["ties"]
    assert 0 < computed["dense"] <= computed["match"] < total["dense"]
    assert result.path.name == "v2"
    assert differing(reef.result.path, result.path) == ["metadata/provenance.json"]


def test_what_the_calibration_leaves_open_is_in_every_sigma(reef, tmp_path):
    mission, out = tmp_path / "mission", tmp_path / "out"
    shutil.copytree(reef.mission, mission)
    shutil.copytree(reef.out, out)
    content = yaml.safe_load((mission / "calibration.yaml").read_text())
    content["covariance"] = [
        {"parameters": ["laser.planes.a.offset", "laser.planes.b.offset"], "matrix": [[4e-6, 4e-6]] * 2}
    ]
    (mission / "calibration.yaml").write_text(yaml.safe_dump(content))
    result = run(str(mission), out, Parameters(), scheduler="sync")
    assert sum(_computed(result).values()) == 0
    common = result.quality.calibration.sigma_m
    assert 0.002 < common < 0.02  # 2 mm at the sheet, along rays that meet it at a slant
    assert reef.result.quality.calibration.sigma_m is None
    before, after = (folder / "uncertainty.tif" for folder in (reef.result.path, result.path))
    with rasterio.open(before) as old, rasterio.open(after) as new:
        a, b = old.read(1, masked=True), new.read(1, masked=True)
    assert (a.mask == b.mask).all()
    assert b.compressed() == pytest.approx(np.hypot(a.compressed(), common), rel=1e-4)
    sigmas = [np.asarray(laspy.read(path / "soundings.laz")["sigma"]) for path in (reef.result.path, result.path)]
    added = np.sqrt(sigmas[1] ** 2 - sigmas[0] ** 2)
    assert np.median(added) == pytest.approx(common, rel=0.05)
    assert "Error of the calibration" in (result.path / "report.html").read_text()


def test_dense_matching_can_be_left_out_and_measured_cells_become_interpolated(reef, tmp_path):
    shutil.copytree(reef.out, tmp_path / "out")
    parameters = Parameters.model_validate({"bathymetry": {"dense": False}})
    result = run(str(reef.mission), tmp_path / "out", parameters, scheduler="sync")
    assert _computed(result)["dense"] == 0
    shares = [one.quality.bathymetry.by_source for one in (result, reef.result)]
    assert 0.02 < shares[0].image_matching < 0.22
    assert 0.24 < shares[1].image_matching < 0.6
    errors = [evaluate(one.path, reef.mission)["bathymetry"]["median_abs_m"] for one in (result, reef.result)]
    assert all(0.0005 < error < 0.006 for error in errors)
    fewer = Parameters.model_validate({"bathymetry": {"pairs_per_image": 1}})
    assert _computed(run(str(reef.mission), tmp_path / "out", fewer, scheduler="sync"))["dense"] == 0


@pytest.fixture(scope="module")
def small_tiles(reef, tmp_path_factory):
    out = tmp_path_factory.mktemp("small-tiles") / "out"
    shutil.copytree(reef.out, out)
    parameters = Parameters.model_validate({"grid": {"tile_cells": 64}, "mosaic": {"tile_cells": 512}})
    return run(str(reef.mission), out, parameters, scheduler="sync")


def test_small_tiles_many_of_them_empty_give_the_same_maps(reef, small_tiles):
    """The track runs across the map: no image touches the tiles in its corners."""
    result = small_tiles
    assert _computed(result)["cells"] > 6
    for name in ("bathymetry.tif", "source.tif", "mosaic-source.tif"):
        with rasterio.open(result.path / name) as small, rasterio.open(reef.result.path / name) as large:
            a, b = small.read(1, masked=True), large.read(1, masked=True)
        assert a.shape == b.shape
        # which interpolated cells are too uncertain to show is decided by what sampled tiles have in common
        assert (a.mask == b.mask).mean() > 0.998, name
        both = ~a.mask & ~b.mask
        assert (a.data == b.data)[both].mean() > 0.9999, name


def test_an_image_without_a_time_is_a_row_of_its_own(reef, spoilt, tmp_path):
    mission, image = spoilt
    shutil.copytree(reef.out, tmp_path / "out")  # most of it is done
    image.rename(image.with_name("V_untimed.jpg"))
    result = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync")
    assert result.quality.pairs.linked > 3
    assert result.quality.trajectory.rejected == 1


def test_processes_give_the_same_data_as_one_thread(reef, tmp_path):
    result = run(str(reef.mission), tmp_path, Parameters(), workers=2)
    assert differing(result.path, reef.result.path) == []


def _wait_for(folder: Path, count: int, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 120
    while len(list(folder.rglob("*.npz"))) < count:
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_killed_run_goes_on_where_it_stopped(reef, tmp_path):
    command = [sys.executable, "-m", "seamosaic.workflows.cli", "run", str(reef.mission), "-o", str(tmp_path)]
    process = subprocess.Popen([*command, "--scheduler", "sync"], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    steps = tmp_path / reef.result.path.parent.name / "steps"
    _wait_for(steps / "extract", 3, process)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not list(tmp_path.glob("*/v*"))
    kept = {path for path in steps.rglob("*.npz")}
    result = run(str(reef.mission), tmp_path, Parameters(), scheduler="sync")
    total = {step.name: step.count_total for step in result.steps}
    assert 3 <= len(kept) == sum(total.values()) - sum(_computed(result).values())
    assert differing(result.path, reef.result.path) == []


@pytest.fixture
def spoilt(reef, tmp_path):
    """A copy of the mission and its third image, to be spoilt."""
    mission = tmp_path / "mission"
    shutil.copytree(reef.mission, mission)
    image = sorted((mission / "images").iterdir())[2]
    return mission, image


def test_a_bad_image_is_recorded_and_the_run_goes_on(reef, spoilt, tmp_path):
    mission, image = spoilt
    shutil.copytree(reef.out, tmp_path / "out")  # most of it is done
    image.write_bytes(image.read_bytes()[:2000])
    result = run(str(mission), tmp_path / "out", Parameters(), scheduler="threads", workers=2)
    rows = trajectories.read(result.path / "trajectory.csv")
    assert [row.kind for row in rows].count("rejected") == 1
    row = next(row for row in rows if row.kind == "rejected")
    assert row.image.endswith(image.name)
    assert "truncated" in row.status
    assert image.name in (result.path / "report.html").read_text()


def test_an_image_changed_during_the_run_is_rejected(spoilt, tmp_path, monkeypatch):
    mission, image = spoilt
    opened = memory.open_known

    def replaced(*arguments):
        found = opened(*arguments)
        shutil.copy(sorted((mission / "images").iterdir())[4], image)
        return found

    monkeypatch.setattr(memory, "open_known", replaced)
    result = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync")
    rows = trajectories.read(result.path / "trajectory.csv")
    (status,) = (row.status for row in rows if row.kind == "rejected")
    assert "changed while the mission was being processed" in status
    monkeypatch.undo()
    again = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync")  # nothing of it is remembered
    assert not any(row.kind == "rejected" for row in trajectories.read(again.path / "trajectory.csv"))


def test_a_mission_of_black_images_says_that_there_is_nothing_to_map(tiny_mission, tmp_path):
    with pytest.raises(NothingToMap, match="nothing to map"):
        run(str(tiny_mission), tmp_path / "out", Parameters(), scheduler="sync")


def test_no_scheduler_at_the_address(tiny_mission, tmp_path):
    with pytest.raises(InvalidInput, match="scheduler"):
        run(str(tiny_mission), tmp_path / "out", Parameters(), scheduler="nowhere:1")


@pytest.mark.parametrize("scene", ["pool", "night", "pairs"])
def test_without_navigation_without_light_and_in_turns(scene, tmp_path):
    mission = small_mission(tmp_path / "mission", scene, images=8)
    result = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync")
    quality = result.quality
    placed = quality.trajectory.adjusted + quality.trajectory.navigation_only
    assert placed == quality.mission.images.total
    assert quality.bathymetry.cells > 500
    assert quality.soundings.count > 500
    assert (quality.mission.crs is None) == (scene == "pool")
    assert quality.soundings.per_image_median > 100
    assert (quality.mosaic is not None) == (quality.pairs.tried > 0) == (scene != "night")
    if quality.mosaic:
        assert quality.mosaic.area_m2 > 1
        assert 0.5 < quality.mosaic.coverage_share <= 1
    if scene == "pairs":  # laser images sound for the texture images beside them
        assert 0 < abs(evaluate(result.path, mission)["trajectory"]["scale_error_pct"]) < 1


def test_photographs_turned_by_a_viewer_are_placed_and_named(tmp_path):
    mission = small_mission(tmp_path / "mission", "reef", images=4, survey={"lines": 1})
    turned = sorted((mission / "images").iterdir())[:1]
    for path in turned:
        image = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.rotate(image, cv2.ROTATE_180), [cv2.IMWRITE_JPEG_QUALITY, 95])
    _without_laser(mission)
    quality = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync").quality
    assert quality.trajectory.adjusted == 4
    (warning,) = [text for text in quality.warnings if "other way round" in text]
    assert warning.startswith("1 of 4 images")
    assert turned[0].name in warning


def test_matches_tell_the_height_where_neither_laser_nor_altimeter_does(tmp_path):
    mission = small_mission(tmp_path / "mission", "reef", images=4, survey={"lines": 1, "altitude_m": 5.0})
    _without_laser(mission)
    head, *rows = [line.split(",") for line in (mission / "navigation.csv").read_text().split()]
    for row in rows:
        row[head.index("altitude")] = ""
    (mission / "navigation.csv").write_text("".join(",".join(row) + "\n" for row in [head, *rows]))
    made = run(str(mission), tmp_path / "out", Parameters(), scheduler="sync")
    camera = read_calibration(mission / "calibration.yaml").camera
    expected = grids.bathymetry_cell_m(ground_sample_distance(camera, 4.9))
    with rasterio.open(made.path / "bathymetry.tif") as raster:
        assert raster.res[0] == pytest.approx(expected, rel=0.15)


def _without_laser(mission):
    """Strobe images only: a turned photograph would show the laser where no calibration has it."""
    for name, key in (("calibration.yaml", "laser"), ("mission.yaml", "")):
        document = yaml.safe_load((mission / name).read_text())
        document.pop(key, None)
        for entry in document.get("images", []):
            entry["role"] = "texture"
        (mission / name).write_text(yaml.safe_dump(document))
