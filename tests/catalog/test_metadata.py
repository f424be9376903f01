"""quality.json, provenance.json and the STAC item."""

import hashlib
import json
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pyproj
import pytest
import rasterio.coords
import shapely
from pyproj.crs import CompoundCRS
from seamosaic.catalog import metadata, rasters
from seamosaic.schemas.products import PRODUCTS, ImageCounts, MissionSummary, Quality
from seamosaic.schemas.provenance import InputFile, Provenance, Step

START = datetime(2026, 6, 3, 10, 0, tzinfo=UTC)
END = datetime(2026, 6, 3, 12, 30, 0, 250_000, tzinfo=timezone(timedelta(hours=1)))
CRS = pyproj.CRS("EPSG:32631")


def provenance():
    return Provenance(
        digest="abc",
        mission_id="reef",
        created=START,
        software=metadata.software_versions(),
        host=metadata.host(),
        inputs={"images/a.jpg": InputFile(sha256="0" * 64, size=17)},
        parameters={"grid": {"cell_m": 0.02}},
        steps=(
            Step(name="extract", code_version="1", count_total=4, count_computed=3, count_reused=1, core_seconds=2.5),
        ),
    )


def test_provenance_is_plain_json(tmp_path):
    path = tmp_path / "provenance.json"
    metadata.write_provenance(path, provenance())
    found = json.loads(path.read_text())
    assert found["digest"] == "abc"
    assert found["inputs"]["images/a.jpg"] == {"sha256": "0" * 64, "size": 17}
    assert found["steps"][0]["count_reused"] == 1
    assert datetime.fromisoformat(found["created"]) == START
    assert Provenance.model_validate(found) == provenance()


def test_software_that_can_change_a_result_is_named():
    found = metadata.software_versions()
    assert found["numpy"] == np.__version__
    assert {"seamosaic", "python", "gdal", "proj", "dask", "gtsam", "opencv-python-headless"} <= set(found)
    assert any(name.startswith("open3d") for name in found)
    assert set(metadata.host().model_dump()) == {"platform", "cpu_count"}


def test_output_digests_leave_metadata_out(tmp_path):
    (tmp_path / "metadata").mkdir()
    (tmp_path / "metadata" / "provenance.json").touch()
    (tmp_path / "quality.json").write_bytes(b"{}")
    assert metadata.output_digests(tmp_path) == {"quality.json": hashlib.sha256(b"{}").hexdigest()}


def test_quality_says_what_is_missing(tmp_path):
    quality = Quality(mission=MissionSummary(id="night", images=ImageCounts(total=3)), warnings=("no texture images",))
    metadata.write_quality(tmp_path / "quality.json", quality)
    found = json.loads((tmp_path / "quality.json").read_text())
    assert found["mosaic"] is None
    assert found["warnings"] == ["no texture images"]
    assert Quality.model_validate(found) == quality


def version(folder, crs):
    (folder / "metadata").mkdir()
    with rasters.product_writer(
        folder, "bathymetry.tif", 0.02, 25_000_000, 236_000_000, 60, 40, crs.to_wkt()
    ) as writer:
        writer.write(0, 0, np.full((40, 60), -3.0))
    (folder / "trajectory.csv").write_text("image")
    return json.loads(
        metadata.write_stac_item(folder, "reef", 3, "A reef", START, END, {}, {"platform": "Vortex"}).read_text()
    )


def test_stac_item_has_what_the_specification_asks_for(tmp_path):
    item = version(tmp_path, CRS)
    assert (item["type"], item["stac_version"], item["id"]) == ("Feature", "1.0.0", "reef-v3")
    assert item["links"] == []
    properties = item["properties"]
    assert properties["datetime"] is None
    assert properties["start_datetime"] == "2026-06-03T10:00:00.000000Z"
    assert properties["end_datetime"] == "2026-06-03T11:30:00.250000Z"
    assert properties["proj:code"] == "EPSG:32631"
    assert properties["platform"] == "Vortex"
    assert properties["proj:bbox"] == pytest.approx([500_000, 4_719_999.2, 500_001.2, 4_720_000])
    assert set(item["assets"]) == {"bathymetry.tif", "trajectory.csv"}


