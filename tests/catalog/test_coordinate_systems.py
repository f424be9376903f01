import pyproj
import pytest
from seamosaic.catalog.coordinate_systems import Place, Systems, resolve, utm_crs

CRS, DATUM = Place("mission.yaml", 7, "crs"), Place("mission.yaml", 8, "vertical_datum")
TOULON = (43.04, 6.01)


def resolved(horizontal: str | None = None, vertical: str | None = None, position=TOULON) -> Systems:
    return resolve(horizontal, vertical, position, CRS, DATUM)


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        (43.04, 6.01, "EPSG:32632"),
        (43.04, 5.99, "EPSG:32631"),
        (-33.0, 151.0, "EPSG:32756"),
        (60.4, 5.3, "EPSG:32632"),  # Norway's exception
        (60.4, 2.9, "EPSG:32631"),
        (78.0, 8.9, "EPSG:32631"),  # Svalbard's
        (78.0, 15.0, "EPSG:32633"),
        (78.0, 21.0, "EPSG:32635"),
        (78.0, 33.0, "EPSG:32637"),
        (78.0, 42.0, "EPSG:32638"),
        (0.0, 180.0, "EPSG:32601"),
        (0.0, 179.9, "EPSG:32660"),
        (-81.0, 0.0, None),
        (88.0, 0.0, None),
    ],
)
def test_utm_zones(latitude: float, longitude: float, code: str | None) -> None:
    assert utm_crs(latitude, longitude) == code


def test_the_default_is_the_utm_zone_and_no_datum() -> None:
    systems = resolved()
    assert pyproj.CRS(systems.crs).to_epsg() == 32632
    assert (systems.vertical, systems.problems, systems.warnings) == (None, [], [])


def test_given_systems() -> None:
    systems = resolved("EPSG:2154", "EPSG:5714")
    assert pyproj.CRS(systems.crs).to_epsg() == 2154
    assert pyproj.CRS(systems.vertical).to_epsg() == 5714
    assert systems.warnings == []


def test_a_compound_crs_gives_both() -> None:
    systems = resolved("EPSG:32632+5714")
    assert pyproj.CRS(systems.crs).to_epsg() == 32632
    assert pyproj.CRS(systems.vertical).to_epsg() == 5714
    assert [problem.key for problem in resolved("EPSG:32632+5714", "EPSG:5714").problems] == ["vertical_datum"]


@pytest.mark.parametrize(
    ("horizontal", "found"),
    [
        ("EPSG:4326", "in degrees"),
        ("EPSG:4978", "WGS 84"),
        ("EPSG:5714", "MSL height"),
        ("EPSG:2263", "foot"),
        ("EPSG:99999", "'EPSG:99999'"),
        ("Lambert", "'Lambert'"),
        ("EPSG:4326+5714", "in degrees"),
    ],
)
def test_a_wrong_crs(horizontal: str, found: str) -> None:
    (problem,) = resolved(horizontal).problems
    assert (problem.file, problem.line, problem.key) == ("mission.yaml", 7, "crs")
    assert found in problem.found
    assert problem.remedy
    # Wrong is wrong without navigation too.
    assert resolved(horizontal, position=None).problems == [problem]


@pytest.mark.parametrize(
    ("vertical", "found"), [("EPSG:4326", "WGS 84"), ("EPSG:5715", "down"), ("EPSG:6360", "foot"), ("sea", "'sea'")]
)
def test_a_wrong_datum(vertical: str, found: str) -> None:
    (problem,) = resolved(None, vertical).problems
    assert (problem.line, problem.key) == (8, "vertical_datum")
    assert found in problem.found


def test_a_crs_of_another_place() -> None:
    (warning,) = resolved("EPSG:32615").warnings
    assert "outside the area of use" in warning
    assert resolved("EPSG:3832", position=(0.0, 179.9)).warnings == []  # its area straddles the 180th meridian


@pytest.mark.parametrize(("code", "warned"), [("EPSG:3857", True), ("EPSG:32631", False), ("EPSG:2154", False)])
def test_a_crs_in_which_a_metre_is_none_is_warned_of(code, warned) -> None:
    warnings = resolved(code, position=(43.04, 3.01)).warnings
    assert any("a metre on the seabed is 1.36" in warning for warning in warnings) == warned


def test_a_crs_that_counts_west_is_refused() -> None:
    (problem,) = resolved("EPSG:2048", position=(-34.0, 19.0)).problems
    assert "x to the east" in problem.expected


def test_a_crs_that_does_not_reach_the_place() -> None:
    gnomonic = "+proj=gnom +lat_0=90 +lon_0=0 +datum=WGS84"  # a hemisphere is all it can show
    (problem,) = resolved(gnomonic, position=(-45.0, 6.0)).problems
    assert "covers the mission" in problem.expected


def test_near_a_pole_a_crs_has_to_be_given() -> None:
    assert "UTM has no zone" in resolved(position=(89.0, 0.0)).problems[0].expected
    assert resolved("EPSG:3413", position=(89.0, 0.0)).problems == []


def test_without_navigation_there_is_no_map() -> None:
    systems = resolved("EPSG:32632", "EPSG:5714", position=None)
    assert (systems.crs, systems.vertical, systems.problems) == (None, None, [])
    assert len(systems.warnings) == 2
