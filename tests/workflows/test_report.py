"""report.html of a made-up version: every part that has data is there, every part that has none says so."""

import base64
import io
import re
from datetime import UTC, datetime
from html.parser import HTMLParser

import numpy as np
import pyproj
import pytest
from PIL import Image
from seamosaic.catalog import metadata, pointclouds, rasters, trajectories
from seamosaic.schemas import products
from seamosaic.schemas.provenance import InputFile, Provenance, Step
from seamosaic.workflows import report, report_figures

UTM = pyproj.CRS("EPSG:32631").to_wkt()
CELL, LEFT, TOP, WIDTH, HEIGHT = 0.05, 10_000_000, 94_400_000, 160, 120
WEST, NORTH = LEFT * CELL, TOP * CELL
START = np.datetime64("2026-06-03T10:00:00", "ns")


def make_rasters(folder, crs=UTM, covered=True):
    """A mound in the north-west; the mosaic is red in the north and blue in the south."""
    rows, cols = np.mgrid[0:HEIGHT, 0:WIDTH]
    elevation = -20 + np.exp(-((rows - 40) ** 2 + (cols - 50) ** 2) / 600) + 0.02 * np.sin(cols / 3)
    elevation[-15:] = np.nan
    valid = np.isfinite(elevation) & covered
    layers = {
        "bathymetry.tif": np.where(valid, elevation, np.nan),
        "uncertainty.tif": np.where(valid, 0.002 + 0.0001 * cols, np.nan),
        "density.tif": np.where(valid, (cols + rows) % 9, 0),
        "source.tif": np.where(valid, 1 + (cols // 20) % 3, 0),
        "mosaic-source.tif": np.where(valid, cols // 40, -1),
        **{f"terrain/{name}.tif": np.where(valid, cols % 50 / 50, np.nan) for name in ("slope", "bpi-broad", "vrm")},
    }
    for name, values in layers.items():
        with rasters.product_writer(folder, name, CELL, LEFT, TOP, WIDTH, HEIGHT, crs) as writer:
            writer.write(0, 0, values)
    picture = np.zeros((3, HEIGHT, WIDTH), np.uint8)
    picture[0, : HEIGHT // 2], picture[2, HEIGHT // 2 :] = 200, 200
    for name in ("mosaic.tif", "mosaic-planar.tif"):
        with rasters.product_writer(folder, name, CELL, LEFT, TOP, WIDTH, HEIGHT, crs) as writer:
            writer.write(0, 0, picture, valid)


def make_trajectory(folder, count=12, rejected=2):
    rows = []
    for k in range(count):
        place = (WEST + 0.5 + 0.6 * k, NORTH - 3 - 0.1 * k, -17.0)
        pose = trajectories.Pose(place, (1, 0, 0, 0), (0.01, 0.01, 0.005))
        status = "navigation" if k % 5 == 4 else "adjusted"
        rows.append(trajectories.Row(f"images/V_{k:02}.jpg", START + np.timedelta64(4 * k, "s"), pose, status))
    for k in range(rejected):
        reason = f"rejected: truncated <JPEG> {k}"
        rows.append(trajectories.Row(f"images/bad_{k}.jpg", START + np.timedelta64(99 + k, "s"), None, reason))
    trajectories.write(folder / "trajectory.csv", rows)
    return rows


def make_soundings(folder, count, crs=UTM):
    rng = np.random.default_rng(0)
    X = rng.normal([WEST, NORTH, -20], 1, (count, 3))
    with pointclouds.SoundingsWriter(folder / "soundings.laz", crs, np.array([WEST, NORTH, 0])) as writer:
        writer.write(X, np.zeros(count, int), np.zeros(count, int), rng.gamma(8, 0.0004, count))


def provenance():
    return Provenance(
        digest="d1ge57",
        mission_id="reef",
        created=datetime(2026, 6, 4, tzinfo=UTC),
        software=metadata.software_versions(),
        host=metadata.host(),
        inputs={"mission.yaml": InputFile(sha256="0" * 64, size=2_500_000)},
        parameters={},
        steps=(
            Step(name="extract", code_version="1", count_total=14, count_computed=4, count_reused=10, core_seconds=7),
        ),
    )


def full_quality():
    axis = products.AxisDifference(rms_m=0.12, max_m=0.3)
    return products.Quality(
        mission=products.MissionSummary(
            id="reef",
            title="Posidonia <meadow>",
            platform="Vortex",
            start=datetime(2026, 6, 3, 10, tzinfo=UTC),
            end=datetime(2026, 6, 3, 11, tzinfo=UTC),
            crs="WGS 84 / UTM zone 31N",
            vertical_reference="the sea surface at survey time",
            images=products.ImageCounts(total=14, by_role={"combined": 14}, by_status={"adjusted": 10}),
        ),
        soundings=products.SoundingQuality(
            count=123_456, per_image_median=1700, sigma_median_m=0.0021, reasons={"no cross found": 3}
        ),
        pairs=products.PairQuality(tried=40, linked=31, homography=20, essential=11, median_inliers=220),
        trajectory=products.TrajectoryQuality(
            adjusted=10,
            navigation_only=2,
            rejected=2,
            navigation_minus_adjusted=products.NavigationDifference(x=axis, y=axis, z=axis),
            sigma_median_m=(0.011, 0.012, 0.004),
            reprojection_rms_px=0.43,
        ),
        bathymetry=products.BathymetryQuality(
            cell_m=0.05,
            cells=16_800,
            area_m2=42,
            by_source=products.SourceShares(laser=0.4, image_matching=0.35, interpolated=0.25),
            elevation_min_m=-20.02,
            elevation_median_m=-19.9,
            elevation_max_m=-19.0,
            sigma_median_m=0.01,
        ),
        terrain=products.TerrainQuality(
            slope_deg=12.4,
            rugosity=1.062,
            bpi_fine=products.RingScale(inner_cells=1, outer_cells=5, inner_m=0.02, outer_m=0.1),
            bpi_broad=products.RingScale(inner_cells=5, outer_cells=25, inner_m=0.1, outer_m=0.5),
            contour_interval_m=0.2,
        ),
        mosaic=products.MosaicQuality(cell_m=0.0021, area_m2=41, coverage_share=0.976),
        mesh=products.MeshQuality(vertices=200_000, triangles=399_000),
        warnings=("2 images are truncated",),
    )


class Page(HTMLParser):
    """Headings with the images and the text below each, and every address that the page uses."""

    def __init__(self, text):
        super().__init__()
        self.images, self.texts, self.addresses, self.heading, self._tag = {}, {}, [], "", ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._tag, values = tag, dict(attrs)
        self.addresses += [value for key, value in values.items() if key in ("src", "href")]
        if tag == "img":
            header, _, data = values["src"].partition(";base64,")
            assert header in ("data:image/png", "data:image/jpeg")
            self.images[self.heading] = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def handle_data(self, data):
        if self._tag == "h2" and data.strip():
            self.heading = data.strip()
        self.texts[self.heading] = self.texts.get(self.heading, "") + data


def write(folder, quality, navigation=None):
    path = report.write_report(folder, quality, provenance(), navigation)
    text = path.read_text(encoding="utf-8")
    return Page(text), text


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    folder = tmp_path_factory.mktemp("full")
    make_rasters(folder)
    rows = make_trajectory(folder)
    make_soundings(folder, 5000)
    adjusted = [row.pose.position if row.pose else (np.nan,) * 3 for row in rows]
    navigation = np.add(adjusted, [0.1, -0.05, 0.02])
    return write(folder, full_quality(), navigation)


PICTURES = ("Bathymetry", "Orthomosaic", "Planar mosaic", "Uncertainty", "Source", "Density", "Track")
TERRAIN = ("Slope", "Position", "Ruggedness")
FIGURES = ("Precision of soundings", "Navigation minus adjusted")


def test_every_picture_is_there_and_not_blank(full):
    page, _ = full
    assert set(page.images) == {*PICTURES, *TERRAIN, *FIGURES}
    for name, pixels in page.images.items():
        assert pixels.std() > 10, name
        assert min(pixels.shape[:2]) > 250, name


def test_the_page_needs_nothing_from_elsewhere(full):
    page, text = full
    outside = [a for a in page.addresses if not a.startswith("data:") and a not in {p.name for p in products.PRODUCTS}]
    assert outside == []
    assert not re.search(r"url\(|@import|<script|<link", text)


def test_the_page_says_the_figures_in_words(full):
    page, text = full
    for words in (
        "123,456",
        "31 of 40",
        "40% / 35% / 25%",
        "42.0 m²",
        "-20.020 to -19.000 m",
        "± 2.1 mm",
        "98%",
        "12.4°",
        "5 to 25 cells",
    ):
        assert words in text, words
    assert "the sea surface at survey time" in text
    assert "2 images are truncated" in page.texts["Please note"]
    assert "no cross found" in page.texts["Images without soundings"]
    assert "truncated <JPEG> 1" in page.texts["Rejected images"]
    assert "4 of 14" in page.texts["How it was made"]
    assert "2.5 MB" in page.texts["How it was made"]
    for product in products.PRODUCTS:
        assert product.description in page.texts["The files"]


def test_titles_are_escaped(full):
    _, text = full
    assert "Posidonia &lt;meadow&gt;" in text
    assert "<meadow>" not in text


def test_maps_have_north_up(full):
    """Red in the north, blue in the south; the mound, bright in the colour map, in the north-west."""
    page, _ = full
    mosaic = page.images["Orthomosaic"].astype(int)
    red, blue = (np.argwhere(mosaic[..., k] - mosaic[..., 2 - k] > 120) for k in (0, 2))
    assert red[:, 0].max() <= blue[:, 0].min() + 3
    bathymetry = page.images["Bathymetry"].astype(int)
    map_only = bathymetry[:, : int(0.8 * bathymetry.shape[1])]
    yellow = np.argwhere((map_only[..., 0] > 150) & (map_only[..., 1] > 140) & (map_only[..., 2] < 90))
    row, col = np.median(yellow, axis=0) / map_only.shape[:2]
    assert row < 0.5
    assert col < 0.55


def test_a_local_mission_without_laser_mosaic_or_soundings(tmp_path):
    make_rasters(tmp_path, rasters.local_crs_wkt())
    for name in ("mosaic.tif", "mosaic-planar.tif"):
        (tmp_path / name).unlink()
    make_trajectory(tmp_path, rejected=0)
    make_soundings(tmp_path, 0, rasters.local_crs_wkt())
    mission = products.MissionSummary(id="pool", images=products.ImageCounts(total=12))
    page, text = write(tmp_path, products.Quality(mission=mission))
    assert set(page.images) == {"Bathymetry", "Uncertainty", "Source", "Density", "Track", *TERRAIN}
    for heading in ("Orthomosaic", "Planar mosaic", *FIGURES):
        assert "No data to show" in page.texts[heading]
    assert "no navigation" in page.texts["Navigation minus adjusted"]
    assert "local frame in metres" in text
    assert "None: every image was used." in page.texts["Rejected images"]
    assert "Please note" not in page.texts


def test_everything_rejected(tmp_path):
    make_rasters(tmp_path, covered=False)
    rows = make_trajectory(tmp_path, count=0, rejected=230)
    mission = products.MissionSummary(id="dark", images=products.ImageCounts(total=230))
    page, _ = write(tmp_path, products.Quality(mission=mission), np.full((len(rows), 3), np.nan))
    assert page.images == {}
    assert "30 more are in trajectory.csv" in page.texts["Rejected images"]


def test_no_rasters_at_all(tmp_path):
    make_trajectory(tmp_path, count=3)
    mission = products.MissionSummary(id="bare", images=products.ImageCounts(total=5))
    page, _ = write(tmp_path, products.Quality(mission=mission))
    assert set(page.images) == {"Track"}


def test_hillshade_is_lit_from_the_north_west():
    rows, cols = np.mgrid[0:61, 0:61]
    hill = np.exp(-((rows - 30) ** 2 + (cols - 30) ** 2) / 100)
    shade = report_figures.hillshade(hill, 0.1, 0.1)
    assert shade[23, 23] > 0.9 > 0.3 > shade[37, 37]
    assert shade[0, 0] == pytest.approx(np.sin(np.radians(45)), abs=0.01)
    hill[:, :5] = np.nan
    assert np.isnan(report_figures.hillshade(hill, 0.1, 0.1)[:, :5]).all()


@pytest.mark.parametrize(("length", "rounded"), [(1, 1), (1.99, 1), (2.0, 2), (7, 5), (0.3, 0.2), (120, 100), (50, 50)])
def test_scale_bar_is_round(length, rounded):
    assert report_figures.round_length(length) == pytest.approx(rounded)


@pytest.mark.parametrize(("size", "text"), [(500, "0.5 kB"), (2_000_000, "2 MB"), (3_210_000_000, "3.21 GB")])
def test_sizes_are_readable(size, text):
    assert report.readable_size(size) == text
