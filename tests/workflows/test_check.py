import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from seamosaic.catalog.missions import open_mission
from seamosaic.schemas.parameters import GridParameters, Parameters
from seamosaic.schemas.products import PRODUCTS
from seamosaic.workflows.check import CheckResult, check, coverage, print_check

DEFAULT = Parameters()


def printed(result: CheckResult) -> str:
    text = io.StringIO()
    print_check(result, Console(file=text, width=200, color_system=None))
    return text.getvalue()


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_valid_mission(tiny_mission: Path) -> None:
    result = check(str(tiny_mission), DEFAULT)
    assert result.valid
    assert result.opened is not None
    plan = dict(result.plan)
    assert plan["images"] == "10 combined"
    assert plan["time"] == "2026-06-03 02:14:10 to 2026-06-03 02:14:19 UTC (0 min 9 s)"
    assert plan["navigation"] == "navigation.csv, horizontal 1-sigma 0.4 m"
    assert plan["map"] == "WGS 84 / UTM zone 32N; heights: the sea surface at survey time"
    # 3.1 m at 80 px of focal length: 38.75 mm a pixel, four of them a cell.
    assert plan["height"] == "camera 3.10 m above the seabed, 39 mm a pixel"
    assert plan["bathymetry cell"].startswith("0.155 m, about ")
    assert plan["mosaic cell"].startswith("0.0388 m, about ")
    text = printed(result)
    assert all(product.name in text for product in PRODUCTS)
    assert "10 combined" in text


def test_area_and_height(tiny_mission: Path) -> None:
    seen = coverage(open_mission(str(tiny_mission), hashed=False))
    assert seen is not None
    # One image sees 2.48 m x 1.86 m; ten of them, 0.22 m apart heading north, see 2 m more.
    single, track = 2.48 * 1.86, 18e-6 * 111_100
    assert single + 0.8 * 2.48 * track < seen.area_m2 < single + 1.4 * 2.48 * track
    assert seen.altitude_m == pytest.approx(3.1, abs=0.001)
    assert seen.ground_sample_m == pytest.approx(3.1 / 80, rel=1e-3)


def test_the_lever_arm_counts(tiny_mission: Path) -> None:
    path = tiny_mission / "calibration.yaml"
    path.write_text(path.read_text() + "mount: {translation: [0, 0, 1.0]}\n")
    seen = coverage(open_mission(str(tiny_mission), hashed=False))
    assert seen is not None
    assert seen.altitude_m == pytest.approx(2.1, abs=0.001)


def test_chosen_cells_are_kept(tiny_mission: Path) -> None:
    plan = dict(check(str(tiny_mission), Parameters(grid=GridParameters(cell_m=0.5))).plan)
    assert plan["bathymetry cell"].startswith("0.5 m, about ")


def test_without_navigation_or_altitude(tiny_mission: Path) -> None:
    edit(tiny_mission / "navigation.csv", ",3.1,", ",,")
    result = check(str(tiny_mission), DEFAULT)
    assert dict(result.plan)["bathymetry cell"] == "set by the range that laser or matches tell"
    assert "warning: 10 of 10 images have no altitude" in printed(result)
    path = tiny_mission / "mission.yaml"
    path.write_text(path.read_text().split("navigation:")[0])
    plan = dict(check(str(tiny_mission), Parameters(grid=GridParameters(cell_m=0.5))).plan)
    assert plan["map"] == "local frame, origin at the first image placed"
    assert (plan["bathymetry cell"], plan["mosaic cell"]) == ("0.5 m", "set by the range that laser or matches tell")


def test_some_altitudes_are_enough(tiny_mission: Path) -> None:
    path = tiny_mission / "navigation.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows[:12], *(row.replace(",3.1,", ",,") for row in rows[12:])]))
    seen = coverage(open_mission(str(tiny_mission), hashed=False))
    assert seen is not None
    assert np.isfinite(seen.area_m2)


def test_a_ring_that_is_too_wide_is_told_before_anything_is_computed(tiny_mission: Path) -> None:
    wide = Parameters.model_validate({"terrain": {"broad": {"inner": 0, "outer": 900, "unit": "metres"}}})
    result = check(str(tiny_mission), wide)
    assert [problem.key for problem in result.problems] == ["terrain.broad.outer"]
    assert "smaller ring" in printed(result)


def test_rejections_and_datum_are_told(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", "calibration:", "vertical_datum: EPSG:5714\ncalibration:")
    first = sorted((tiny_mission / "images").iterdir())[0]
    first.write_bytes(first.read_bytes()[:300])
    result = check(str(tiny_mission), DEFAULT)
    plan = dict(result.plan)
    assert plan["images"] == "9 combined (1 rejected)"
    assert plan["map"].endswith("; heights: MSL height")
    assert "truncated" in printed(result)


def test_a_wrong_mission_is_told_in_full(tiny_mission: Path) -> None:
    edit(tiny_mission / "mission.yaml", "title:", "'[bold]titel':")
    edit(tiny_mission / "calibration.yaml", "fx: 80.0", "fx: -80.0")
    (tiny_mission / "navigation.csv").unlink()
    result = check(str(tiny_mission), DEFAULT)
    assert not result.valid
    assert result.opened is None
    text = printed(result)
    # What looks like markup of the terminal is shown as it is.
    for words in (": 3 problems", "mission.yaml", "calibration.yaml:6  camera.fx", "found     -80.0", "a number > 0"):
        assert words in text
    assert "remedy" in text
    assert "Traceback" not in text


def test_a_place_that_is_not_there(tmp_path: Path) -> None:
    result = check(str(tmp_path / "nowhere"), DEFAULT)
    assert ": 1 problem\n" in printed(result)


def test_heights_at_which_the_laser_is_not_sought(tiny_mission: Path) -> None:
    assert not any("laser" in warning for warning in check(str(tiny_mission), DEFAULT).warnings)
    for limits, name in (({"range_max_m": 3.0}, "range_max_m"), ({"range_min_m": 3.0}, "range_min_m")):
        parameters = Parameters.model_validate({"laser": limits})
        (warning,) = (text for text in check(str(tiny_mission), parameters).warnings if "laser" in text)
        assert f"set laser.{name}" in warning
