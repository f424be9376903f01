"""`seamosaic evaluate` on products made from a truth with known errors."""

import json
import os
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio import Affine
from seamosaic.catalog import trajectories
from seamosaic.schemas.problems import InvalidInput
from seamosaic.tasks.frames import MapFrame
from seamosaic.tasks.rotations import quaternion_wxyz
from seamosaic.workflows.evaluate import evaluate
from seamosaic.workflows.simulate import simulate

from tests.simulated import Truth, read_truth
from tests.simulated import height_of as truth_height

CRS = "EPSG:32632"
CELL_M = 0.04
BIAS_M, NOISE_M, MOVE_M = 0.05, 0.004, 0.12


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("missions") / "reef"
    return simulate(
        "reef",
        folder,
        seed=3,
        images=4,
        width=96,
        survey={"lines": 2},
        texture={"cell_m": 0.02},
        terrain={"cell_m": 0.02},
    )


@pytest.fixture(scope="module")
def truth(mission: Path) -> Truth:
    return read_truth(mission)


def _frame(local: bool) -> MapFrame:
    return MapFrame(None if local else pyproj.CRS(CRS).to_wkt(), 43.0421, 6.0127)


def _products(folder: Path, truth: Truth, local: bool = False, move_m: float = MOVE_M) -> Path:
    """Products as a run would leave them: everything move_m east, BIAS_M up, with noise, sigma stated right."""
    rng, frame = np.random.default_rng(0), _frame(local)
    folder.mkdir(parents=True)
    C = truth.poses.C_local + [move_m, 0, BIAS_M] + NOISE_M * rng.standard_normal((len(truth.images), 3))
    C_map = frame.map_from_local(C)
    if local:
        C_map = C_map @ np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]) + [3.0, 4.0, 10.0]
    quaternions = quaternion_wxyz(truth.poses.R_local_camera)
    trajectories.write(
        folder / "trajectory.csv",
        [
            trajectories.Row(
                f"images/{name}",
                np.datetime64("2026-06-03T00:00:00", "us") + k,
                trajectories.Pose(tuple(c), tuple(q), (0.01, 0.01, 0.01)),
                "adjusted",
            )
            for k, (name, c, q) in enumerate(zip(truth.images, C_map, quaternions, strict=True))
        ],
    )
    _bathymetry(folder, truth, frame, C_map, local, move_m, rng)
    return folder


def _bathymetry(folder: Path, truth: Truth, frame: MapFrame, C_map, local: bool, move_m: float, rng) -> None:
    left, top = (np.floor((C_map[:, :2].min(axis=0) - 1)[0] / CELL_M), np.ceil((C_map[:, 1].max() + 1) / CELL_M))
    width, height = (int((np.ptp(C_map[:, k]) + 2) / CELL_M) for k in (0, 1))
    x, y = np.meshgrid((left + np.arange(width) + 0.5) * CELL_M, (top - np.arange(height) - 0.5) * CELL_M)
    X = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, C_map[0, 2] - 2.7)])
    if local:
        X = (X - [3.0, 4.0, 10.0]) @ np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    at = frame.local_from_map(X)
    z = truth_height(truth, at[:, 0] - move_m, at[:, 1]) + BIAS_M + NOISE_M * rng.standard_normal(x.size)
    z += 10.0 if local else 0.0
    z = z.reshape(x.shape).astype(np.float32)
    z[: height // 5] = -9999
    sigma = np.where(z > -9000, NOISE_M, -9999).astype(np.float32)
    engineering = 'LOCAL_CS["local",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    profile = {
        "driver": "GTiff", "dtype": "float32", "count": 1, "height": height, "width": width, "nodata": -9999,
        "crs": engineering if local else CRS, "transform": Affine(CELL_M, 0, left * CELL_M, 0, -CELL_M, top * CELL_M),
    }  # fmt: skip
    for name, values in (("bathymetry.tif", z), ("uncertainty.tif", sigma)):
        with rasterio.open(folder / name, "w", **profile) as file:
            file.write(values, 1)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, truth: Truth) -> Path:
    out = tmp_path_factory.mktemp("out")
    _products(out / "reef-3" / "v2", truth)
    (out / "reef-3" / "v1").mkdir()
    return out


@pytest.fixture(scope="module")
def figures(out: Path, mission: Path) -> dict:
    return evaluate(out, mission)


