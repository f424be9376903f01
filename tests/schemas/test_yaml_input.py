import pickle

import pytest
from seamosaic.schemas.calibration import Calibration
from seamosaic.schemas.mission import Mission
from seamosaic.schemas.parameters import Parameters
from seamosaic.schemas.problems import InvalidInput, Problem
from seamosaic.schemas.yaml_input import load_model, load_parameters, read_model

MISSION = """\
format: 1
id: a
images: [{path: 'images/*.jpg', role: laser}]
timestamps: {from: exif}
"""

CALIBRATION = """\
format: 1
camera: {model: brown, width: 1216, height: 912, fx: 1432.3, fy: 1433, cx: 611.7, cy: 450.8}
"""

LASER = "laser:\n  origin: [1, 0, 0]\n  planes: "


def problems(content: str | bytes, model: type = Mission) -> dict[str, Problem]:
    with pytest.raises(InvalidInput) as caught:
        load_model(content, "f.yaml", model)
    found = {problem.key: problem for problem in caught.value.problems}
    assert len(found) == len(caught.value.problems), "one problem a key"
    assert all(problem.file == "f.yaml" and problem.remedy and problem.expected for problem in found.values())
    return found


def with_line(base: str, *lines: str) -> str:
    return base + "\n".join(lines) + "\n"


def test_a_good_file_is_a_model() -> None:
    mission = load_model(MISSION, "f.yaml", Mission)
    assert mission.images[0].role == "laser"
    assert mission.calibration == "calibration.yaml"
    calibration = load_model(CALIBRATION.encode(), "f.yaml", Calibration)
    assert calibration.camera.fy == 1433


def test_everything_wrong_is_said_at_once_with_its_line() -> None:
    text = """\
format: 1
id: Upper
titel: x
images:
  - {path: 'images\\*.jpg', role: colour}
timestamps: {from: filename}
navigation:
  path: ../n.csv
  sigma: {horizontal: -1, deph: 2}
navigation: 3
crs: 32631
"""
    found = problems(text)
    lines = {key: problem.line for key, problem in found.items()}
    assert lines == {
        "id": 2,
        "titel": 3,
        "images.0.path": 5,
        "images.0.role": 5,
        "timestamps.pattern": 6,
        "navigation.path": 8,
        "navigation.sigma.horizontal": 9,
        "navigation.sigma.deph": 9,
        "navigation": 10,
        "crs": 11,
    }
    assert found["titel"].remedy == "Did you mean title?"
    assert found["navigation.sigma.deph"].remedy == "Did you mean depth?"
    assert found["images.0.role"].expected == "combined, texture or laser"
    assert found["images.0.path"].remedy == "Write 'images/*.jpg'."
    assert (found["navigation.sigma.horizontal"].found, found["crs"].remedy) == ("-1", "Put it in quotes.")
    assert "a number > 0 (metres)" in found["navigation.sigma.horizontal"].expected
    assert found["timestamps.pattern"].found == "nothing"
    # Said as one line, a problem holds all of it.
    assert str(found["titel"]).startswith("f.yaml:3: titel: found an unknown key; expected only format, id, title")


def test_negative_focal_length() -> None:
    (problem,) = problems(CALIBRATION.replace("1432.3", "-1432.3"), Calibration).values()
    assert (problem.line, problem.key, problem.found) == (2, "camera.fx", "-1432.3")
    assert problem.expected == "a number > 0 (pixels)"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (".nan", "a number > 0 (pixels)"),
        (".inf", "a number > 0 (pixels)"),
        ("'80'", "a number > 0 (pixels)"),
        ("true", "a number > 0 (pixels)"),
        ("", "a number > 0 (pixels)"),
        ("[1]", "a number > 0 (pixels)"),
    ],
)
def test_what_is_no_number_is_refused(value: str, expected: str) -> None:
    found = problems(CALIBRATION.replace("fx: 1432.3", f"fx: {value}"), Calibration)
    assert found["camera.fx"].expected == expected


def test_whole_numbers_are_whole() -> None:
    found = problems(CALIBRATION.replace("1216", "1216.5"), Calibration)
    assert found["camera.width"].expected == "a whole number > 0 and <= 100000 (pixels)"


@pytest.mark.parametrize(
    ("timestamps", "key", "found", "expected"),
    [
        ("{from: exif, pattern: x}", "timestamps.pattern", "an unknown key", "only from here"),
        ("{from: ccsv}", "timestamps.from", "'ccsv'", "filename or exif or csv"),
        ("{}", "timestamps.from", "nothing", "filename or exif or csv"),
        ("{from: csv}", "timestamps.path", "nothing", "a text"),
        ("{from: filename, pattern: '%Y%Q'}", "timestamps.pattern", "%Q", "%f"),
        ("{from: filename, pattern: '%H%M'}", "timestamps.pattern", "'%H%M'", "year"),
        ("{from: filename, pattern: '%Y%m%d%H%M%Y'}", "timestamps.pattern", "%Y", "once"),
        ("exif", "timestamps", "'exif'", "a mapping with from"),
    ],
)
def test_timestamps_speak_of_the_source_that_is_meant(timestamps: str, key: str, found: str, expected: str) -> None:
    (problem,) = problems(MISSION.replace("{from: exif}", timestamps)).values()
    assert problem.key == key
    assert found in problem.found
    assert expected in problem.expected


