"""Layers derived from bathymetry, against GDAL's own gdaldem and against surfaces whose values are known."""

import ctypes
from pathlib import Path

import numpy as np
import pytest
import rasterio
from seamosaic.tasks import derivatives
from seamosaic.tasks.derivatives import Ring, benthic_position, curvatures

CELL = 0.02


def _seabed(rows=90, columns=110, holes=True):
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:rows, :columns] * CELL
    z = -20 + 0.3 * np.sin(2 * x) * np.cos(3 * y) + 0.15 * x + rng.normal(0, 0.003, x.shape)
    if holes:
        z[20:30, 40:55] = np.nan
        z[70, 3] = np.nan
    return z.astype(np.float32).astype(float)


def _gdaldem(z, mode, folder, options=()):
    """What GDAL's DEM processing, of the library that comes with rasterio, makes of a grid."""
    libraries = sorted((Path(rasterio.__file__).parent.parent / "rasterio.libs").glob("libgdal*"))
    if not libraries:
        pytest.skip("this rasterio brings no GDAL library of its own")
    gdal = ctypes.CDLL(str(libraries[0]))
    pointer, text = ctypes.c_void_p, ctypes.c_char_p
    gdal.GDALOpen.restype = gdal.GDALDEMProcessing.restype = gdal.GDALDEMProcessingOptionsNew.restype = pointer
    gdal.GDALDEMProcessingOptionsNew.argtypes = [pointer, pointer]
    gdal.GDALDEMProcessing.argtypes = [text, pointer, text, text, pointer, pointer]
    gdal.GDALClose.argtypes = gdal.GDALDEMProcessingOptionsFree.argtypes = [pointer]
    gdal.GDALOpen.argtypes = [text, ctypes.c_int]
    source, made = folder / "z.tif", folder / f"{mode}.tif"
    place = rasterio.Affine(CELL, 0, 500_000, 0, -CELL, 4_700_000)
    about = {"width": z.shape[1], "height": z.shape[0], "count": 1, "crs": "EPSG:32631", "transform": place}
    with rasterio.open(source, "w", driver="GTiff", dtype="float32", nodata=-9999, **about) as file:
        file.write(np.nan_to_num(z, nan=-9999).astype(np.float32), 1)
    gdal.GDALAllRegister()
    arguments = (text * (len(options) + 1))(*(option.encode() for option in options), None)
    chosen, opened = gdal.GDALDEMProcessingOptionsNew(arguments, None), gdal.GDALOpen(str(source).encode(), 0)
    result = gdal.GDALDEMProcessing(str(made).encode(), opened, mode.encode(), None, chosen, None)
    gdal.GDALDEMProcessingOptionsFree(chosen)
    gdal.GDALClose(opened)
    gdal.GDALClose(result)
    with rasterio.open(made) as file:
        return file.read(1, masked=True).filled(np.nan).astype(float)


@pytest.mark.parametrize(
    ("mode", "options", "ours", "most"),
    [
        ("slope", (), lambda z: derivatives.slope_deg(z, CELL), 0.01),
        ("aspect", (), lambda z: derivatives.aspect_deg(z, CELL), 0.05),
        ("TRI", ("-alg", "Wilson"), derivatives.ruggedness, 1e-5),
        ("TPI", (), derivatives.position, 1e-5),
        ("Roughness", (), derivatives.roughness, 1e-5),
    ],
)
def test_the_same_as_gdaldem(tmp_path, mode, options, ours, most):
    z = _seabed()
    theirs, mine = _gdaldem(z, mode, tmp_path, options), ours(z)
    both = np.isfinite(theirs) & np.isfinite(mine)
    if mode == "aspect":  # GDAL computes with float32, which tells little where it is nearly level
        both &= derivatives.slope_deg(z, CELL) > 5
    assert both.sum() > 0.6 * z.size
    off = np.abs(theirs - mine)[both]
    assert (np.minimum(off, 360 - off) if mode == "aspect" else off).max() < most
    assert np.array_equal(np.isfinite(theirs), np.isfinite(mine)) or mode == "aspect"


