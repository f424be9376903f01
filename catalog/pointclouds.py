"""soundings.laz: LAZ 1.4, written in batches of any size."""

import os
from pathlib import Path
from typing import Final, Self
from uuid import uuid4

import laspy
import numpy as np
import pyproj
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

SCALE_M: Final = 1e-4
_SEABED: Final = 40  # ASPRS class "bathymetric point"
_FORMAT: Final = 6
_EXTRA: Final = (
    laspy.ExtraBytesParams("frame", "int32", "row of trajectory.csv, from 0"),
    laspy.ExtraBytesParams("arm", "uint8", "laser sheet, from 0"),
    laspy.ExtraBytesParams("sigma", "float32", "1-sigma along the ray, m"),
)


class SoundingsWriter:
    """Writes soundings batch by batch; use as a context manager. Memory is that of one batch.

    The file appears under its name only when all went well; after an exception nothing is left.

    Parameters
    ----------
    crs_wkt : projected, compound or engineering CRS.
    offset : (3,) map coordinates near the soundings; coordinates are stored as 0.1 mm steps from it.
    """

    def __init__(self, path: str | os.PathLike[str], crs_wkt: str, offset: NDArray[np.float64]):
        self.path = Path(path)
        self._temporary = self.path.with_name(f".{self.path.name}.{uuid4().hex[:8]}.laz")
        header = laspy.LasHeader(version="1.4", point_format=_FORMAT)
        header.scales, header.offsets = np.full(3, SCALE_M), np.asarray(offset, float)
        header.generating_software = "seamosaic"
        header.add_extra_dims(list(_EXTRA))
        # LAS 1.4 asks for WKT 1
        header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS.from_wkt(crs_wkt).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
        self._header = header

    def __enter__(self) -> Self:
        self._writer = laspy.open(self._temporary, mode="w", header=self._header)
        return self

    def write(
        self,
        X_map: NDArray[np.float64],
        frame: NDArray[np.integer],
        arm: NDArray[np.integer],
        sigma_m: NDArray[np.floating],
    ) -> None:
        """Add soundings.

        Parameters
        ----------
        X_map : (N, 3) map coordinates, metres.
        frame : (N,) row of trajectory.csv.
        arm : (N,) index of the laser sheet.
        sigma_m : (N,) 1-sigma along the ray, metres.
        """
        if not len(X_map):
            return
        points = laspy.ScaleAwarePointRecord.zeros(len(X_map), header=self._header)
        points.x, points.y, points.z = np.asarray(X_map, float).T
        points["frame"], points["arm"], points["sigma"] = frame, arm, sigma_m
        points["classification"] = np.full(len(X_map), _SEABED, np.uint8)
        points["return_number"] = points["number_of_returns"] = np.ones(len(X_map), np.uint8)
        self._writer.write_points(points)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._writer.close()
            if kind is None:
                os.replace(self._temporary, self.path)
        finally:
            self._temporary.unlink(missing_ok=True)
