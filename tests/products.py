"""What two versions of products have in common: all data, not the times of day in their metadata."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import laspy
import numpy as np
import pyogrio
import rasterio
from seamosaic.schemas.products import PRODUCTS


def differing(a: Path, b: Path) -> list[str]:
    """Names of the products whose data are not the same, bit for bit."""
    names = sorted(
        {path.relative_to(folder).as_posix() for folder in (a, b) for path in folder.rglob("*") if path.is_file()}
    )
    assert {product.name for product in PRODUCTS if not product.name.startswith("metadata/")} <= set(names)
    return [name for name in names if not _same(a / name, b / name)]


def _same(a: Path, b: Path) -> bool:
    if not (a.exists() and b.exists()):
        return False
    read = _READERS.get(a.suffix, Path.read_bytes) if a.name not in _TIMED else _TIMED[a.name]
    return _equal(read(a), read(b))


def _equal(x: Any, y: Any) -> bool:
    if isinstance(x, dict):
        return x.keys() == y.keys() and all(_equal(x[key], y[key]) for key in x)
    if isinstance(x, list | tuple):
        return len(x) == len(y) and all(map(_equal, x, y))
    if isinstance(x, np.ndarray):
        if x.dtype == object:
            return x.shape == y.shape and all(map(_equal, x.tolist(), y.tolist()))
        return x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()
    return x == y


def _raster(path: Path) -> list[Any]:
    with rasterio.open(path) as file:
        overviews = [
            file.read(out_shape=(file.count, -(-file.height // n), -(-file.width // n))) for n in file.overviews(1)
        ]
        return [file.read(), file.dataset_mask(), file.crs.to_wkt(), tuple(file.transform), file.tags(), *overviews]


def _netcdf(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def _cloud(path: Path) -> dict[str, Any]:
    cloud = laspy.read(path)
    names = list(cloud.point_format.dimension_names)
    return {"scales": cloud.header.scales, "offsets": cloud.header.offsets} | {
        name: np.asarray(cloud[name]) for name in names
    }


def _layers(path: Path) -> dict[str, Any]:
    found = {}
    for layer in sorted(pyogrio.list_layers(path)[:, 0]):
        meta, fids, geometry, fields = pyogrio.raw.read(path, layer=layer, return_fids=True)
        found[layer] = [meta["crs"], meta["fields"], fids, geometry, list(fields)]
    return found


def _provenance(path: Path) -> Any:
    found = json.loads(path.read_text())
    return [found[name] for name in ("digest", "inputs", "parameters", "software")] + [sorted(found["outputs"])]


def _stac(path: Path) -> Any:
    found = json.loads(path.read_text())
    return [found["bbox"], found["geometry"], sorted(found["assets"])]


_READERS: dict[str, Callable[[Path], Any]] = {
    ".tif": _raster,
    ".nc": _netcdf,
    ".laz": _cloud,
    ".gpkg": _layers,
    ".json": lambda path: json.loads(path.read_text()),
}
_TIMED: dict[str, Callable[[Path], Any]] = {
    "provenance.json": _provenance,
    "stac-item.json": _stac,
    "report.html": lambda path: path.stat().st_size > 0,
}