def test_trajectory_has_the_errors_put_in(figures: dict):
    trajectory = figures["trajectory"]
    assert trajectory["frames"] == trajectory["of"] == 4
    assert trajectory["absolute_rms_m"] == pytest.approx(np.hypot(MOVE_M, BIAS_M), rel=0.1)
    # four points, of which a rigid motion takes six of twelve degrees of freedom
    assert 0.2 * NOISE_M < trajectory["rigid_rms_m"] < 3 * NOISE_M
    assert trajectory["similarity_rms_m"] <= trajectory["rigid_rms_m"]
    assert abs(trajectory["scale_error_pct"]) < 1.5


def test_bathymetry_has_the_errors_put_in(figures: dict):
    bathymetry = figures["bathymetry"]
    assert bathymetry["abs_bias_m"] == pytest.approx(BIAS_M, abs=0.02)
    assert abs(bathymetry["abs_bias_m"]) < bathymetry["abs_rmse_m"] < 2 * BIAS_M
    assert bathymetry["shift_m"][0] == pytest.approx(-MOVE_M, abs=0.01)
    assert bathymetry["shift_m"][2] == pytest.approx(-BIAS_M, abs=0.005)
    assert 0.9 * NOISE_M < bathymetry["rmse_m"] < 1.2 * NOISE_M
    assert bathymetry["median_abs_m"] == pytest.approx(0.6745 * NOISE_M, rel=0.1)
    assert bathymetry["p95_abs_m"] == pytest.approx(1.96 * NOISE_M, rel=0.1)
    assert 0.64 < bathymetry["within_1sigma"] < 0.71
    assert 0.92 < bathymetry["within_2sigma"] < 0.97
    assert 0.3 < bathymetry["completeness_seen"] < 0.95
    # everything is too high by the same, so altitudes are right: but for centimetres of relief beside the nadir
    assert abs(bathymetry["altitude_bias_pct"]) < 1.5


@pytest.mark.parametrize("level", ["reef-3", "reef-3/v2"])
def test_takes_any_level_of_the_products(out: Path, mission: Path, level: str):
    assert evaluate(out / level, mission / "truth")["products"] == str(out / "reef-3" / "v2")


def test_mission_without_navigation_is_laid_on_the_truth(tmp_path: Path, mission: Path, truth: Truth):
    figures = evaluate(_products(tmp_path / "free", truth, local=True), mission)
    assert "absolute_rms_m" not in figures["trajectory"]
    assert "abs_bias_m" not in figures["bathymetry"]
    assert figures["trajectory"]["rigid_rms_m"] < 3 * NOISE_M
    assert 0.8 * NOISE_M < figures["bathymetry"]["rmse_m"] < 1.5 * NOISE_M
    with pytest.raises(InvalidInput, match="local CRS"):
        evaluate(tmp_path / "free", mission / "truth" / "texture.jpg")


def test_reference_raster_in_another_crs(tmp_path: Path, out: Path, truth: Truth):
    """A reference in degrees, 0.3 m deeper than the truth."""
    frame, step, n = _frame(False), 3e-7, 300
    west, north = 6.0127 - n / 2 * step, 43.0421 + n / 2 * step
    longitude, latitude = np.meshgrid(west + (np.arange(n) + 0.5) * step, north - (np.arange(n) + 0.5) * step)
    at = frame.local_from_geographic(longitude.ravel(), latitude.ravel(), np.full(n * n, -15.0))
    z = truth_height(truth, at[:, 0] - MOVE_M, at[:, 1]).reshape(n, n) - 0.3
    path = tmp_path / "dem.tif"
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "height": n, "width": n, "crs": "EPSG:4326"}
    with rasterio.open(path, "w", transform=Affine(step, 0, west, 0, -step, north), **profile) as file:
        file.write(z.astype(np.float32), 1)
    reference = evaluate(out, path)["reference"]
    assert reference["cells"] > 500
    assert reference["vertical_shift_m"] == pytest.approx(0.3 + BIAS_M, abs=0.002)
    assert 0.5 * NOISE_M < reference["median_abs_m"] < 1.5 * NOISE_M
    assert reference["p95_abs_m"] > reference["median_abs_m"]


