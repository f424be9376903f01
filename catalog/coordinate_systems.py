"""The mission's projected and vertical coordinate reference systems."""

import math
from typing import NamedTuple

import pyproj
from pyproj.exceptions import CRSError

from ..schemas.problems import Problem

_SCALE_TOLERANCE = 0.01


class Place(NamedTuple):
    """Where a CRS was asked for, for the messages.

    Attributes
    ----------
    file : the file.
    line : its line.
    key : the key in it.
    """

    file: str
    line: int | None
    key: str

    def problem(self, found: str, expected: str, remedy: str) -> Problem:
        return Problem(self.file, self.line, self.key, found, expected, remedy)


class Systems(NamedTuple):
    """The coordinate reference systems of a mission.

    Attributes
    ----------
    crs : WKT of the projected CRS, or None.
    vertical : WKT of the vertical CRS, or None.
    problems : what is wrong with the ones asked for.
    warnings : what is odd about them.
    """

    crs: str | None
    vertical: str | None
    problems: list[Problem]
    warnings: list[str]


def utm_crs(latitude: float, longitude: float) -> str | None:
    """The WGS 84 UTM zone of a place, as EPSG code, with the exceptions for Norway and Svalbard.

    Parameters
    ----------
    latitude, longitude : degrees.

    Returns
    -------
    `EPSG:326xx` or `EPSG:327xx`; None beyond 84 degrees north and 80 south, where UTM ends.
    """
    if not -80 <= latitude <= 84:
        return None
    zone = int((longitude + 180) % 360 // 6) + 1
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        zone = 32
    elif latitude >= 72 and 0 <= longitude < 42:
        zone = 31 + 2 * int((longitude + 3) // 12)
    return f"EPSG:{32600 + zone if latitude >= 0 else 32700 + zone}"


def resolve(
    horizontal: str | None, vertical: str | None, position: tuple[float, float] | None, crs: Place, datum: Place
) -> Systems:
    """Find and check the systems that a mission asks for.

    Parameters
    ----------
    horizontal, vertical : as mission.yaml gives them, e.g. EPSG:32631 and EPSG:5714; a compound CRS as
        `horizontal` gives both.
    position : latitude and longitude of the middle of the mission, degrees; None without navigation, and then
        there is no map and no CRS.
    crs, datum : where they are asked for.
    """
    problems: list[Problem] = []
    across = _lookup(horizontal, crs, problems)
    upward = _lookup(vertical, datum, problems)
    if across is not None and across.is_compound:
        across, part = across.sub_crs_list[:2]
        if upward is not None:
            problems.append(datum.problem(repr(vertical), f"none, as {horizontal} holds one", "Remove one of the two."))
        upward = part
    if across is not None:
        problems += _projected_problems(across, crs)
    if upward is not None:
        problems += _vertical_problems(upward, datum)
    warnings: list[str] = []
    if position is None:
        given = [place.key for place, text in ((crs, horizontal), (datum, vertical)) if text is not None]
        warnings += [f"{key} is not used: without navigation the map is a local frame" for key in given]
        return Systems(None, None, problems, warnings)
    if across is None and horizontal is None:
        across = _utm(position, crs, problems)
    if across is not None and not problems:
        _check_position(across, position, crs, problems, warnings)
    return Systems(_wkt(across), _wkt(upward), problems, warnings)


def _wkt(crs: pyproj.CRS | None) -> str | None:
    return None if crs is None else crs.to_wkt()


def _lookup(text: str | None, place: Place, problems: list[Problem]) -> pyproj.CRS | None:
    if text is None:
        return None
    try:
        return pyproj.CRS.from_user_input(text)
    except CRSError:
        remedy = "Write an EPSG code such as EPSG:32631; epsg.io finds them by place."
        problems.append(place.problem(repr(text), "a CRS that PROJ knows", remedy))
        return None


def _projected_problems(crs: pyproj.CRS, place: Place) -> list[Problem]:
    if not crs.is_projected:
        kind = "a geographic CRS, in degrees" if crs.is_geographic else f"a {crs.type_name}"
        remedy = "Give a projected CRS, such as the UTM zone of the place, or leave the key out."
        return [place.problem(f"{crs.name}, {kind}", "a projected CRS in metres", remedy)]
    if any(axis.direction.lower() == "west" for axis in crs.axis_info[:2]):
        remedy = "Choose a CRS of the place that counts east and north, such as its UTM zone."
        return [place.problem(f"{crs.name}, which counts west and south", "x to the east, y to the north", remedy)]
    units = {axis.unit_name for axis in crs.axis_info[:2] if axis.unit_conversion_factor != 1.0}
    if units:
        remedy = "Choose the metric sister of this CRS; products are in metres."
        return [place.problem(f"{crs.name} in {', '.join(units)}", "a projected CRS in metres", remedy)]
    return []


def _vertical_problems(crs: pyproj.CRS, place: Place) -> list[Problem]:
    if not crs.is_vertical or crs.is_compound:
        remedy = "Give a vertical CRS such as EPSG:5714 (mean sea level height), or leave the key out."
        return [place.problem(f"{crs.name}, a {crs.type_name}", "a vertical CRS", remedy)]
    axis = crs.axis_info[0]
    if axis.direction.lower() != "up" or axis.unit_conversion_factor != 1.0:
        found = f"{crs.name}, {axis.direction} in {axis.unit_name}"
        remedy = "Products hold elevations: give the height of the same datum, e.g. EPSG:5714 for EPSG:5715."
        return [place.problem(found, "heights, up in metres", remedy)]
    return []


def _utm(position: tuple[float, float], place: Place, problems: list[Problem]) -> pyproj.CRS | None:
    code = utm_crs(*position)
    if code is None:
        remedy = "Give crs, e.g. EPSG:3413 (Arctic) or EPSG:3031 (Antarctic)."
        problems.append(place.problem(f"nothing, at latitude {position[0]:.2f}", "a crs where UTM has no zone", remedy))
        return None
    return pyproj.CRS(code)


def _check_position(
    crs: pyproj.CRS, position: tuple[float, float], place: Place, problems: list[Problem], warnings: list[str]
) -> None:
    latitude, longitude = position
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    where = f"{latitude:.4f}, {longitude:.4f}"
    area = crs.area_of_use
    if not (math.isfinite(x) and math.isfinite(y)):
        remedy = "Give the CRS of the place, or leave the key out for its UTM zone."
        problems.append(place.problem(crs.name, f"a CRS that covers the mission ({where})", remedy))
    elif area is not None and not _covers(area, latitude, longitude):
        warnings.append(f"the mission ({where}) lies outside the area of use of {crs.name} ({area.name})")
    else:
        warnings += _scale_warnings(crs, latitude, longitude)


def _scale_warnings(crs: pyproj.CRS, latitude: float, longitude: float) -> list[str]:
    """A map whose metres are not metres gives wrong areas and slopes."""
    factors = pyproj.Proj(crs).get_factors(longitude, latitude)
    scale = factors.areal_scale**0.5
    if abs(scale - 1) <= _SCALE_TOLERANCE:
        return []
    return [
        f"a metre on the seabed is {scale:.3f} m in {crs.name} here: areas, slopes and distances measured on the map "
        "are wrong by that; the UTM zone of the place would be right"
    ]


def _covers(area, latitude: float, longitude: float) -> bool:
    """Whether a pyproj AreaOfUse holds a place; it may straddle the 180th meridian. A degree of margin."""
    width = (area.east - area.west) % 360 or 360
    inside = (longitude - area.west + 1) % 360 <= width + 2
    return inside and area.south - 1 <= latitude <= area.north + 1
