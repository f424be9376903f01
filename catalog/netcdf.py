"""bathymetry.nc: the four layers of the bathymetry in one CF-NetCDF4 file, copied block by block from the rasters."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import uuid4

import h5netcdf
import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from .rasters import NODATA_M, SOURCE_NAMES, gdal_settings

_BLOCK: Final = 512
_COMPRESSION: Final[Mapping[str, Any]] = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


class _Variable(NamedTuple):
    name: str
    path: Path
    dtype: str
    fill: float | None
    attributes: Mapping[str, Any]


def write_bathymetry(
    path: str | os.PathLike[str],
    bathymetry_tif: str | os.PathLike[str],
    uncertainty_tif: str | os.PathLike[str],
    density_tif: str | os.PathLike[str],
    source_tif: str | os.PathLike[str],
    title: str,
    history: str,
    vertical_reference: str,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write a CF-1.8 file of elevation, uncertainty, density and source; memory is bounded by a block.

    Parameters
    ----------
    bathymetry_tif, uncertainty_tif, density_tif, source_tif : the rasters, on one grid.
    title, history : global attributes.
    vertical_reference : what elevations are measured from, for a person.
    attributes : more global attributes (institution, license, ...).
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}")
    with gdal_settings(), rasterio.open(bathymetry_tif) as file:
        crs, transform, width, height = pyproj.CRS.from_wkt(file.crs.to_wkt()), file.transform, file.width, file.height
    paths = [Path(p) for p in (bathymetry_tif, uncertainty_tif, density_tif, source_tif)]
    try:
        with gdal_settings(), h5netcdf.File(temporary, "w") as target:
            target.attrs.update(
                {"Conventions": "CF-1.8", "title": title, "history": history, "source": "seamosaic"}
                | dict(attributes or {})
            )
            target.dimensions = {"y": height, "x": width}
            _write_axes(target, crs, transform)
            _write_grid_mapping(target, crs, transform)
            for variable in _variables(paths, crs, vertical_reference):
                _copy(target, variable, (height, width))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _height_name(crs: pyproj.CRS) -> str | None:
    """CF standard name of heights above the vertical part of the CRS, if it has one."""
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if vertical is None:
        return None
    datum = vertical.datum.name.lower() if vertical.datum else ""
    return "height_above_mean_sea_level" if "mean sea level" in datum else "height_above_geopotential_datum"


def _variables(paths: list[Path], crs: pyproj.CRS, vertical_reference: str) -> Iterator[_Variable]:
    name = _height_name(crs)
    standard = {"standard_name": name} if name else {}
    yield _Variable(
        "elevation",
        paths[0],
        "f4",
        NODATA_M,
        standard
        | {
            "long_name": "elevation of the seabed",
            "units": "m",
            "positive": "up",
            "comment": f"Reference of heights: {vertical_reference}.",
            "ancillary_variables": "uncertainty density source",
        },
    )
    yield _Variable(
        "uncertainty",
        paths[1],
        "f4",
        NODATA_M,
        {
            "long_name": "1-sigma of the elevation relative to the map",
            "units": "m",
            "comment": "One cell against another, and the calibration's error; not that of navigation's datum.",
        },
    )
    yield _Variable(
        "density",
        paths[2],
        "i4",
        None,
        {"standard_name": "number_of_observations", "long_name": "soundings in the cell", "units": "1"},
    )
    names = {0: "none", **SOURCE_NAMES}
    yield _Variable(
        "source",
        paths[3],
        "i1",
        None,
        {
            "standard_name": "status_flag",
            "long_name": "where the elevation comes from",
            "flag_values": np.array(sorted(names), np.int8),
            "flag_meanings": " ".join(names[code].replace(" ", "_") for code in sorted(names)),
        },
    )


def _write_axes(target: h5netcdf.File, crs: pyproj.CRS, transform: rasterio.Affine) -> None:
    """Cell centres; y falls, as the rows of the rasters do."""
    height, width = target.dimensions["y"].size, target.dimensions["x"].size
    projected = crs.is_projected or any(part.is_projected for part in crs.sub_crs_list)
    axes: dict[str, NDArray[np.float64]] = {
        "x": transform.c + (np.arange(width) + 0.5) * transform.a,
        "y": transform.f + (np.arange(height) + 0.5) * transform.e,
    }
    for name, values in axes.items():
        variable = target.create_variable(name, (name,), "f8", data=values)
        variable.attrs.update({"long_name": f"{name} of the cell centre", "units": "m", "axis": name.upper()})
        if projected:
            variable.attrs["standard_name"] = f"projection_{name}_coordinate"


def _write_grid_mapping(target: h5netcdf.File, crs: pyproj.CRS, transform: rasterio.Affine) -> None:
    """The CF attributes of the CRS, with its WKT twice: crs_wkt for CF, spatial_ref and GeoTransform for GDAL."""
    variable = target.create_variable("crs", (), "i4")
    known = {key: value for key, value in crs.to_cf().items() if value is not None}
    variable.attrs.update(known | {"spatial_ref": crs.to_wkt("WKT1_GDAL", pretty=False)})
    variable.attrs["GeoTransform"] = " ".join(repr(float(v)) for v in transform.to_gdal())


def _copy(target: h5netcdf.File, variable: _Variable, shape: tuple[int, int]) -> None:
    chunks = tuple(min(_BLOCK, side) for side in shape)
    stored = target.create_variable(
        variable.name,
        ("y", "x"),
        variable.dtype,
        fillvalue=variable.fill,
        chunks=chunks,
        **_COMPRESSION,
    )
    stored.attrs.update(dict(variable.attributes) | {"grid_mapping": "crs"})
    empty = 0 if variable.fill is None else variable.fill
    with rasterio.open(variable.path) as file:
        if (file.height, file.width) != shape:
            raise ValueError(f"{variable.path.name} is on another grid than the bathymetry")
        for rows, cols in _blocks(shape):
            values = file.read(1, window=Window.from_slices(rows, cols))
            if (values != empty).any():  # a chunk that was never written takes no space and reads as empty
                stored[rows, cols] = values


def _blocks(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    for row in range(0, shape[0], _BLOCK):
        for col in range(0, shape[1], _BLOCK):
            yield slice(row, min(row + _BLOCK, shape[0])), slice(col, min(col + _BLOCK, shape[1]))
