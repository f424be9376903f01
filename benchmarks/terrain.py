"""Habitat layers beside those of GDAL, SAGA and GRASS, of whichever is installed, on the same grid.

    python benchmarks/terrain.py GRID.tif | POINTS.laz [--cell 0.25]

GRID.tif is any bathymetry.tif; points are gridded by their means first. Prints a line of JSON for each layer: cells
that both have, largest and median difference, and the median size of the reference's values. gdaldem computes with
float32, so it is given the grid less a whole number of metres, which changes none of its layers.
"""

import argparse
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import rasterio
from seamosaic.tasks import derivatives
from seamosaic.tasks.derivatives import Ring

FINE, BROAD = Ring(1, 5), Ring(5, 25)


def gridded(path: Path, cell_m: float, made: Path) -> Path:
    """Means of a cloud's elevations, as a GeoTIFF."""
    cloud = laspy.read(path)
    x, y, z = (np.asarray(axis) for axis in (cloud.x, cloud.y, cloud.z))
    column, row = (np.floor(axis / cell_m).astype(int) for axis in (x, -y))
    left, top = column.min(), row.min()
    shape = row.max() - top + 1, column.max() - left + 1
    at = np.ravel_multi_index((row - top, column - left), shape)
    count, total = (np.bincount(at, weights, shape[0] * shape[1]).reshape(shape) for weights in (None, z))
    mean = np.where(count > 0, total / np.maximum(count, 1), -9999).astype(np.float32)
    place = rasterio.Affine(cell_m, 0, left * cell_m, 0, -cell_m, -top * cell_m)
    about = {"width": shape[1], "height": shape[0], "count": 1, "crs": "EPSG:32617", "transform": place}
    with rasterio.open(made, "w", driver="GTiff", dtype="float32", nodata=-9999, **about) as file:
        file.write(mean, 1)
    return made


def read(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read(1, masked=True).filled(np.nan).astype(float)


def call(*command: object, **more: str) -> None:
    subprocess.run([str(part) for part in command], check=True, capture_output=True, env={**os.environ, **more})


def near_zero(grid: Path, made: Path) -> Path:
    """The grid less its median in whole metres."""
    with rasterio.open(grid) as file:
        values, profile = file.read(1, masked=True), file.profile
    with rasterio.open(made, "w", **{**profile, "driver": "GTiff"}) as file:
        file.write((values - np.float32(np.rint(np.ma.median(values)))).filled(file.nodata), 1)
    return made


def gdal(grid: Path, folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    grid = near_zero(grid, folder / "near-zero.tif")
    modes = {
        "slope": ("slope",),
        "aspect": ("aspect",),
        "tri": ("TRI", "-alg", "Wilson"),
        "tpi": ("TPI",),
        "roughness": ("roughness",),
    }
    for name, (mode, *options) in modes.items():
        call("gdaldem", mode, grid, folder / f"{name}.tif", *options)
        yield name, read(folder / f"{name}.tif")


def saga(grid: Path, folder: Path, cell_m: float) -> Iterator[tuple[str, np.ndarray]]:
    out = {name: folder / f"{name}.sdat" for name in ("slope", "aspect", "long", "cross", "fine", "broad")}
    plain = {name: path.with_suffix("") for name, path in out.items()}
    curvature = ("-METHOD", 6, "-C_LONG", plain["long"], "-C_CROS", plain["cross"])
    call(
        "saga_cmd",
        "ta_morphometry",
        0,
        "-ELEVATION",
        grid,
        "-SLOPE",
        plain["slope"],
        "-ASPECT",
        plain["aspect"],
        *curvature,
    )
    yield "profile-curvature", read(out["long"])
    yield "plan-curvature", read(out["cross"])
    for name, ring in (("fine", FINE), ("broad", BROAD)):
        radii = [cells * cell_m for cells in ring]
        call(
            "saga_cmd",
            "ta_morphometry",
            18,
            "-DEM",
            grid,
            "-TPI",
            plain[name],
            "-RADIUS_MIN",
            radii[0],
            "-RADIUS_MAX",
            radii[1],
        )
        yield f"bpi-{name}", read(out[name])


GRASS = """
r.in.gdal -o input={grid} output=z
g.region raster=z
r.slope.aspect elevation=z slope=s aspect=a format=degrees precision=DCELL min_slope=0.0
r.mapcalc "x = double(sin(a) * sin(s))"
r.mapcalc "y = double(cos(a) * sin(s))"
r.mapcalc "u = double(cos(s))"
for k in x y u; do r.neighbors input=$k output=m$k method=average size=3; done
r.mapcalc "v = 1 - sqrt(mx^2 + my^2 + mu^2)"
for k in s v; do r.out.gdal -f input=$k output={folder}/$k.tif format=GTiff type=Float64 nodata=-9999; done
"""


def grass(grid: Path, folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The steps of the add-on r.vector.ruggedness (size 3, no distance weights), in doubles."""
    script = folder / "steps.sh"
    script.write_text("set -e\n" + GRASS.format(grid=grid.resolve(), folder=folder))
    call("grass", "--tmp-location", grid.resolve(), "--exec", "bash", script)
    yield "slope", read(folder / "s.tif")
    yield "vrm", read(folder / "v.tif")


def compare(program: str, name: str, theirs: np.ndarray, ours: np.ndarray) -> dict:
    off = np.abs(theirs - ours)
    off = off[np.isfinite(off)]
    off = np.minimum(off, 360 - off) if name == "aspect" else off
    figures = {"largest": off.max(), "median": np.median(off), "size": np.nanmedian(np.abs(theirs))}
    return {
        "program": program,
        "layer": name,
        "cells": len(off),
        "of_ours": int(np.isfinite(ours).sum()),
        **{key: float(f"{value:.2g}") for key, value in figures.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("grid", type=Path)
    parser.add_argument("--cell", type=float, default=0.25)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        laz = arguments.grid.suffix == ".laz"
        grid = gridded(arguments.grid, arguments.cell, folder / "grid.tif") if laz else arguments.grid
        with rasterio.open(grid) as file:
            cell_m = file.res[0]
        ours = derivatives.layers(read(grid), cell_m, FINE, BROAD)
        programs = {
            "gdaldem": lambda: gdal(grid, folder),
            "saga_cmd": lambda: saga(grid, folder, cell_m),
            "grass": lambda: grass(grid, folder),
        }
        for program, layers in programs.items():
            if shutil.which(program) is None:
                print(json.dumps({"program": program, "installed": False}))
                continue
            for layer, theirs in layers():
                print(json.dumps(compare(program, layer, theirs, ours[layer].astype(float))))


if __name__ == "__main__":
    main()