def test_reference_raster_of_whole_metres(tmp_path: Path, out: Path):
    path = tmp_path / "chart.tif"
    profile = {"driver": "GTiff", "dtype": "int16", "count": 1, "height": 60, "width": 60, "crs": CRS, "nodata": -999}
    with rasterio.open(next(out.rglob("bathymetry.tif"))) as file:
        west, north, z = file.bounds.left - 5, file.bounds.top + 5, float(np.ma.median(file.read(1, masked=True)))
    with rasterio.open(path, "w", transform=Affine(1, 0, west, 0, -1, north), **profile) as file:
        file.write(np.full((60, 60), round(z) - 2, np.int16), 1)
    reference = evaluate(out, path)["reference"]
    assert reference["cells"] > 500
    assert reference["vertical_shift_m"] == pytest.approx(z - (round(z) - 2), abs=0.3)


def _cloud(path: Path, truth: Truth, shift_m: float) -> Path:
    rng, frame = np.random.default_rng(1), _frame(False)
    X = np.column_stack([rng.uniform(-1.5, 1.5, (60_000, 2)), np.full(60_000, -15.0)])
    X[:, 2] = truth_height(truth, X[:, 0] - MOVE_M, X[:, 1])
    X = frame.map_from_local(X) + np.array([shift_m, 0, -0.3])
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = X.min(axis=0), [0.001] * 3
    header.add_crs(pyproj.CRS(CRS))
    las = laspy.LasData(header)
    las.x, las.y, las.z = X.T
    las.write(path)
    return path


def test_reference_cloud(tmp_path: Path, out: Path, truth: Truth):
    reference = evaluate(out, _cloud(tmp_path / "cloud.laz", truth, 0.0))["reference"]
    assert reference["cells"] > 500
    assert reference["vertical_shift_m"] == pytest.approx(0.3 + BIAS_M, abs=0.005)
    assert 0.5 * NOISE_M < reference["median_abs_m"] < 3 * NOISE_M


def test_says_what_is_missing(tmp_path: Path, out: Path, mission: Path, truth: Truth):
    with pytest.raises(InvalidInput, match="no products"):
        evaluate(tmp_path / "nowhere", mission)
    with pytest.raises(InvalidInput, match="Check the path"):
        evaluate(out, tmp_path / "nowhere")
    with pytest.raises(InvalidInput, match=r"truth\.json"):
        evaluate(out, tmp_path)
    with pytest.raises(InvalidInput, match="overlap"):
        evaluate(out, _cloud(tmp_path / "far.las", truth, 5000.0))
    (tmp_path / "notes.txt").write_text("no raster")
    with pytest.raises(InvalidInput, match="GDAL"):
        evaluate(out, tmp_path / "notes.txt")
    with pytest.raises(InvalidInput, match="no CRS"):
        evaluate(out, mission / "truth" / "texture.jpg")
    for name in ("a", "b"):
        _products(tmp_path / "two" / name / "v1", truth)
    with pytest.raises(InvalidInput, match="a, b"):
        evaluate(tmp_path / "two", mission)
    (tmp_path / "two" / "a" / "v1" / "bathymetry.tif").unlink()
    with pytest.raises(InvalidInput, match=r"bathymetry\.tif"):
        evaluate(tmp_path / "two" / "a", mission)
    (tmp_path / "two" / "b" / "v1" / "trajectory.csv").unlink()
    with pytest.raises(InvalidInput, match=r"trajectory\.csv"):
        evaluate(tmp_path / "two" / "b", mission)


@pytest.mark.skipif("SEAMOSAIC_SHARED" not in os.environ, reason="needs the shared score.py")
def test_agrees_with_the_independent_score(tmp_path: Path, mission: Path, truth: Truth):
    """On products that lie where they should: that script's search moves surfaces in steps of 0.3 m only."""
    out = _products(tmp_path / "there", truth, move_m=0.0)
    script, figures = Path(os.environ["SEAMOSAIC_SHARED"]) / "score.py", evaluate(out, mission)
    done = subprocess.run([sys.executable, script, mission, out], capture_output=True, text=True, check=True)
    for part, score in json.loads(done.stdout).items():
        for name, value in score.items():
            close = 0.1 if name.endswith(("_deg", "_pct")) else 3e-3 if name == "shift_m" else 3e-4
            assert figures[part][name] == pytest.approx(value, rel=0.03, abs=close), name
