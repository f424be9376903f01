"""quality.json and the metadata/ folder: provenance and a STAC item."""

import hashlib
import json
import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

import numpy as np
import pyproj
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.coords import BoundingBox

from ..schemas.base import Model
from ..schemas.products import PRODUCTS, Product, Quality
from ..schemas.provenance import Host, Provenance

# Distributions whose version can change a result
_SOFTWARE: Final = (
    *("seamosaic", "numpy", "scipy", "opencv-python-headless", "gtsam", "rasterio", "pyproj", "dask", "xarray"),
    *("laspy", "lazrs", "h5netcdf", "h5py", "pyogrio", "shapely", "pillow", "matplotlib"),
    *("open3d-cpu", "open3d"),
)
_PROJECTION: Final = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
FILE_EXTENSION: Final = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
_EDGE_STEPS: Final = 16
_MULTIHASH_SHA256: Final = "1220"


def sha256_of(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def multihash(sha256: str) -> str:
    """A SHA-256 as the file extension of STAC writes it."""
    return _MULTIHASH_SHA256 + sha256


def output_digests(folder: str | os.PathLike[str], known: Mapping[str, str] | None = None) -> dict[str, str]:
    """SHA-256 of every file in a version's folder but those of metadata/, which tell of the others.

    known : of files that need not be read.
    """
    root, known = Path(folder), known or {}
    files = sorted(path for path in root.rglob("*") if path.is_file())
    names = [(path.relative_to(root).as_posix(), path) for path in files]
    return {name: known.get(name) or sha256_of(path) for name, path in names if not name.startswith("metadata/")}


def software_versions() -> dict[str, str]:
    """Versions of everything that can change a result."""
    found = {"python": platform.python_version(), "gdal": rasterio.__gdal_version__, "proj": pyproj.proj_version_str}
    for name in _SOFTWARE:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # open3d's other build
            continue
    return found


def host() -> Host:
    """The kind of this machine."""
    return Host(platform=f"{platform.system()} {platform.machine()}", cpu_count=os.cpu_count() or 1)


def write_provenance(path: str | os.PathLike[str], provenance: Provenance) -> None:
    """Write metadata/provenance.json."""
    _write_model(path, provenance)


def write_quality(path: str | os.PathLike[str], quality: Quality) -> None:
    """Write quality.json."""
    _write_model(path, quality)


def _write_model(path: str | os.PathLike[str], model: Model) -> None:
    _write_json(path, model.model_dump(mode="json"))


def _write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> None:
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex[:8]}")
    try:
        temporary.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_stac_item(
    folder: str | os.PathLike[str],
    mission_id: str,
    version_number: int,
    title: str,
    start: datetime,
    end: datetime,
    digests: Mapping[str, str],
    properties: Mapping[str, Any] | None = None,
) -> Path:
    """Write metadata/stac-item.json (STAC 1.0).

    Geometry and projection are those of bathymetry.tif, without navigation there is no geometry; every file of the
    product table that is in the folder becomes an asset.

    Parameters
    ----------
    start, end : first and last exposure, UTC.
    digests : SHA-256 of the files, by `output_digests`.
    properties : more properties of the item (license, platform, ...).
    """
    root = Path(folder)
    with rasterio.open(root / "bathymetry.tif") as file:
        crs, bounds = pyproj.CRS.from_wkt(file.crs.to_wkt()), file.bounds
    place = {"geometry": None}
    if not crs.is_engineering:
        geometry, bbox = _geometry(_geographic_outline(crs, bounds))
        place = {"bbox": bbox, "geometry": geometry}
    code = authority_code(crs)
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": [_PROJECTION, FILE_EXTENSION],
        "id": f"{mission_id}-v{version_number}",
        **place,
        "properties": {
            "title": title or mission_id,
            "datetime": None,
            "start_datetime": _rfc3339(start),
            "end_datetime": _rfc3339(end),
            "created": _rfc3339(datetime.now(UTC)),
            "proj:code": code,
            **({} if code else {"proj:wkt2": crs.to_wkt("WKT2_2019")}),
            "proj:bbox": list(bounds),
            **(properties or {}),
        },
        "links": [],
        "assets": {product.name: _asset(root, product, digests) for product in _present(root)},
    }
    path = root / "metadata" / "stac-item.json"
    _write_json(path, item)
    return path