PLANE = "{name: a, normal: [0.6, 0.8, 0], offset: 1}"


@pytest.mark.parametrize(
    ("planes", "keys"),
    [
        ("{baseline: 1}", {"laser.planes.angle"}),
        ("{baseline: 1, angle: 95, rol: 1}", {"laser.planes.angle", "laser.planes.rol"}),
        (f"[{PLANE}]", {"laser.planes"}),
        (f"[{PLANE}, {{name: b, normal: [0.6, 0.9, 0], offset: x}}]", {"laser.planes.1.offset"}),
        (f"[{PLANE}, {{name: b, normal: [0.6, 0.9, 0], offset: 1}}]", {"laser.planes.1.normal"}),
        (f"[{PLANE}, {{name: b, normal: [1, 0, 0], offset: 1}}]", {"laser.planes.1.normal"}),
        (f"[{PLANE}, {PLANE}]", {"laser.planes"}),
        ("7", {"laser.planes"}),
    ],
)
def test_planes_speak_of_the_way_that_is_meant(planes: str, keys: set[str]) -> None:
    assert problems(with_line(CALIBRATION, LASER + planes), Calibration).keys() == keys


def test_planes_are_read_both_ways() -> None:
    other = "{name: b, normal: [-0.6, 0.8, 0], offset: 1}"
    two = load_model(with_line(CALIBRATION, f"{LASER}[{PLANE}, {other}]"), "f", Calibration)
    one = load_model(with_line(CALIBRATION, LASER + "{baseline: 1.2, angle: 25}"), "f", Calibration)
    assert two.laser is not None
    assert one.laser is not None
    assert [sheet.name for sheet in two.laser.sheets] == [sheet.name for sheet in one.laser.sheets] == ["a", "b"]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("cy: 450.8, distortion: [1, 2, 3]", "camera.distortion"),
        ("cy: 450.8, port: {distance: 0.1, thickness: 0.01}", "camera.port"),
        ("cy: 450.8, distortion: [1, 2, x, 4]", "camera.distortion.2"),
    ],
)
def test_values_that_do_not_fit_together(change: str, key: str) -> None:
    assert problems(CALIBRATION.replace("cy: 450.8", change), Calibration).keys() == {key}


def test_a_flat_port_needs_its_port_and_fisheye_four_coefficients() -> None:
    assert problems(CALIBRATION.replace("brown", "flat-port"), Calibration).keys() == {"camera.port"}
    fisheye = CALIBRATION.replace("brown", "fisheye").replace("cy:", "distortion: [0, 0, 0, 0, 0], cy:")
    assert "k4" in problems(fisheye, Calibration)["camera.distortion"].remedy


def test_covariance_has_to_be_square() -> None:
    text = with_line(CALIBRATION, "covariance: [{parameters: [fx, fy], matrix: [[1, 0]]}]")
    assert problems(text, Calibration)["covariance.0.matrix"].expected == "2 x 2 numbers"


def test_a_tide_needs_navigation() -> None:
    assert problems(with_line(MISSION, "tide: tide.csv")).keys() == {"tide"}


@pytest.mark.parametrize("path", ["/abs/n.csv", "../n.csv", "s3://b/n.csv", "C:/n.csv", "a\\b.csv", "''"])
def test_paths_stay_in_the_folder(path: str) -> None:
    assert problems(with_line(MISSION, f"calibration: {path}")).keys() == {"calibration"}


@pytest.mark.parametrize("text", ["", "# nothing\n", "- a\n", "just a text\n"])
def test_a_file_that_is_no_mapping(text: str) -> None:
    (problem,) = problems(text).values()
    assert "a mapping with format, id" in problem.expected


def test_a_key_of_another_level_is_pointed_to() -> None:
    found = problems(with_line(CALIBRATION, "fx: 3"), Calibration)
    assert found["fx"].remedy == "Did you mean camera.fx?"


def test_long_values_are_shortened() -> None:
    problem = problems(MISSION.replace("id: a", "id: " + "A" * 500))["id"]
    assert len(problem.found) < 70


def test_what_can_be_read_is_handed_over_with_the_problems() -> None:
    read = read_model(with_line(MISSION, "titel: x", "crs: 3"), "f.yaml", Mission)
    assert [problem.key for problem in read.problems] == ["titel", "crs"]
    assert read.model is not None
    assert read.model.crs is None
    assert read_model(MISSION.replace("id: a", ""), "f.yaml", Mission).model is None
    assert read_model("a: [", "f.yaml", Mission).document is None


def test_problems_survive_a_process_boundary() -> None:
    error = InvalidInput([Problem("f", 1, "k", "a", "b", "c")])
    assert pickle.loads(pickle.dumps(error)).problems == error.problems


