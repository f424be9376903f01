"""survey.gpkg: footprints, track, contours and coverage for a GIS, and how the last comes from a raster."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray
from rasterio import Affine, features

from .rasters import Overview, horizontal_wkt

Array = NDArray[np.float64]


class Footprint(NamedTuple):
    """What an image shows.

    Attributes
    ----------
    outline : (M, 2) corners in map coordinates, not closed; empty for an image without pose.
    image, time, status : as in trajectory.csv.
    """

    outline: Array
    image: str
    time: np.datetime64
    status: str


class Contour(NamedTuple):
    """A line (M, 2) of one elevation, map coordinates, metres."""

    elevation: float
    line: Array


class _Layer(NamedTuple):
    name: str
    kind: str
    geometries: Sequence[shapely.Geometry]
    fields: Mapping[str, NDArray[Any]]


def write_survey(
    path: str | os.PathLike[str],
    crs_wkt: str,
    footprints: Sequence[Footprint],
    track: Array,
    times: NDArray[np.datetime64],
    contours: Sequence[Contour],
    coverage: shapely.MultiPolygon,
    area_m2: float,
) -> None:
    """Write a GeoPackage 1.2 with the layers footprints, track, contours and coverage; empty ones exist too.

    Parameters
    ----------
    crs_wkt : of the map; of a compound CRS the horizontal part.
    track : (N, 2) or (N, 3) camera centres in map coordinates, in order of time.
    times : (N,) UTC.
    coverage : by the function of that name. area_m2 : of the map's cells themselves, which it generalises.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}.gpkg")
    layers = (_footprints(footprints), _track(track, times), _contours(contours), _coverage(coverage, area_m2))
    try:
        for number, layer in enumerate(layers):
            pyogrio.raw.write(
                temporary,
                np.array([shapely.to_wkb(geometry) for geometry in layer.geometries], object),
                list(layer.fields.values()),
                list(layer.fields),
                layer=layer.name,
                driver="GPKG",
                geometry_type=layer.kind,
                crs=horizontal_wkt(crs_wkt),
                append=number > 0,
                gdal_tz_offsets={
                    name: np.full(len(values), 100)  # GDAL's code for UTC
                    for name, values in layer.fields.items()
                    if values.dtype.kind == "M"
                },
                dataset_options={"VERSION": "1.2"} if number == 0 else None,
            )
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _texts(values: Sequence[str]) -> NDArray[Any]:
    return np.array(values, object)


def _footprints(footprints: Sequence[Footprint]) -> _Layer:
    seen = [footprint for footprint in footprints if len(footprint.outline) >= 3]
    fields = {
        "image": _texts([footprint.image for footprint in seen]),
        "time": np.array([footprint.time for footprint in seen], "datetime64[ms]"),
        "status": _texts([footprint.status for footprint in seen]),
    }
    return _Layer("footprints", "Polygon", [shapely.Polygon(footprint.outline) for footprint in seen], fields)


def _track(track: Array, times: NDArray[np.datetime64]) -> _Layer:
    drawable = len(track) >= 2
    ends = times[[0, -1]] if drawable else times[:0]
    fields = {
        "start": ends[:1].astype("datetime64[ms]"),
        "end": ends[1:].astype("datetime64[ms]"),
        "images": np.array([len(track)] if drawable else [], np.int32),
    }
    kind = "LineString Z" if track.shape[1:] == (3,) else "LineString"
    return _Layer("track", kind, [shapely.LineString(track)] if drawable else [], fields)


def _contours(contours: Sequence[Contour]) -> _Layer:
    elevations = np.array([contour.elevation for contour in contours], float)
    lines = [shapely.LineString(contour.line) for contour in contours]
    return _Layer("contours", "LineString", lines, {"elevation": elevations})


def _coverage(coverage: shapely.MultiPolygon, area_m2: float) -> _Layer:
    present = not coverage.is_empty
    fields = {"area_m2": np.array([area_m2] if present else [], float)}
    return _Layer("coverage", "MultiPolygon", [coverage] if present else [], fields)


def coverage(overview: Overview) -> shapely.MultiPolygon:
    """The outline, with holes, of where an overview has values, map coordinates."""
    transform = Affine(overview.cell_x_m, 0.0, overview.left_m, 0.0, -overview.cell_y_m, overview.top_m)
    shapes = features.shapes(overview.valid.astype(np.uint8), mask=overview.valid, transform=transform)
    return shapely.MultiPolygon(
        [shapely.Polygon(rings[0], rings[1:]) for rings in (geometry["coordinates"] for geometry, _ in shapes)]
    )
