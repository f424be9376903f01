"""survey.gpkg, read back with pyogrio and sqlite."""

import sqlite3

import numpy as np
import pyogrio
import pyogrio.raw
import pyproj
import pytest
import shapely
from seamosaic.catalog import rasters, vectors
from seamosaic.catalog.rasters import Overview

COMPOUND = pyproj.CRS("EPSG:32631+5714").to_wkt()
TIMES = np.array(["2026-06-03T10:00:00.250", "2026-06-03T10:00:04"], "datetime64[ns]")
LEFT, TOP, CELL = 500_000.0, 4_700_000.0, 0.02


def cone():
    """Rises 0.5 m for each metre from (LEFT + 1, TOP - 0.8); the westernmost 5 columns are empty."""
    rows, cols = np.mgrid[0:80, 0:100]
    elevation = -3 + 0.5 * CELL * np.hypot(cols + 0.5 - 50, rows + 0.5 - 40)
    elevation[:, :5] = np.nan
    return Overview(elevation[None], np.isfinite(elevation), CELL, CELL, LEFT, TOP)


def survey(path, crs=COMPOUND):
    outline = np.add([[0, 0], [2, 0], [2, 1], [0, 1]], [LEFT, TOP])
    footprints = [
        vectors.Footprint(outline, "images/V_1.jpg", TIMES[0], "adjusted"),
        vectors.Footprint(np.zeros((0, 2)), "images/V_2.jpg", TIMES[1], "rejected: truncated"),
    ]
    track = np.array([[LEFT, TOP, -17.0], [LEFT + 1, TOP + 2, -17.5]])
    angle = np.linspace(0, 2 * np.pi, 40)
    circle = np.column_stack([LEFT + 1 + 0.5 * np.cos(angle), TOP - 0.8 + 0.5 * np.sin(angle)])
    lines, coverage = [vectors.Contour(-2.5, circle), vectors.Contour(-2.4, circle + 0.1)], vectors.coverage(cone())
    vectors.write_survey(path, crs, footprints, track, TIMES, lines, coverage, 12.5)
    return path


def read(path, layer):
    meta, _, geometries, fields = pyogrio.raw.read(path, layer=layer, datetime_as_string=True)
    return shapely.from_wkb(geometries), dict(zip(meta["fields"], fields, strict=True)), meta


def test_layers_geometry_and_attributes(tmp_path):
    path = survey(tmp_path / "survey.gpkg")
    assert [tuple(row) for row in pyogrio.list_layers(path)] == [
        ("footprints", "Polygon"),
        ("track", "LineString Z"),
        ("contours", "LineString"),
        ("coverage", "MultiPolygon"),
    ]
    (footprint,), fields, meta = read(path, "footprints")
    assert footprint.area == pytest.approx(2.0)
    assert fields["image"].tolist() == ["images/V_1.jpg"]
    assert fields["time"].tolist() == ["2026-06-03T10:00:00.250Z"]
    assert fields["status"].tolist() == ["adjusted"]
    assert pyproj.CRS(meta["crs"]).to_epsg() == 32631
    (line,), fields, _ = read(path, "track")
    assert shapely.get_coordinates(line, include_z=True)[1].tolist() == [LEFT + 1, TOP + 2, -17.5]
    assert fields["end"].tolist() == ["2026-06-03T10:00:04Z"]
    assert fields["images"].tolist() == [2]
    (area,), fields, _ = read(path, "coverage")
    assert area.area == pytest.approx(95 * 80 * CELL**2)
    assert fields["area_m2"][0] == 12.5
    assert area.area > 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["survey.gpkg"]


def test_it_is_geopackage_1_2(tmp_path):
    connection = sqlite3.connect(survey(tmp_path / "survey.gpkg"))
    try:
        assert connection.execute("pragma user_version").fetchone() == (10200,)
    finally:
        connection.close()


def test_local_frame_and_empty_layers(tmp_path):
    path, nothing = tmp_path / "survey.gpkg", shapely.MultiPolygon()
    vectors.write_survey(path, rasters.local_crs_wkt(), [], np.zeros((0, 3)), TIMES[:0], [], nothing, 0.0)
    for layer in ("footprints", "track", "contours", "coverage"):
        info = pyogrio.read_info(path, layer=layer)
        assert info["features"] == 0
        assert pyproj.CRS(info["crs"]).is_engineering


def test_a_track_of_one_image_is_no_line(tmp_path):
    place = np.array([[1.0, 2.0]])
    vectors.write_survey(tmp_path / "s.gpkg", COMPOUND, [], place, TIMES[:1], [], shapely.MultiPolygon(), 0.0)
    assert len(read(tmp_path / "s.gpkg", "track")[0]) == 0


def test_coverage_is_north_up_and_keeps_holes():
    valid = np.zeros((40, 60), bool)
    valid[5:15, 10:30] = True  # north-west, with a hole
    valid[8:10, 12:14] = False
    valid[30:35, 50:55] = True
    area = vectors.coverage(Overview(valid[None], valid, 0.1, 0.2, 100.0, 50.0))
    assert area.is_valid
    assert area.area == pytest.approx(valid.sum() * 0.1 * 0.2)
    north_west, south_east = sorted(area.geoms, key=lambda part: part.bounds[0])
    assert north_west.bounds == pytest.approx((101, 47, 103, 49))
    assert len(north_west.interiors) == 1
    assert south_east.bounds == pytest.approx((105, 43, 105.5, 44))


def test_coverage_of_speckle_is_valid():
    valid = np.random.default_rng(0).random((120, 120)) < 0.6
    area = vectors.coverage(Overview(valid[None], valid, CELL, CELL, LEFT, TOP))
    assert area.is_valid
    assert area.area == pytest.approx(valid.sum() * CELL**2, rel=1e-6)
