"""Rasters, read back with GDAL (rasterio) and judged by rio-cogeo."""

from itertools import pairwise

import numpy as np
import pyproj
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.windows import Window
from rio_cogeo.cogeo import cog_validate
from seamosaic.catalog import rasters

UTM = pyproj.CRS("EPSG:32631").to_wkt()
COMPOUND = pyproj.CRS("EPSG:32631+5714").to_wkt()
CELL, LEFT, TOP = 0.02, 25_000_000, 236_000_000  # 500 000 m east, 4 720 000 m north
WIDTH, HEIGHT = 700, 600


def write(folder, name, values, col=0, row=0, crs=UTM, size=(WIDTH, HEIGHT), tags=None):
    layer = rasters.LAYERS[name]
    mask = np.ones(values.shape[-2:], bool) if layer.mask else None
    with rasters.product_writer(folder, name, CELL, LEFT, TOP, *size, crs, tags) as writer:
        writer.write(col, row, values, mask)
    return folder / name


def ramp(name, height=HEIGHT, width=WIDTH):
    """Values that rise eastwards and, much more, southwards, inside what the layer can hold."""
    rows, cols = np.mgrid[0:height, 0:width]
    layer = rasters.LAYERS[name]
    values = (rows * 2 + cols) * 200 / (3 * max(HEIGHT, WIDTH))
    values = np.where(layer.colours is None, values, 1 + (rows // 100) % 3)
    return np.broadcast_to(values, (len(layer.descriptions), height, width)).astype(layer.dtype)


@pytest.mark.parametrize("name", list(rasters.LAYERS))
def test_every_product_is_a_strictly_valid_cog(tmp_path, name):
    path = write(tmp_path, name, ramp(name), tags={"vertical_reference": "sea surface"})
    valid, errors, warnings = cog_validate(path, strict=True, quiet=True)
    assert valid, (errors, warnings)
    layer = rasters.LAYERS[name]
    with rasterio.open(path) as file:
        assert file.driver == "GTiff"
        assert file.dtypes == (layer.dtype,) * len(layer.descriptions)
        assert file.descriptions == layer.descriptions
        assert file.nodata == layer.nodata
        assert file.overviews(1), "needs overviews"
        assert file.tags()["AREA_OR_POINT"] == "Area"
        assert file.tags()["vertical_reference"] == "sea surface"
        assert tuple(file.bounds) == pytest.approx(
            (500_000, 4_720_000 - HEIGHT * CELL, 500_000 + WIDTH * CELL, 4_720_000)
        )
        assert file.crs.to_epsg() == 32631
        if not layer.mask:
            np.testing.assert_array_equal(file.read(), ramp(name))
        assert ("STATISTICS_MAXIMUM" in file.tags(1)) == (layer.resampling == "average" and not layer.mask)
        if layer.resampling == "average" and not layer.mask:
            assert float(file.tags(1)["STATISTICS_MAXIMUM"]) == pytest.approx(ramp(name).max(), rel=1e-5)
    files = [entry.relative_to(tmp_path).as_posix() for entry in tmp_path.rglob("*") if entry.is_file()]
    assert files == [name], "a temporary or side file is left"


def test_formats_are_those_of_the_public_interface():
    formats = {name: (layer.dtype, len(layer.descriptions), layer.nodata) for name, layer in rasters.LAYERS.items()}
    assert formats["bathymetry.tif"] == formats["uncertainty.tif"] == ("float32", 1, -9999)
    assert formats["mosaic-source.tif"] == ("int32", 1, -1)
    assert formats["source.tif"] == ("uint8", 1, 0)


def test_windows_land_where_the_map_says(tmp_path):
    """One window north-west, one south-east: read by coordinate, as a GIS does."""
    with rasters.product_writer(tmp_path, "bathymetry.tif", CELL, LEFT, TOP, WIDTH, HEIGHT, UTM) as writer:
        writer.write(10, 20, np.full((5, 30), -3.0))
        writer.write(650, 590, np.full((1, 10, 50), -7.0))
    with rasterio.open(tmp_path / "bathymetry.tif") as file:
        places = [(10.5, 20.5), (39.5, 24.5), (40.5, 24.5), (10.5, 25.5), (650.5, 590.5), (699.5, 599.5), (300, 300)]
        found = [v[0] for v in file.sample([(500_000 + c * CELL, 4_720_000 - r * CELL) for c, r in places])]
    assert found == [-3, -3, -9999, -9999, -7, -7, -9999]


@settings(deadline=None, max_examples=8)
@given(cuts=st.lists(st.integers(1, 89), max_size=4, unique=True), order=st.randoms(use_true_random=False))
def test_any_cutting_into_windows_gives_the_same_raster(tmp_path_factory, cuts, order):
    folder = tmp_path_factory.mktemp("cuts")
    truth = np.random.default_rng(1).normal(size=(90, 100)).astype(np.float32)
    truth[20:30] = np.nan
    edges = [0, *sorted(cuts), 90]
    bands = list(pairwise(edges))
    order.shuffle(bands)
    with rasters.product_writer(folder, "uncertainty.tif", 0.5, -7, 3, 100, 90, UTM) as writer:
        for first, last in bands:
            writer.write(0, first, truth[first:last])
    with rasterio.open(folder / "uncertainty.tif") as file:
        np.testing.assert_array_equal(file.read(1), np.where(np.isnan(truth), -9999, truth))
        assert file.bounds.left == -3.5
        assert file.bounds.top == 1.5


def test_only_heights_carry_the_vertical_datum(tmp_path):
    expected = {"bathymetry.tif": ("metre", True), "uncertainty.tif": ("metre", False), "density.tif": (None, False)}
    for name, (unit, compound) in expected.items():
        with rasterio.open(write(tmp_path, name, ramp(name), crs=COMPOUND)) as file:
            assert file.units == (unit,)
            assert pyproj.CRS(file.crs.to_wkt()).is_compound == compound


def test_local_frame_survives_the_file(tmp_path):
    path = write(tmp_path, "bathymetry.tif", ramp("bathymetry.tif"), crs=rasters.local_crs_wkt())
    with rasterio.open(path) as file:
        crs = pyproj.CRS.from_wkt(file.crs.to_wkt())
    assert crs.is_engineering
    assert crs == pyproj.CRS.from_wkt(rasters.local_crs_wkt())
    assert [axis.direction for axis in crs.axis_info] == ["east", "north"]
    assert {axis.unit_name for axis in crs.axis_info} == {"metre"}


def test_overviews_average_quantities_without_the_empty_cells(tmp_path):
    values = np.full((HEIGHT, WIDTH), np.nan)
    values[::2, ::2], values[1::2, 1::2] = -2.0, -4.0
    with rasterio.open(write(tmp_path, "bathymetry.tif", values), overview_level=0) as file:
        np.testing.assert_allclose(file.read(1), -3.0)


@pytest.mark.parametrize("size", [(2000, 500), (3000, 1), (1025, 1301)])
@pytest.mark.parametrize("name", ["bathymetry.tif", "density.tif", "source.tif", "mosaic.tif"])
def test_strips_have_all_overviews_too(tmp_path, name, size):
    path = write(tmp_path, name, ramp(name, 1, 1), size=size)
    with rasterio.open(path) as file:
        factors = file.overviews(1)
    assert factors == [2**k for k in range(1, len(factors) + 1)]
    for level, factor in enumerate(factors):
        with rasterio.open(path, overview_level=level) as file:
            assert (file.width, file.height) == tuple(-(-side // factor) for side in size)
    assert max(file.width, file.height) <= 512 < 2 * max(file.width, file.height)


def test_an_overview_is_the_mean_of_two_by_two(tmp_path):
    values = np.random.default_rng(1).normal(-20, 5, (HEIGHT, WIDTH)).astype(np.float32)
    with rasterio.open(write(tmp_path, "bathymetry.tif", values), overview_level=0) as file:
        mean = values.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3))
        np.testing.assert_allclose(file.read(1), mean, rtol=1e-5)


def test_overviews_of_a_picture_keep_its_colours_at_a_rim(tmp_path):
    size, seen = (1100, 1500), np.zeros((1500, 1100), bool)
    seen[301:1201, 203:905] = True
    grey = np.where(seen, np.uint8(180), np.uint8(0))
    with rasters.product_writer(tmp_path, "mosaic.tif", CELL, LEFT, TOP, *size, UTM) as writer:
        writer.write(0, 0, np.stack([grey] * 3), seen)
    for level, factor in enumerate((2, 4)):
        with rasterio.open(tmp_path / "mosaic.tif", overview_level=level) as file:
            shown = file.dataset_mask() > 0
            inside = seen.reshape(1500 // factor, factor, 1100 // factor, factor)
            assert (shown >= inside.all((1, 3))).all()
            assert (shown <= inside.any((1, 3))).all()
            # JPEG beside black; a mean with black would be 45 darker
            assert np.abs(file.read()[:, shown].astype(int) - 180).max() <= 20


def test_overviews_never_invent_a_code(tmp_path):
    values = np.where(np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.5, 1, 3).astype(np.uint8)
    with rasterio.open(write(tmp_path, "source.tif", values), overview_level=0) as file:
        assert set(np.unique(file.read(1))) == {1, 3}
        assert file.colormap(1)[1] == rasters.SOURCE_COLOURS[1]


def test_mosaic_has_true_colours_and_an_internal_mask(tmp_path):
    picture, mask = np.zeros((3, HEIGHT, WIDTH), np.uint8), np.zeros((HEIGHT, WIDTH), bool)
    picture[0, :300], picture[2, 300:] = 200, 120  # red in the north, blue in the south
    mask[100:500, 100:600] = True
    with rasters.product_writer(tmp_path, "mosaic.tif", CELL, LEFT, TOP, WIDTH, HEIGHT, UTM) as writer:
        writer.write(0, 0, picture[:, :256], mask[:256])
        writer.write(0, 256, picture[:, 256:], mask[256:])
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        np.testing.assert_array_equal(file.dataset_mask() > 0, mask)
        np.testing.assert_allclose(file.read(window=Window(150, 150, 100, 100)).mean((1, 2)), [200, 0, 0], atol=3)
        np.testing.assert_allclose(file.read(window=Window(150, 350, 100, 100)).mean((1, 2)), [0, 0, 120], atol=3)


@pytest.mark.parametrize("name", ["mosaic.tif", "bathymetry.tif"])
def test_a_raster_without_a_single_value_says_so(tmp_path, name):
    with rasters.product_writer(tmp_path, name, CELL, LEFT, TOP, 3, 2, UTM):
        pass
    assert cog_validate(tmp_path / name, strict=True, quiet=True)[0]
    assert not rasters.read_overview(tmp_path / name).valid.any()
    assert rasters.summarise(tmp_path / name) == (0, None, None, None)


def test_an_exception_leaves_nothing(tmp_path):
    writer = rasters.product_writer(tmp_path, "density.tif", CELL, LEFT, TOP, WIDTH, HEIGHT, UTM)

    def fail():
        with writer:
            writer.write(0, 0, np.ones((9, 9), np.uint32))
            raise RuntimeError("half-way")

    with pytest.raises(RuntimeError, match="half-way"):
        fail()
    assert not list(tmp_path.iterdir())


def test_misuse_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one cell"):
        rasters.product_writer(tmp_path, "density.tif", CELL, 0, 0, 0, 4, UTM)
    with rasters.product_writer(tmp_path, "mosaic.tif", CELL, 0, 0, 9, 9, UTM) as writer:
        with pytest.raises(ValueError, match="needs mask"):
            writer.write(0, 0, np.zeros((3, 9, 9), np.uint8))
        with pytest.raises(ValueError, match="outside"):
            writer.write(1, 0, np.zeros((3, 9, 9), np.uint8), np.ones((9, 9), bool))
    density = rasters.product_writer(tmp_path, "density.tif", CELL, 0, 0, 9, 9, UTM)
    with pytest.raises(ValueError, match="takes no mask"), density:
        density.write(0, 0, np.zeros((9, 9)), np.ones((9, 9), bool))


def test_overview_is_small_and_keeps_its_place(tmp_path):
    values = ramp("bathymetry.tif")[0].astype(float)
    values[:300, :350] = np.nan
    overview = rasters.read_overview(write(tmp_path, "bathymetry.tif", values), max_px=200)
    assert max(overview.valid.shape) <= 200
    assert overview.extent == pytest.approx((500_000, 500_014, 4_719_988, 4_720_000))
    rows, cols = overview.valid.shape
    assert not overview.valid[: rows // 2 - 1, : cols // 2 - 1].any()
    assert overview.valid[rows // 2 + 1 :].all()
    assert np.isnan(overview.values[0][0, 0])
    # rises eastwards and southwards, as the full raster does
    assert overview.values[0][-1, -1] > overview.values[0][-1, 0] > overview.values[0][rows // 2 + 2, 0]


def test_summary_agrees_with_numpy(tmp_path):
    values = np.random.default_rng(3).normal(-20, 1, (HEIGHT, WIDTH))
    values[:, 400:] = np.nan
    found = rasters.summarise(write(tmp_path, "bathymetry.tif", values))
    stored = values[:, :400].astype(np.float32)
    assert found.cells == stored.size
    assert (found.minimum, found.maximum) == (stored.min(), stored.max())
    assert found.median == pytest.approx(np.median(stored), abs=float(np.ptp(stored)) / 60_000)


def test_codes_are_counted(tmp_path):
    values = np.zeros((HEIGHT, WIDTH), np.uint8)
    values[:10, :10], values[20:22] = 1, 3
    path = write(tmp_path, "source.tif", values)
    assert rasters.count_codes(path) == {1: 100, 3: 2 * WIDTH}
