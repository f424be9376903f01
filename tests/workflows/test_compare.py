"""Two versions compared: known differences come back, and what does not fit is said."""

import json

import numpy as np
import pyproj
import pytest
import rasterio
import s3fs
from rio_cogeo import cog_validate
from seamosaic.catalog import rasters, trajectories, versions
from seamosaic.catalog.trajectories import Pose, Row
from seamosaic.schemas.problems import InvalidInput
from seamosaic.workflows.compare import compare, lines

LEFT, TOP = 25_000_000, 236_000_000
STEPS = [{"name": "cells", "code_version": "1"}]


def make_version(folder, z, *, left=LEFT, top=TOP, cell_m=0.02, crs="EPSG:32631", sigma_m=0.01, shift_m=0.0, **made):
    """A version with the elevations z (h, w), NaN where there are none, and three images."""
    (folder / "metadata").mkdir(parents=True)
    wkt = pyproj.CRS(crs).to_wkt() if crs else rasters.local_crs_wkt()
    for name, values in (("bathymetry.tif", z), ("uncertainty.tif", np.where(np.isfinite(z), sigma_m, np.nan))):
        with rasters.product_writer(folder, name, cell_m, left, top, *z.shape[::-1], wkt) as writer:
            writer.write(0, 0, values)
    rows = [
        Row(f"images/{k}.jpg", np.datetime64("2026-06-03T00:00:00", "us"), pose(k, shift_m), "adjusted")
        for k in range(3)
    ]
    rows[2] = rows[2]._replace(pose=None, status="rejected: dark")
    trajectories.write(folder / "trajectory.csv", rows[: made.pop("images", 3)])
    provenance = {"mission_id": "reef", "parameters": {}, "software": {}, "inputs": {}, "steps": STEPS, **made}
    (folder / versions.PROVENANCE).write_text(json.dumps(provenance))
    return folder


def pose(k, shift_m):
    return Pose((500_000.0 + k + shift_m, 4_720_000.0, -5.0), (1.0, 0.0, 0.0, 0.0), (0.01, 0.01, 0.01))


@pytest.fixture
def seabed():
    return np.random.default_rng(0).normal(-8, 0.1, (60, 80))


def test_versions_on_an_object_store(tmp_path, seabed, s3):
    first, second = make_version(tmp_path / "v1", seabed), make_version(tmp_path / "v2", seabed + 0.01)
    local = compare(first, second)
    for folder in (first, second):
        s3fs.S3FileSystem().put(str(folder), f"{s3.bucket}/compared/{folder.name}", recursive=True)
    urls = [s3.url(f"compared/{name}") for name in ("v1", "v2")]
    remote = compare(*urls, tmp_path / "out")
    assert remote == {**local, "first": urls[0], "second": urls[1]}
    with rasterio.open(tmp_path / "out/difference.tif") as file:
        assert file.tags()["SECOND"] == urls[1]
    with pytest.raises(InvalidInput, match=r"no bathymetry\.tif"):
        compare(urls[0], s3.url("compared/v3"))