def test_parameters_from_file_and_command_line() -> None:
    assert load_parameters(None, "p.yaml") == Parameters()
    assert load_parameters("# defaults\n", "p.yaml") == Parameters()
    text = "grid: {cell_m: 0.1, tile_cells: 128}\nlaser:\n  range_max_m: 6\n"
    parameters = load_parameters(text, "p.yaml", ["grid.cell_m=0.05", "mosaic.cell_m=auto", "grid.cell_m=5e-2"])
    assert (parameters.grid.cell_m, parameters.grid.tile_cells) == (0.05, 128)
    assert (parameters.laser.range_max_m, parameters.mosaic.cell_m) == (6, "auto")


@pytest.mark.parametrize(
    ("override", "file", "key", "word"),
    [
        ("grid.cell_m=0", "--set grid.cell_m=0", "grid.cell_m", "a number > 0 or auto"),
        ("grid.cell=1", "--set grid.cell=1", "grid.cell", "only cell_m"),
        ("cell_m=1", "--set cell_m=1", "cell_m", "only laser"),
        ("grid=1", "--set grid=1", "grid", "a mapping with cell_m"),
        ("grid.cell_m.x=1", "--set grid.cell_m.x=1", "grid.cell_m", "a number"),
        ("grid.cell_m=", "--set grid.cell_m=", "grid.cell_m", "a number"),
        ("grid.cell_m=[", "--set grid.cell_m=[", "grid.cell_m", "valid YAML"),
        ("grid.tile_cells=2e2", "--set grid.tile_cells=2e2", "grid.tile_cells", "a whole number >= 64"),
        ("grid.cell_m", "--set", "", "key=value"),
        ("=3", "--set", "", "key=value"),
        ("laser.range_min_m=9", "--set laser.range_min_m=9", "laser.range_min_m", "less than range_max_m, 8"),
    ],
)
def test_a_wrong_override_names_itself(override: str, file: str, key: str, word: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        load_parameters(None, "p.yaml", [override])
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.key) == (file, None, key)
    assert word in problem.expected
    assert problem.remedy


def test_file_and_command_line_are_checked_together() -> None:
    with pytest.raises(InvalidInput) as caught:
        load_parameters("grid:\n  cell: 3\nlaser: 3\n", "p.yaml", ["cell_m=3", "nonsense"])
    places = {(problem.file, problem.line, problem.key) for problem in caught.value.problems}
    assert places == {
        ("p.yaml", 2, "grid.cell"),
        ("p.yaml", 3, "laser"),
        ("--set cell_m=3", None, "cell_m"),
        ("--set", None, ""),
    }
    remedies = " ".join(problem.remedy for problem in caught.value.problems)
    assert "Did you mean grid.cell_m or mosaic.cell_m?" in remedies
    with pytest.raises(InvalidInput, match="a mapping"):
        load_parameters("- 1", "p.yaml")


@pytest.mark.parametrize(
    ("names", "matrix", "key", "found"),
    [
        ("camera.fx, camera.fx", "[[1, 0], [0, 1]]", "parameters", "twice"),
        ("camera.fx, camera.fy", "[[1, 0], [0, -1]]", "matrix", "-1 as variance of camera.fy"),
        ("camera.fx, camera.fy", "[[1, 0.5], [0.4, 1]]", "matrix", "0.4 in row 2"),
    ],
)
def test_covariance_has_to_be_one(names: str, matrix: str, key: str, found: str) -> None:
    text = with_line(CALIBRATION, f"covariance: [{{parameters: [{names}], matrix: {matrix}}}]")
    assert found in problems(text, Calibration)[f"covariance.0.{key}"].found


def test_sheets_are_two_and_lean() -> None:
    twice = with_line(CALIBRATION, f"{LASER}[{PLANE}, {{name: a, normal: [-0.6, 0.8, 0], offset: 1}}]")
    assert "named a" in problems(twice, Calibration)["laser.planes"].found
    plus = with_line(CALIBRATION, LASER + "{baseline: 1.2, angle: 25, roll: 90}")
    roll = problems(plus, Calibration)["laser.planes.roll"]
    assert "90 degrees" in roll.found
    upright = with_line(CALIBRATION, f"{LASER}[{PLANE}, {{name: b, normal: [1, 0, 0], offset: 1}}]")
    sheet = problems(upright, Calibration)["laser.planes.1.normal"]
    assert "a plus" in sheet.found
    assert sheet.expected == roll.expected


@pytest.mark.parametrize("wavelength_nm", [450, 638])
def test_the_laser_is_green(wavelength_nm: float) -> None:
    light = LASER.replace("laser:\n", f"laser:\n  wavelength_nm: {wavelength_nm}\n")
    (problem,) = problems(with_line(CALIBRATION, light + "{baseline: 1.2, angle: 25}"), Calibration).values()
    assert problem.key == "laser.wavelength_nm"
    assert problem.expected == "a number >= 500 and <= 560 (nm; the detector looks for green light)"
