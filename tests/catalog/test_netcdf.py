"""bathymetry.nc, read back with xarray and with GDAL's own netCDF driver."""

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from seamosaic.catalog import netcdf, rasters

CELL, LEFT, TOP = 0.05, 10_000_000, 94_000_000
LAYERS = ("bathymetry.tif", "uncertainty.tif", "density.tif", "source.tif")
CRS = {
    "projected": pyproj.CRS("EPSG:32631").to_wkt(),
    "compound": pyproj.CRS("EPSG:32631+5714").to_wkt(),
    "local": rasters.local_crs_wkt(),
}


def write(folder, crs_wkt, shape=(530, 90)):
    """The corner 20 cells from the north-west is empty; the elevation falls southwards, sigma grows eastwards."""
    rows, cols = np.mgrid[0 : shape[0], 0 : shape[1]]
    empty = (rows < 20) & (cols < 20)
    values = {
        "bathymetry.tif": np.where(empty, np.nan, -10 - rows / 100),
        "uncertainty.tif": np.where(empty, np.nan, 0.001 * (1 + cols)),
        "density.tif": np.where(empty, 0, rows % 7).astype(np.uint32),
        "source.tif": np.where(empty, 0, 1 + cols % 3).astype(np.uint8),
    }
    for name, array in values.items():
        with rasters.product_writer(folder, name, CELL, LEFT, TOP, shape[1], shape[0], crs_wkt) as writer:
            writer.write(0, 0, array)
    path = folder / "bathymetry.nc"
    tifs = [folder / name for name in LAYERS]
    netcdf.write_bathymetry(path, *tifs, title="Meadow", history="made", vertical_reference="the sea surface")
    return path


@pytest.mark.parametrize("kind", list(CRS))
def test_gdal_reads_the_same_map_from_it_as_from_the_geotiff(tmp_path, kind):
    path = write(tmp_path, CRS[kind])
    for variable, name in zip(("elevation", "uncertainty", "density", "source"), LAYERS, strict=True):
        with rasterio.open(f"netcdf:{path}:{variable}") as found, rasterio.open(tmp_path / name) as expected:
            np.testing.assert_array_equal(found.read(1), expected.read(1))
            assert tuple(found.transform) == pytest.approx(tuple(expected.transform), abs=1e-9)
    with rasterio.open(f"netcdf:{path}:elevation") as found, rasterio.open(tmp_path / "bathymetry.tif") as expected:
        assert found.crs == expected.crs
        assert found.nodata == -9999


def test_xarray_reads_values_by_coordinate(tmp_path):
    with xr.open_dataset(write(tmp_path, CRS["projected"]), engine="h5netcdf", decode_coords="all") as found:
        north_west = found.sel(x=500_000.02, y=4_699_999.98, method="nearest")
        assert np.isnan(north_west.elevation)
        assert north_west.source == 0
        place = found.sel(x=500_000 + 40.5 * CELL, y=4_700_000 - 300.5 * CELL, method="nearest")
        assert float(place.elevation) == pytest.approx(-13)
        assert float(place.uncertainty) == pytest.approx(0.041)
        assert int(place.density) == 300 % 7
        assert int(place.source) == 1 + 40 % 3
        assert float(found.x[0]) == pytest.approx(500_000 + CELL / 2, abs=1e-9)
        assert float(found.y[0]) == pytest.approx(4_700_000 - CELL / 2, abs=1e-9)
        assert (np.diff(found.y) < 0).all()


def test_it_follows_the_cf_conventions(tmp_path):
    with xr.open_dataset(write(tmp_path, CRS["compound"]), engine="h5netcdf", decode_coords="all") as found:
        assert found.attrs["Conventions"] == "CF-1.8"
        assert found.attrs["title"] == "Meadow"
        assert found.x.attrs["standard_name"] == "projection_x_coordinate"
        assert found.y.attrs["units"] == "m"
        assert found.elevation.attrs["standard_name"] == "height_above_mean_sea_level"
        assert found.elevation.attrs["positive"] == "up"
        assert "standard_name" not in found.uncertainty.attrs  # it is no error above that level
        assert set(found.elevation.attrs["ancillary_variables"].split()) == {"uncertainty", "density", "source"}
        assert pyproj.CRS.from_cf(found.crs.attrs) == pyproj.CRS("EPSG:32631+5714")
        assert found.crs.attrs["grid_mapping_name"] == "transverse_mercator"
        values, meanings = found.source.attrs["flag_values"], found.source.attrs["flag_meanings"].split()
        assert dict(zip(values.tolist(), meanings, strict=True))[2] == "image_matching"
        assert found.source.dtype == values.dtype
        assert all(found[name].encoding["grid_mapping"] == "crs" for name in found.data_vars)


@pytest.mark.parametrize("kind", ["projected", "local"])
def test_no_standard_name_claims_a_datum_that_is_not_there(tmp_path, kind):
    with xr.open_dataset(write(tmp_path, CRS[kind], (30, 30)), engine="h5netcdf") as found:
        assert "standard_name" not in found.elevation.attrs
        assert "sea surface" in found.elevation.attrs["comment"]
        assert ("standard_name" in found.x.attrs) == (kind == "projected")


def test_layers_on_different_grids_are_refused_and_leave_nothing(tmp_path):
    write(tmp_path, CRS["projected"], (30, 30))
    with rasters.product_writer(tmp_path, "density.tif", CELL, LEFT, TOP, 31, 30, CRS["projected"]):
        pass
    tifs = [tmp_path / name for name in LAYERS]
    with pytest.raises(ValueError, match="another grid"):
        netcdf.write_bathymetry(tmp_path / "again.nc", *tifs, title="", history="", vertical_reference="")
    assert not list(tmp_path.glob("*again*"))
