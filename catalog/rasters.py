"""Cloud-optimised GeoTIFFs, written window by window and read back at overview resolution.

A grid comes as plain numbers: `cell_m`, `left`, `top`, `width`, `height`, where left and top count whole cells in
map coordinates (x of the left edge = left * cell_m, y of the top edge = top * cell_m) and row 0 is the northernmost.
"""

import math
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal, NamedTuple, Self
from uuid import uuid4

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.enums import Resampling as Resampled
from rasterio.errors import StatisticsError
from rasterio.io import DatasetWriter
from rasterio.shutil import copy as gdal_copy
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

NODATA_M: Final = -9999.0
_BLOCK: Final = 512
_JPEG_QUALITY: Final = 90
_CACHE_BYTES: Final = 128 * 1024 * 1024  # rasterio hands the number to GDAL as bytes
_HISTOGRAM_BINS: Final = 65536

# What GeoTIFF keys can carry of an engineering CRS, so that it comes back from a file as it went in.
_LOCAL_CRS: Final = (
    'LOCAL_CS["seamosaic local frame",UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
    'AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)

Resampling = Literal["average", "nearest"]
Colour = tuple[int, int, int, int]


def local_crs_wkt() -> str:
    """WKT of the engineering CRS, in metres, of a mission without navigation."""
    return _LOCAL_CRS


def horizontal_wkt(crs_wkt: str) -> str:
    """WKT of the horizontal part of a compound CRS; any other CRS as it is."""
    crs = pyproj.CRS.from_wkt(crs_wkt)
    return crs.sub_crs_list[0].to_wkt() if crs.is_compound else crs_wkt


class Layer(NamedTuple):
    """How one raster product is stored.

    Attributes
    ----------
    descriptions : one a band.
    dtype, nodata : of every band; nodata None means that every cell has a value (or that there is a mask).
    unit : of every band, empty for codes and colours.
    resampling : how overviews are made: average for quantities and colours, nearest for codes and numbers.
    mask : whether an internal mask, not a nodata value, tells which pixels are there.
    heights : whether the values are heights: only then the file carries the vertical part of a compound CRS,
        because programs take every band of such a file for metres above its datum.
    colours : colour table of codes.
    """

    descriptions: tuple[str, ...]
    dtype: str
    nodata: float | None
    unit: str = ""
    resampling: Resampling = "average"
    mask: bool = False
    heights: bool = False
    colours: Mapping[int, Colour] | None = None


SOURCE_NAMES: Final[Mapping[int, str]] = {1: "laser", 2: "image matching", 3: "interpolated"}
SOURCE_COLOURS: Final[Mapping[int, Colour]] = {
    0: (0, 0, 0, 0),
    1: (0, 158, 115, 255),
    2: (0, 114, 178, 255),
    3: (230, 159, 0, 255),
}
_RGB: Final = ("red", "green", "blue")
_SOURCES: Final = ", ".join(f"{code} {name}" for code, name in SOURCE_NAMES.items())

LAYERS: Final[Mapping[str, Layer]] = {
    "bathymetry.tif": Layer(("elevation, positive up",), "float32", NODATA_M, "metre", heights=True),
    "uncertainty.tif": Layer(("1-sigma of the elevation relative to the map",), "float32", NODATA_M, "metre"),
    "density.tif": Layer(("soundings in the cell",), "uint32", None),
    "source.tif": Layer((f"source: {_SOURCES}",), "uint8", 0, resampling="nearest", colours=SOURCE_COLOURS),
    **{
        f"terrain/{name}.tif": Layer((about,), "float32", NODATA_M, unit, "nearest" if name == "aspect" else "average")
        for name, about, unit in (
            ("slope", "slope", "degree"),
            ("aspect", "direction of falling ground, clockwise from grid north", "degree"),
            ("profile-curvature", "curvature along the slope, convex positive", "1/metre"),
            ("plan-curvature", "curvature across the slope, convex positive", "1/metre"),
            ("bpi-fine", "bathymetric position index, narrow ring", "metre"),
            ("bpi-broad", "bathymetric position index, wide ring", "metre"),
            ("vrm", "vector ruggedness measure", "1"),
            ("rugosity", "surface area over planar area", "1"),
            ("roughness", "largest difference in 3 x 3 cells", "metre"),
            ("tri", "terrain ruggedness index", "metre"),
            ("tpi", "topographic position index", "metre"),
        )
    },
    "mosaic.tif": Layer(_RGB, "uint8", None, mask=True),
    "mosaic-source.tif": Layer(("row of trajectory.csv, from 0",), "int32", -1, resampling="nearest"),
    "mosaic-painted.tif": Layer(
        ("1 painted: only images that the laser lights there see it",), "uint8", 0, resampling="nearest"
    ),
    "mosaic-planar.tif": Layer(_RGB, "uint8", None, mask=True),
}


class RasterWriter:
    """Writes one COG window by window; use as a context manager.

    Windows go to a temporary tiled file beside `path`; leaving the context makes the COG from it and renames it
    into place. Memory does not grow with the raster. After an exception nothing is left behind.

    Parameters
    ----------
    cell_m, left, top, width, height : the grid, see the module's docstring.
    crs_wkt : projected, compound or engineering CRS (`local_crs_wkt`); WKT 1 or 2.
    tags : metadata of the whole file, e.g. the vertical reference.
    layer : how it is stored; `LAYERS` holds those of the products.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        cell_m: float,
        left: int,
        top: int,
        width: int,
        height: int,
        crs_wkt: str,
        layer: Layer,
        tags: Mapping[str, str] | None = None,
    ):
        if width < 1 or height < 1:
            raise ValueError(f"a raster needs at least one cell, found {width} x {height}")
        self.path, self.layer, self._tags = Path(path), layer, dict(tags or {})
        stem = f".{self.path.name}.{uuid4().hex[:8]}"
        self._windows, self._cog = self.path.with_name(f"{stem}.windows"), self.path.with_name(f"{stem}.cog")
        self._profile = {
            "driver": "GTiff",
            "width": width,
            "height": height,
            "count": len(layer.descriptions),
            "dtype": layer.dtype,
            "nodata": layer.nodata,
            "crs": CRS.from_wkt(crs_wkt if layer.heights else horizontal_wkt(crs_wkt)),
            "transform": Affine(cell_m, 0.0, left * cell_m, 0.0, -cell_m, top * cell_m),
            "tiled": True,
            "blockxsize": _BLOCK,
            "blockysize": _BLOCK,
            "compress": "zstd",  # what is read once again
            "zstd_level": 1,
            "sparse_ok": True,
            "bigtiff": "if_safer",
        }
        self._file: DatasetWriter | None = None

    def __enter__(self) -> Self:
        self.path.parent.mkdir(exist_ok=True)
        with gdal_settings():
            file = self._file = rasterio.open(self._windows, "w", **self._profile)
            self._describe(file)
            if self.layer.mask:  # even a mosaic without a single pixel says so by its mask
                corner = Window(0, 0, 1, 1)  # pyright: ignore[reportCallIssue]
                file.write_mask(np.zeros((1, 1), np.uint8), window=corner)
        return self

    def _describe(self, file: DatasetWriter) -> None:
        count, layer = file.count, self.layer
        file.descriptions = layer.descriptions
        file.update_tags(AREA_OR_POINT="Area", **self._tags)
        if layer.unit:
            file.units, file.scales, file.offsets = (layer.unit,) * count, (1.0,) * count, (0.0,) * count
        if layer.colours:
            file.write_colormap(1, dict(layer.colours))

    def write(self, col: int, row: int, values: NDArray[np.generic], mask: NDArray[np.bool_] | None = None) -> None:
        """Write a window whose top left cell is (col, row).

        Parameters
        ----------
        values : (bands, h, w) or (h, w). NaN becomes the nodata value.
        mask : (h, w), True where a pixel is there; needed if, and only if, the layer has a mask.
        """
        file = self._file
        assert file is not None, "RasterWriter is used as a context manager"
        if (mask is not None) != self.layer.mask:
            raise ValueError(f"{self.path.name} {'needs' if self.layer.mask else 'takes no'} mask")
        values = values if values.ndim == 3 else values[None]
        window = Window(col, row, values.shape[2], values.shape[1])  # pyright: ignore[reportCallIssue]
        if col < 0 or row < 0 or col + values.shape[2] > file.width or row + values.shape[1] > file.height:
            raise ValueError(f"window {window} is outside {file.width} x {file.height}")
        if self.layer.nodata is not None and np.issubdtype(values.dtype, np.floating):
            values = np.where(np.isnan(values), self.layer.nodata, values)
        with gdal_settings():
            file.write(values.astype(self.layer.dtype, copy=False), window=window)
            if mask is not None:
                file.write_mask(np.where(mask, 255, 0).astype(np.uint8), window=window)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        assert self._file is not None
        try:
            with gdal_settings():
                self._file.close()
                if kind is None:
                    self._add_overviews()
                    gdal_copy(str(self._windows), str(self._cog), driver="COG", **self._cog_options())
                    os.replace(self._cog, self.path)
        finally:
            self._windows.unlink(missing_ok=True)
            self._cog.unlink(missing_ok=True)

    def _add_overviews(self) -> None:
        """Overviews, each half the size of the one before, rounded up, and statistics of quantities.

        The COG driver would make them through other files, at twice the cost.
        """
        with (
            rasterio.Env(SPARSE_OK_OVERVIEW=True, ZSTD_LEVEL_OVERVIEW=1, GDAL_TIFF_OVR_BLOCKSIZE=_BLOCK),
            rasterio.open(self._windows, "r+") as file,
        ):
            levels = math.ceil(math.log2(max(file.width, file.height, _BLOCK) / _BLOCK))
            file.build_overviews([2**level for level in range(1, levels + 1)], Resampled[self.layer.resampling])
            if self.layer.resampling == "average" and not self.layer.mask:  # codes and numbers have no mean
                with suppress(StatisticsError):  # not one cell has a value
                    file.update_stats(approx=False)

    def _cog_options(self) -> dict[str, str]:
        """Lossless with a predictor for data; JPEG with an internal mask for pictures, which every GIS reads."""
        common = {
            "BLOCKSIZE": str(_BLOCK),
            "BIGTIFF": "IF_SAFER",
            "SPARSE_OK": "YES",  # what a survey leaves empty of its rectangle costs nothing
            "OVERVIEWS": "FORCE_USE_EXISTING",
            "NUM_THREADS": "ALL_CPUS",
        }
        if self.layer.mask:
            return common | {"COMPRESS": "JPEG", "QUALITY": str(_JPEG_QUALITY), "OVERVIEW_QUALITY": str(_JPEG_QUALITY)}
        return common | {"COMPRESS": "DEFLATE", "PREDICTOR": "YES"}


def gdal_settings() -> rasterio.Env:
    """Masks inside the file, no side files next to the products, and a cache that does not grow with the machine.

    The size of the cache holds for the process, from its first use of GDAL.
    """
    return rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED=False, GDAL_CACHEMAX=_CACHE_BYTES)


def product_writer(
    folder: str | os.PathLike[str],
    name: str,
    cell_m: float,
    left: int,
    top: int,
    width: int,
    height: int,
    crs_wkt: str,
    tags: Mapping[str, str] | None = None,
) -> RasterWriter:
    """The writer of one raster product of FORMATS, by its file name."""
    return RasterWriter(Path(folder) / name, cell_m, left, top, width, height, crs_wkt, LAYERS[name], tags)


class Overview(NamedTuple):
    """A raster read small.

    Attributes
    ----------
    values : (bands, rows, cols), row 0 north; NaN where a float raster is empty.
    valid : (rows, cols), whether there is a value.
    cell_x_m, cell_y_m : size of a pixel of `values`, metres.
    left_m, top_m : map coordinates of the top left corner of the top left pixel.
    """

    values: NDArray[np.generic]
    valid: NDArray[np.bool_]
    cell_x_m: float
    cell_y_m: float
    left_m: float
    top_m: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top in map coordinates."""
        rows, cols = self.valid.shape
        return self.left_m, self.left_m + cols * self.cell_x_m, self.top_m - rows * self.cell_y_m, self.top_m


def read_overview(path: str | os.PathLike[str], max_px: int = 1500) -> Overview:
    """The raster at the finest power of two at which neither side is longer than max_px.

    Memory is bounded by max_px, because that size comes from the file's own overviews.
    """
    with gdal_settings(), rasterio.open(path) as file:
        factor = 1
        while max(file.width, file.height) > factor * max_px:
            factor *= 2
        shape = -(-file.height // factor), -(-file.width // factor)
        values = file.read(out_shape=(file.count, *shape))
        valid = file.dataset_mask(out_shape=shape) > 0
        transform = file.transform
        if np.issubdtype(values.dtype, np.floating):
            values = np.where(valid, values, np.nan)
        scale_x, scale_y = file.width / shape[1], file.height / shape[0]
        return Overview(values, valid, transform.a * scale_x, -transform.e * scale_y, transform.c, transform.f)


class Summary(NamedTuple):
    """Figures of the first band of a raster at full resolution; None where no cell has a value.

    Attributes
    ----------
    cells : cells with a value.
    minimum, maximum : exact.
    median : to 1/65536 of the range.
    """

    cells: int
    minimum: float | None
    maximum: float | None
    median: float | None


def summarise(path: str | os.PathLike[str]) -> Summary:
    """Count, range and median of a raster, block by block."""
    with gdal_settings(), rasterio.open(path) as file:
        cells, low, high = 0, np.inf, -np.inf
        for values in _valid_blocks(file):
            cells, low, high = cells + len(values), min(low, values.min()), max(high, values.max())
        if not cells:
            return Summary(0, None, None, None)
        counts = np.zeros(_HISTOGRAM_BINS, np.int64)
        span = (high - low) or 1.0
        for values in _valid_blocks(file):
            bins = ((values - low) * ((_HISTOGRAM_BINS - 1) / span)).round().astype(np.int64)
            counts += np.bincount(bins, minlength=_HISTOGRAM_BINS)
    middle = int(np.searchsorted(np.cumsum(counts), cells / 2))
    return Summary(cells, float(low), float(high), float(low + middle * span / (_HISTOGRAM_BINS - 1)))


def covered_share(path: str | os.PathLike[str], picture: str | os.PathLike[str]) -> float | None:
    """Share of a raster's cells with a value in whose middle a picture on a grid of its own has a pixel.

    The picture is looked at in the overview nearest to the raster's cells. None where no cell has a value.
    """
    with gdal_settings(), rasterio.open(path) as file, rasterio.open(picture) as seen:
        grid = {"crs": seen.crs, "transform": file.transform, "width": file.width, "height": file.height}
        cells, covered = 0, 0
        with WarpedVRT(seen, **grid, resampling=Resampled.nearest) as moved:
            for _, window in file.block_windows(1):
                valid = file.read_masks(1, window=window) > 0
                if valid.any():
                    cells += int(valid.sum())
                    covered += int((moved.dataset_mask(window=window)[valid] > 0).sum())
    return covered / cells if cells else None


def count_codes(path: str | os.PathLike[str]) -> dict[int, int]:
    """Cells of each code of a raster of codes, block by block."""
    counts: dict[int, int] = {}
    with gdal_settings(), rasterio.open(path) as file:
        for values in _valid_blocks(file):
            for code, count in zip(*np.unique(values, return_counts=True), strict=True):
                counts[int(code)] = counts.get(int(code), 0) + int(count)
    return counts


def _valid_blocks(file: rasterio.DatasetReader):
    """The values (N,), as floats, of each block that has any."""
    for _, window in file.block_windows(1):
        valid = file.read_masks(1, window=window) > 0
        if valid.any():
            yield file.read(1, window=window)[valid].astype(np.float64)