def authority_code(crs: pyproj.CRS) -> str | None:
    """EPSG:code, or EPSG:horizontal+vertical for a compound CRS; None where that does not name it."""
    found = [part.to_authority() for part in (crs.sub_crs_list if crs.is_compound else [crs])]
    codes = [code for code in found if code is not None]
    if len(codes) < len(found) or len({authority for authority, _ in codes}) > 1:
        return None
    return f"{codes[0][0]}:{'+'.join(code for _, code in codes)}"


def _present(root: Path) -> Iterable[Product]:
    return (product for product in PRODUCTS if (root / product.name).is_file())


def _asset(root: Path, product: Product, digests: Mapping[str, str]) -> dict[str, Any]:
    path = root / product.name
    asset: dict[str, Any] = {
        "href": f"../{product.name}",
        "title": product.name,
        "description": product.description,
        "type": product.media_type,
        "roles": [product.role],
        "file:size": path.stat().st_size,
        "file:checksum": multihash(digests.get(product.name) or sha256_of(path)),
    }
    if path.suffix == ".tif":
        with rasterio.open(path) as file:
            asset["proj:shape"] = [file.height, file.width]
            asset["proj:transform"] = list(file.transform)[:6]
    return asset


def _geographic_outline(crs: pyproj.CRS, bounds: BoundingBox) -> list[tuple[float, float]]:
    """WGS 84 longitude and latitude along the edge of the map, counter-clockwise and closed (RFC 7946)."""
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    to_geographic = pyproj.Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True)
    left, bottom, right, top = bounds
    corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
    steps = np.arange(0, len(corners) - 1, 1 / _EDGE_STEPS)
    xs, ys = (np.interp(steps, range(len(corners)), values) for values in zip(*corners, strict=True))
    longitudes, latitudes = to_geographic.transform(xs, ys)
    points = [(round(float(x), 9), round(float(y), 9)) for x, y in zip(longitudes, latitudes, strict=True)]
    return [*points, points[0]]


def _geometry(ring: Sequence[tuple[float, float]]) -> tuple[dict[str, Any], list[float]]:
    """GeoJSON geometry and bounding box of an outline; across the 180th meridian it is cut there (RFC 7946, 3.1.9)."""
    longitude, latitude = np.array(ring).T
    longitude = np.unwrap(longitude, period=360)
    if abs(longitude[-1] - longitude[0]) > 180:
        return _around_a_pole(longitude[:-1], latitude[:-1])
    bbox = [longitude.min(), latitude.min(), longitude.max(), latitude.max()]
    if bbox[0] >= -180 and bbox[2] <= 180:
        return {"type": "Polygon", "coordinates": [[list(point) for point in ring]]}, [float(edge) for edge in bbox]
    whole = shapely.Polygon(np.column_stack([longitude, latitude]))
    parts = []
    for turn in (-360, 0, 360):
        part = whole.intersection(shapely.box(turn - 180, -90, turn + 180, 90))
        if part.area:
            edge = shapely.get_coordinates(shapely.orient_polygons(part)) - (turn, 0)
            parts.append([np.round(edge, 9).tolist()])
    west, east = ((bbox[k] + 180) % 360 - 180 for k in (0, 2))
    return {"type": "MultiPolygon", "coordinates": parts}, [float(edge) for edge in (west, bbox[1], east, bbox[3])]


def _around_a_pole(
    longitude: NDArray[np.floating], latitude: NDArray[np.floating]
) -> tuple[dict[str, Any], list[float]]:
    """Of an outline (N,) with a pole inside: on a plate carrée it reaches from one edge to the other."""
    longitude = (longitude + 180) % 360 - 180
    order = np.argsort(longitude)
    longitude, latitude = longitude[order], latitude[order]
    pole = math.copysign(90, latitude[0])
    edge = float(np.interp(180, [longitude[-1], longitude[0] + 360], latitude[[-1, 0]]))
    x, y = [-180, *longitude, 180, 180, -180], [edge, *latitude, edge, pole, pole]
    whole = shapely.orient_polygons(shapely.Polygon(np.column_stack([x, y])))
    geometry = {"type": "Polygon", "coordinates": [np.round(shapely.get_coordinates(whole), 9).tolist()]}
    return geometry, [-180.0, float(min(y)), 180.0, float(max(y))]


def _rfc3339(time: datetime) -> str:
    return time.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
