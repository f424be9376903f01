"""Between the local frame, in which all geometry is computed, and the map (FORMATS, "Frames of reference").

local : right-handed metres, x east, y north, z up, tangent to the ellipsoid at the mission's origin.
map   : the mission's projected CRS, x easting, y northing, z elevation.

Going through the geocentric frame takes in the meridian convergence, the projection's scale factor and the
Earth's curvature, with no approximation of ours.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from .rotations import nearest_rotation

Array = NDArray[np.float64]

_WGS84 = "EPSG:4326"  # navigation's datum, whatever the map's


class LocalAffine(NamedTuple):
    """The map around places: local = matrix @ map + offset, good to a micrometre over some tens of metres."""

    matrix: Array
    offset: Array


class MapFrame:
    """Carries points and rotations between local and map.

    Parameters
    ----------
    crs : WKT of the projected CRS, or None for a mission without navigation, whose map is the local frame.
    latitude, longitude : origin of the local frame, degrees; its height is 0 on the ellipsoid, by which
        elevations are taken as heights (a geoid offset cancels, only curvature matters here).
    """

    def __init__(self, crs: str | None, latitude: float = 0.0, longitude: float = 0.0):
        self.crs, self.latitude, self.longitude = crs, latitude, longitude

    def __reduce__(self):
        return MapFrame, (self.crs, self.latitude, self.longitude)

    @cached_property
    def _geographic_from_map(self) -> pyproj.Transformer:
        assert self.crs is not None
        return pyproj.Transformer.from_crs(pyproj.CRS(self.crs), _WGS84, always_xy=True)

    @cached_property
    def _local_from_geographic(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={self.latitude!r} +lon_0={self.longitude!r} +h_0=0"
        )

    def local_from_geographic(self, longitude: Array, latitude: Array, elevation: Array) -> Array:
        """Local points (N, 3) of geographic positions (N,) in degrees and elevations in metres."""
        return np.column_stack(self._local_from_geographic.transform(longitude, latitude, elevation))

    def R_local_enu(self, longitude: Array, latitude: Array) -> Array:
        """Rotations (..., 3, 3) from east, north, up at geographic positions (...), degrees, to local axes."""
        return _R_geocentric_enu(self.longitude, self.latitude).T @ _R_geocentric_enu(longitude, latitude)

    def geographic_from_local(self, X_local: Array) -> Array:
        """Longitude, latitude (degrees) and elevation (metres), (N, 3), of local points (N, 3)."""
        return np.column_stack(self._local_from_geographic.transform(*np.asarray(X_local).T, direction="INVERSE"))

    def map_from_local(self, X_local: Array) -> Array:
        """Map points (N, 3) of local points (N, 3)."""
        X_local = np.asarray(X_local, float)
        if self.crs is None or not len(X_local):
            return X_local.copy()
        longitude, latitude, elevation = self.geographic_from_local(X_local).T
        x, y = self._geographic_from_map.transform(longitude, latitude, direction="INVERSE")
        return np.column_stack([x, y, elevation])

    def map_around(self, X_local: Array, near: Array) -> Array:
        """Map points (N, 3) of local points (N, 3) within tens of metres of one (3,): quick, good to a micrometre."""
        if self.crs is None or not len(X_local):
            return np.array(X_local, float)
        local = self.affine_at(self.map_from_local(near[None])[0])
        return (X_local - local.offset) @ np.linalg.inv(local.matrix).T

    def local_from_map(self, X_map: Array) -> Array:
        """Local points (N, 3) of map points (N, 3)."""
        X_map = np.asarray(X_map, float)
        if self.crs is None or not len(X_map):
            return X_map.copy()
        longitude, latitude = self._geographic_from_map.transform(X_map[:, 0], X_map[:, 1])
        return self.local_from_geographic(longitude, latitude, X_map[:, 2])

    def affine_at(self, X_map: Array) -> LocalAffine:
        """The linearised transformations from map to local around map points (..., 3)."""
        step = 5.0
        points = X_map[..., None, :] + step * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        local = self.local_from_map(points.reshape(-1, 3)).reshape(points.shape)
        matrix = (local[..., 1:4, :] - local[..., 4:7, :]).swapaxes(-1, -2) / (2 * step)
        return LocalAffine(matrix, local[..., 0, :] - (matrix @ X_map[..., None])[..., 0])

    def R_map_local(self, X_map: Array) -> Array:
        """Rotations (..., 3, 3) from local to map axes at map points (..., 3): the meridian convergence, mostly."""
        return nearest_rotation(self.affine_at(X_map).matrix.swapaxes(-1, -2))


def _R_geocentric_enu(longitude: ArrayLike, latitude: ArrayLike) -> Array:
    """Rotations (..., 3, 3) from east, north, up at geographic positions (...), degrees, to geocentric axes."""
    across, up = np.radians(longitude), np.radians(latitude)
    (sin_l, cos_l), (sin_p, cos_p), zero = (np.sin(across), np.cos(across)), (np.sin(up), np.cos(up)), 0 * across
    east, north = (-sin_l, cos_l, zero), (-sin_p * cos_l, -sin_p * sin_l, cos_p)
    axes = [np.stack(axis, -1) for axis in (east, north, (cos_p * cos_l, cos_p * sin_l, sin_p))]
    return np.stack(axes, -1)