def test_stac_geometry_is_where_the_map_is(tmp_path):
    item = version(tmp_path, CRS)
    polygon = shapely.geometry.shape(item["geometry"])
    assert polygon.exterior.is_ccw
    west, south, east, north = item["bbox"]
    assert polygon.bounds == pytest.approx((west, south, east, north))
    assert pyproj.Geod(ellps="WGS84").geometry_area_perimeter(polygon)[0] == pytest.approx(0.96, rel=0.01)
    x, y = pyproj.Transformer.from_crs(4326, CRS, always_xy=True).transform((west + east) / 2, (south + north) / 2)
    assert (x, y) == pytest.approx((500_000.6, 4_719_999.6), abs=0.01)


@pytest.mark.parametrize(("crs", "pole"), [("EPSG:3413", 90), ("EPSG:3031", -90)])
def test_stac_geometry_of_a_map_around_a_pole_has_it_inside(crs, pole):
    bounds = rasterio.coords.BoundingBox(-300, -500, 700, 400)
    geometry, bbox = metadata._geometry(metadata._geographic_outline(pyproj.CRS(crs), bounds))
    shape = shapely.geometry.shape(geometry)
    assert shape.is_valid
    assert shape.exterior.is_ccw
    assert tuple(bbox) == pytest.approx(shape.bounds)
    assert bbox[0::2] == [-180, 180]
    assert pole in bbox
    inside = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    x, y = np.random.default_rng(0).uniform(-800, 800, (2, 2000))
    there = (x > -300) & (x < 700) & (y > -500) & (y < 400)
    found = shapely.contains_xy(shape, *inside.transform(x, y))
    assert (found == there).mean() > 0.995


def test_stac_assets_can_be_checked(tmp_path):
    item = version(tmp_path, CRS)
    asset = item["assets"]["bathymetry.tif"]
    assert (tmp_path / "metadata" / asset["href"]).resolve() == (tmp_path / "bathymetry.tif").resolve()
    assert asset["file:checksum"] == "1220" + hashlib.sha256((tmp_path / "bathymetry.tif").read_bytes()).hexdigest()
    assert asset["type"] == "image/tiff; application=geotiff; profile=cloud-optimized"
    assert asset["roles"] == ["data"]
    assert asset["proj:shape"] == [40, 60]
    assert asset["proj:transform"] == pytest.approx([0.02, 0, 500_000, 0, -0.02, 4_720_000])


def test_stac_names_a_compound_crs_by_both_codes(tmp_path):
    assert version(tmp_path, pyproj.CRS("EPSG:32631+5714"))["properties"]["proj:code"] == "EPSG:32631+5714"


def test_codes_of_different_authorities_name_no_compound_crs():
    parts = [pyproj.CRS("EPSG:32631"), pyproj.CRS("ESRI:115700")]
    assert metadata.authority_code(CompoundCRS("both", parts)) is None
    assert metadata.authority_code(CompoundCRS("both", [parts[0], pyproj.CRS("EPSG:5714")])) == "EPSG:32631+5714"


def test_stac_spells_out_a_crs_without_a_code(tmp_path):
    item = version(tmp_path, pyproj.CRS("+proj=tmerc +lon_0=3.1 +ellps=WGS84 +units=m"))
    assert item["properties"]["proj:code"] is None
    assert pyproj.CRS.from_wkt(item["properties"]["proj:wkt2"]).is_projected


def test_the_product_table_is_whole():
    names = [product.name for product in PRODUCTS]
    assert set(rasters.LAYERS) <= set(names)
    assert len(set(names)) == len(names)
    assert {product.role for product in PRODUCTS} <= {"data", "visual", "overview", "metadata"}


def test_stac_geometry_across_the_180th_meridian_is_cut_there(tmp_path):
    ring = [(179.9999, -17.0), (-179.9998, -17.0), (-179.9998, -16.9), (179.9999, -16.9), (179.9999, -17.0)]
    geometry, (west, south, east, north) = metadata._geometry(ring)
    assert (west, south, east, north) == pytest.approx((179.9999, -17.0, -179.9998, -16.9))
    parts = shapely.geometry.shape(geometry)
    assert (geometry["type"], len(parts.geoms)) == ("MultiPolygon", 2)
    assert parts.area == pytest.approx(0.0003 * 0.1, rel=1e-6)
    assert all(part.exterior.is_ccw and abs(part.bounds[0]) <= 180 for part in parts.geoms)
