"""Opens an archive: archive.yaml, the missions that it names, and where their products are."""

import glob
import os
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from ..schemas.archive import Archive
from ..schemas.expressions import MISSION_NAMES, Row, compile_expression
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.yaml_input import load_model, load_parameters
from .filesystems import asking, connect
from .mission_inputs import MISSION

ARCHIVE: Final = "archive.yaml"


class OpenedArchive(NamedTuple):
    """An archive that can be processed.

    Attributes
    ----------
    url : its folder. config : its archive.yaml. products : the folder or URL of the products.
    missions : folders or URLs of the missions, sorted. parameters : text of the parameters' file; None without.
    selects : says of a row of MISSION_NAMES whether the mission is processed.
    overrides : the same for each of the archive's overrides, with its parameters.
    """

    url: str
    config: Archive
    products: str
    missions: tuple[str, ...]
    parameters: str | None
    selects: Callable[[Row], bool]
    overrides: tuple[tuple[Callable[[Row], bool], dict[str, Any]], ...]


def is_archive(url: str) -> bool:
    """Whether a folder or URL holds an archive.yaml."""
    try:
        filesystem, path = connect(url)
        return filesystem.isfile(f"{path.rstrip('/')}/{ARCHIVE}")
    except (OSError, ValueError, ImportError):  # said better where it is opened
        return False


def open_archive(url: str) -> OpenedArchive:
    """Read and check archive.yaml and its file of parameters, and list the missions.

    Raises
    ------
    InvalidInput
        If there is none, something in it is wrong, or no folder with a mission.yaml matches.
    """
    url = url.rstrip("/") if "://" in url else os.path.abspath(url)
    config = load_model(_read(f"{url}/{ARCHIVE}", ARCHIVE), ARCHIVE, Archive)
    text = None
    if config.parameters is not None:
        text = _read(_within(url, config.parameters), "parameters").decode("utf-8", "replace")
        load_parameters(text, config.parameters)
    missions = sorted({mission for pattern in config.missions for mission in _matching(_within(url, pattern, url))})
    if not missions:
        expected = f"folders with a {MISSION} that match {', '.join(config.missions)}"
        raise InvalidInput([Problem(ARCHIVE, None, "missions", "none", expected, f"Patterns are relative to {url}.")])
    overrides = tuple((_compiled(one.where, "overrides"), dict(one.set)) for one in config.overrides)
    selects = (lambda row: True) if config.select is None else _compiled(config.select, "select")
    opened = OpenedArchive(url, config, _within(url, config.products), tuple(missions), text, selects, overrides)
    for _, given in overrides:
        parameters_of(opened, {}, given)
    return opened


def _compiled(text: str, key: str) -> Callable[[Row], bool]:
    return compile_expression(text, MISSION_NAMES, f"{ARCHIVE} {key}")


def parameters_of(archive: OpenedArchive, row: Row, settings: dict[str, Any]) -> Parameters:
    """A mission's parameters: the archive's, then its overrides, then the mission's own settings.

    Parameters
    ----------
    row : of MISSION_NAMES. settings : by dotted name.

    Raises
    ------
    InvalidInput
        If one of them is unknown or out of bounds.
    """
    given = [values for selects, values in archive.overrides if selects(row)]
    return load_parameters(archive.parameters, str(archive.config.parameters), as_arguments([*given, settings]))


def as_arguments(settings: Sequence[dict[str, Any]]) -> list[str]:
    """Settings as `--set` takes them, later ones in the place of earlier ones."""
    merged = {name: value for values in settings for name, value in values.items()}
    return [f"{name}={str(value).lower() if isinstance(value, bool) else value}" for name, value in merged.items()]


def _within(url: str, path: str, escaped: str = "") -> str:
    """A path of archive.yaml as a path or URL; with `escaped`, fit for globs where the archive's name is not."""
    if "://" in path or os.path.isabs(path):
        return path
    folder = glob.escape(escaped) if escaped and "://" not in escaped else url
    return f"{folder}/{path.rstrip('/')}"


def _matching(pattern: str) -> list[str]:
    """Folders or URLs with a mission.yaml that match a glob."""
    filesystem, path = connect(pattern)
    with asking(filesystem, pattern):
        found = [str(one).rpartition("/")[0] for one in filesystem.glob(f"{path}/{MISSION}")]
    return [filesystem.unstrip_protocol(one) for one in found] if "://" in pattern else found


def _read(url: str, asked: str) -> bytes:
    filesystem, path = connect(url)
    try:
        content = filesystem.cat_file(path)
    except OSError as error:
        remedy = f"An archive is a folder with {ARCHIVE}; docs/archive.md shows one."
        found = "nothing" if isinstance(error, FileNotFoundError) else str(error)
        raise InvalidInput([Problem(url, None, "", found, f"the file of {asked}", remedy)]) from error
    assert isinstance(content, bytes)
    return content