def test_level_ground_has_no_aspect_and_nothing_else():
    z = np.full((12, 12), -5.0)
    assert np.isnan(derivatives.aspect_deg(z, CELL)).all()
    inner = (slice(2, -2), slice(2, -2))
    for layer in (derivatives.slope_deg(z, CELL), derivatives.vector_ruggedness(z, CELL), *curvatures(z, CELL)):
        assert np.abs(layer[inner]).max() < 1e-12
    assert np.allclose(derivatives.surface_rugosity(z, CELL)[inner], 1)


def test_curvatures_of_a_dome_and_of_a_channel():
    y, x = (np.mgrid[-30:31, -30:31] * CELL)[:, ::-1]
    inner = (slice(1, -1), slice(1, -1))
    # on a paraboloid z = -a r^2 / 2 both second derivatives are -a: convex down the slope and across it
    profile, plan = curvatures(-0.8 * (x**2 + y**2) / 2, CELL)
    away = np.hypot(x, y)[inner] > 0.05
    assert np.allclose(profile[inner][away], 0.8)
    assert np.allclose(plan[inner][away], 0.8)
    profile, plan = curvatures(0.5 * y + 0.6 * x**2 / 2, CELL)  # down the middle of a channel
    assert np.allclose(plan[1:-1, 30], -0.6)
    assert np.allclose(profile[1:-1, 30], 0)


def test_a_slope_is_no_rougher_than_level_ground_but_larger():
    y, x = np.mgrid[:20, :20] * CELL
    z, inner = 0.75 * x - 0.2 * y, (slice(2, -2), slice(2, -2))
    assert np.allclose(derivatives.vector_ruggedness(z, CELL)[inner], 0)
    assert np.allclose(derivatives.surface_rugosity(z, CELL)[inner], np.sqrt(1 + 0.75**2 + 0.2**2))
    rough = _seabed(holes=False)
    assert 0.0005 < np.nanmedian(derivatives.vector_ruggedness(rough, CELL)) < 0.2


def test_benthic_position_tells_crests_from_hollows_at_its_scale():
    y, x = np.mgrid[:80, :80] * CELL
    z = 0.05 * np.cos(2 * np.pi * x / 0.8)
    found = benthic_position(z, Ring(3, 20))
    assert (found[30:50, 40] > 0.02).all()
    assert (found[30:50, 20] < -0.02).all()
    assert np.isnan(found[0, 0])
    # a straight slope has none
    assert np.abs(benthic_position(0.3 * x - y, Ring(2, 10))[12:-12, 12:-12]).max() < 1e-7


@pytest.mark.parametrize("ring", [Ring(0, 1), Ring(1, 5), Ring(5, 25), Ring(7, 7)])
def test_benthic_position_is_the_mean_of_its_ring_and_no_other(ring):
    z, (inner, outer) = _seabed(), ring
    found = benthic_position(z, ring)
    y, x = np.mgrid[: z.shape[0], : z.shape[1]]
    for row, column in ((45, 60), (25, 36), (5, 5), (70, 4), (0, 50)):
        away2 = (y - row) ** 2 + (x - column) ** 2
        within = (away2 >= inner**2) & (away2 <= outer**2)
        values = z[within & np.isfinite(z)]
        whole = sum(inner**2 <= i * i + j * j <= outer**2 for i in range(-25, 26) for j in range(-25, 26))
        if 2 * len(values) > whole:
            assert found[row, column] == pytest.approx(z[row, column] - values.mean(), abs=1e-9)
        else:
            assert np.isnan(found[row, column])


def test_tiles_with_a_rim_have_the_bits_of_the_whole():
    fine, broad = Ring(1, 5), Ring(3, 9)
    z, rim = _seabed(), derivatives.reach(broad)
    whole = derivatives.layers(z, CELL, fine, broad)
    pasted = {name: np.full(z.shape, np.inf, np.float32) for name in whole}
    wide = np.pad(z, rim, constant_values=np.nan)
    for top in range(0, z.shape[0], 37):
        for left in range(0, z.shape[1], 41):
            rows, columns = z[top : top + 37, left : left + 41].shape
            around = wide[top : top + rows + 2 * rim, left : left + columns + 2 * rim]
            for name, part in derivatives.layers(around, CELL, fine, broad).items():
                pasted[name][top : top + rows, left : left + columns] = part[rim:-rim, rim:-rim]
    assert len(whole) == 11
    for name, values in whole.items():
        assert np.array_equal(values, pasted[name], equal_nan=True), name
        assert np.isfinite(values).any(), name
