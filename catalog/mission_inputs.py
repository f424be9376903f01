"""The text files of a mission, read and checked against each other; every problem is collected."""

from typing import NamedTuple, TypeVar

from pydantic import BaseModel

from ..schemas.calibration import Calibration
from ..schemas.mission import CsvTimestamps, Mission
from ..schemas.navigation import Navigation, Tide, read_image_times, read_navigation, read_tide
from ..schemas.problems import Problem
from ..schemas.yaml_document import Document
from ..schemas.yaml_input import Read, read_model
from .mission_files import MissionFiles

M = TypeVar("M", bound=BaseModel)

MISSION = "mission.yaml"


class MissionInputs(NamedTuple):
    """What the text files say. Where there are problems, what could be made of the rest.

    Attributes
    ----------
    mission, document : mission.yaml and its lines; None if unusable.
    calibration : None if unusable.
    has_laser : the calibration speaks of a laser, right or wrong.
    navigation, tide, times : None if not asked for or missing.
    """

    mission: Mission | None
    document: Document | None
    calibration: Calibration | None = None
    has_laser: bool = False
    navigation: Navigation | None = None
    tide: Tide | None = None
    times: dict[str, int] | None = None


def read_inputs(files: MissionFiles, problems: list[Problem]) -> MissionInputs:
    """Read mission.yaml and every text file that it names; add what is wrong to the problems."""
    read = _read_yaml(files, MISSION, None, Mission, problems)
    mission, document = read.model, read.document
    if mission is None or document is None:
        _read_default_files(files, problems)
        return MissionInputs(None, document)

    def asked(*path: str) -> Problem:
        remedy = f"Add the file, or correct its name in {MISSION}."
        return Problem(MISSION, document.line(path), ".".join(path), "", "", remedy)

    calibration = _read_yaml(files, mission.calibration, asked("calibration"), Calibration, problems)
    given = calibration.document.value if calibration.document is not None else None
    inputs = MissionInputs(
        mission, document, calibration.model, has_laser=isinstance(given, dict) and given.get("laser") is not None
    )
    if mission.navigation is not None:
        name = mission.navigation.path
        inputs = inputs._replace(
            navigation=_read_csv(files, name, asked("navigation", "path"), read_navigation, problems)
        )
    if mission.tide is not None:
        inputs = inputs._replace(tide=_read_csv(files, mission.tide, asked("tide"), read_tide, problems))
    if isinstance(mission.timestamps, CsvTimestamps):
        name = mission.timestamps.path
        inputs = inputs._replace(times=_read_csv(files, name, asked("timestamps", "path"), read_image_times, problems))
    problems += _consistency_problems(inputs, mission, document)
    return inputs


def _read_yaml(
    files: MissionFiles, name: str, asked: Problem | None, model: type[M], problems: list[Problem]
) -> Read[M]:
    content = files.read(name, asked, problems)
    if content is None:
        return Read(None, None, [])
    read = read_model(content, name, model)
    problems += read.problems
    return read


def _read_csv(files: MissionFiles, name: str, asked: Problem, reader, problems: list[Problem]):
    content = files.read(name, asked, problems)
    if content is None:
        return None
    value, more = reader(content, name)
    problems += more
    return value


def _read_default_files(files: MissionFiles, problems: list[Problem]) -> None:
    """With no usable mission.yaml, check the files that have their usual names, to say all at once."""
    for name, reader in (("calibration.yaml", _calibration_problems), ("navigation.csv", _navigation_problems)):
        content = files.read(name, None, problems) if files.has(name) else None
        if content is not None:
            problems += reader(content, name)


def _calibration_problems(content: bytes, name: str) -> list[Problem]:
    return read_model(content, name, Calibration).problems


def _navigation_problems(content: bytes, name: str) -> list[Problem]:
    return read_navigation(content, name)[1]


def _consistency_problems(inputs: MissionInputs, mission: Mission, document: Document) -> list[Problem]:
    """What the roles of the images need of calibration and navigation."""
    problems: list[Problem] = []
    if inputs.calibration is not None and not inputs.has_laser:
        for i, image_set in enumerate(mission.images):
            if image_set.role != "texture":
                line, key = document.line(("images", i, "role")), f"images.{i}.role"
                remedy = "Add laser to the calibration, or write role: texture."
                expected = f"a laser in {mission.calibration}"
                problems.append(Problem(MISSION, line, key, f"role {image_set.role}, but no laser", expected, remedy))
    if mission.navigation is None:
        problems += _nothing_to_go_by({image_set.role for image_set in mission.images}, inputs)
    return problems


def _nothing_to_go_by(roles: set[str], inputs: MissionInputs) -> list[Problem]:
    """What is missing where there is no navigation: then images place each other, and their laser gives the scale."""
    if roles == {"laser"}:
        remedy = "Add navigation, or images with texture."
        found = "laser images only, and no navigation"
        return [Problem(MISSION, 1, "navigation", found, "something that places the images", remedy)]
    if "combined" not in roles or (inputs.calibration is not None and not inputs.has_laser):
        remedy = "Add navigation, or images in which laser and texture are together."
        found = "no navigation, and no laser in the images with texture"
        return [Problem(MISSION, 1, "navigation", found, "something that tells the scale", remedy)]
    return []


def input_warnings(inputs: MissionInputs, images: list[str], vertical: str | None) -> list[str]:
    """What is allowed but worth a second look. vertical : the vertical CRS, if there is one."""
    mission, warnings = inputs.mission, []
    if mission is None:
        return []
    if mission.tide is not None and vertical is None:
        warnings.append("a tide is given but no vertical_datum: the products cannot say to what heights refer")
    if inputs.calibration is not None and inputs.calibration.unknown_parameters:
        names = ", ".join(inputs.calibration.unknown_parameters[:3])
        warnings.append(f"covariance in {mission.calibration} of what it does not have, passed over: {names}")
    if vertical is not None and mission.tide is None:
        warnings.append(
            "a vertical datum is given but no tide: depths below the sea surface are taken as heights of that datum"
        )
    if inputs.times is not None:
        names = {name for image in images for name in (image, image.rpartition("/")[2])}
        unused = [name for name in inputs.times if name not in names]
        if unused:
            warnings.append(f"{len(unused)} rows of the image times name no image, such as {unused[0]}")
    return warnings