def test_a_known_difference_comes_back_on_shifted_grids(tmp_path, seabed):
    """The second starts ten cells further east and five further south, and is 30 mm higher."""
    first = make_version(tmp_path / "v1", seabed, parameters={"grid": {"cell_m": 0.02}, "mosaic": {"colour": "none"}})
    higher = seabed[5:, 10:] + 0.03
    higher[:, -20:] = np.nan
    second = make_version(
        tmp_path / "v2",
        np.pad(higher, ((0, 7), (0, 0)), constant_values=-9),
        left=LEFT + 10,
        top=TOP - 5,
        shift_m=0.004,
        images=2,
        parameters={"grid": {"cell_m": 0.02}, "mosaic": {"colour": "flatfield"}},
        software={"numpy": "2"},
        steps=[{"name": "cells", "code_version": "2"}, {"name": "new", "code_version": "1"}],
        inputs={"navigation.csv": {"sha256": "0" * 64}},
    )
    out = tmp_path / "difference"
    found = compare(first, second, out)
    cells = found["bathymetry"]
    common = 55 * 50
    assert (cells["cells_first"], cells["cells_common"]) == (60 * 80, common)
    assert (cells["cells_lost"], cells["cells_gained"]) == (60 * 80 - common, 7 * 70)
    assert cells["metres"]["median"] == pytest.approx(0.03, abs=1e-6)
    assert cells["metres"]["rmse"] == pytest.approx(0.03, abs=1e-6)
    assert cells["sigmas"]["median_abs"] == pytest.approx(0.03 / (0.01 * np.sqrt(2)), rel=1e-4)
    moved = found["trajectory"]
    assert (moved["images_common"], moved["images_only_first"], moved["placed_in_both"]) == (2, 1, 2)
    assert moved["moved"]["position_rms_m"] == pytest.approx(0.004, abs=1e-6)
    assert found["parameters"] == [{"name": "mosaic.colour", "first": "none", "second": "flatfield"}]
    assert found["software"] == [{"name": "numpy", "first": None, "second": "2"}]
    assert found["code"] == ["cells"]
    assert found["inputs"]["added"] == {"count": 1, "names": ["navigation.csv"]}
    for name, value in (("difference.tif", 0.03), ("difference-sigmas.tif", 0.03 / (0.01 * np.sqrt(2)))):
        assert cog_validate(out / name, quiet=True)[0]
        with rasterio.open(out / name) as file:
            read = file.read(1, masked=True)
            assert (round(file.bounds.left / 0.02), round(file.bounds.top / 0.02)) == (LEFT, TOP)
            assert file.tags()["FIRST"] == str(first)
        assert read.count() == common
        assert read.compressed() == pytest.approx(value, rel=1e-3)
    assert json.loads((out / "compare.json").read_text()) == json.loads(json.dumps(found))
    page = (out / "compare.html").read_text()
    assert page.count("data:image/png") == 2
    assert "mosaic.colour: none → flatfield" in page
    assert dict(lines(found))["gained and lost"] == "490 (10.21 %) and 2,050 (42.71 %)"


def test_figures_alone_write_nothing(tmp_path, seabed):
    first, second = (make_version(tmp_path / name, seabed) for name in ("v1", "v2"))
    before = sorted(tmp_path.rglob("*"))
    found = compare(first, second)
    assert sorted(tmp_path.rglob("*")) == before
    assert found["bathymetry"]["metres"]["max_abs"] == 0
    assert found["bathymetry"]["sigmas"]["share_above_2"] == 0
    assert dict(lines(found))["parameters"] == "the same"


def test_maps_that_touch_without_a_cell_in_common(tmp_path, seabed):
    west, east = seabed.copy(), seabed.copy()
    west[:, 40:], east[:, :40] = np.nan, np.nan
    found = compare(make_version(tmp_path / "v1", west), make_version(tmp_path / "v2", east), tmp_path / "out")
    assert found["bathymetry"]["metres"] is None
    assert "no cell in common" in (tmp_path / "out/compare.html").read_text()


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"cell_m": 0.05}, r"found 0\.05 m; expected 0\.02 m.*--set grid\.cell_m=0\.02"),
        ({"crs": "EPSG:32632"}, r"expected WGS 84 / UTM zone 31N.*mission\.yaml"),
        ({"left": LEFT + 80}, "no cell in common"),
        ({"top": TOP + 60}, "no cell in common"),
    ],
)
def test_grids_that_do_not_fit_are_refused(tmp_path, seabed, other, said):
    first, second = make_version(tmp_path / "v1", seabed), make_version(tmp_path / "v2", seabed, **other)
    with pytest.raises(InvalidInput, match=said):
        compare(first, second, tmp_path / "out")


def test_local_frames_are_those_of_a_mission(tmp_path, seabed):
    first = make_version(tmp_path / "v1", seabed, crs=None)
    assert compare(first, make_version(tmp_path / "v2", seabed, crs=None))["bathymetry"]["cells_common"] == seabed.size
    other = make_version(tmp_path / "v3", seabed, crs=None, mission_id="pool")
    with pytest.raises(InvalidInput, match="versions of one mission share a frame"):
        compare(first, other)


def test_what_is_no_version_is_said(tmp_path, seabed):
    first = make_version(tmp_path / "v1", seabed)
    with pytest.raises(InvalidInput, match=r"no bathymetry\.tif; expected a version's folder"):
        compare(first, tmp_path)
