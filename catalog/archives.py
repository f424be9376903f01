"""Opens an archive: archive.yaml, the missions that it names, and where their products are."""

import os
from collections.abc import Callable, Iterator, Sequence
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem

from ..schemas.archive import Archive
from ..schemas.expressions import MISSION_NAMES, Row, compile_expression
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.yaml_input import load_model, load_parameters
from .filesystems import ObjectStoreError, absolute, asking, connect, entries, is_glob
from .mission_files import no_access
from .mission_inputs import MISSION

ARCHIVE: Final = "archive.yaml"


class OpenedArchive(NamedTuple):
    """An archive that can be processed.

    Attributes
    ----------
    url : its folder. config : its archive.yaml. products : the folder or URL of the products.
    missions : folders, without links, or URLs of the missions, sorted. parameters : text of the parameters' file; None
        without.
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
    """Whether a folder or URL holds an archive.yaml.

    Raises
    ------
    ObjectStoreError
        If the store does not answer.
    InvalidInput
        If it may not be looked at.
    """
    try:
        filesystem, path = connect(url)
        with asking(filesystem, url):
            return filesystem.info(f"{path.rstrip('/')}/{ARCHIVE}")["type"] == "file"
    except ObjectStoreError:
        raise
    except PermissionError as error:
        raise InvalidInput([no_access(url, error, "a mission or an archive that can be read")]) from error
    except (OSError, ValueError, ImportError):  # said better where it is opened
        return False


def open_archive(url: str) -> OpenedArchive:
    """Read and check archive.yaml and its file of parameters, and list the missions.

    Raises
    ------
    InvalidInput
        If there is none, something in it is wrong, or no folder with a mission.yaml matches.
    """
    url = absolute(url)
    config = load_model(_read(f"{url}/{ARCHIVE}", ARCHIVE), ARCHIVE, Archive)
    text = None
    if config.parameters is not None:
        text = _read(_within(url, config.parameters), "parameters").decode("utf-8", "replace")
        load_parameters(text, config.parameters)
    missions = sorted({mission for pattern in config.missions for mission in _matching(url, pattern)})
    if not missions:
        expected = f"folders with a {MISSION} that match {', '.join(config.missions)}"
        raise InvalidInput([Problem(ARCHIVE, None, "missions", "none", expected, f"Patterns are relative to {url}.")])
    overrides = tuple((_compiled(one.where, "overrides"), dict(one.set)) for one in config.overrides)
    selects = (lambda row: True) if config.select is None else _compiled(config.select, "select")
    products = absolute(_within(url, config.products))
    opened = OpenedArchive(url, config, products, tuple(missions), text, selects, overrides)
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


def _within(url: str, path: str) -> str:
    """A path of archive.yaml as a path or URL."""
    return path if _is_whole(path) else f"{url}/{path.rstrip('/')}"


def _is_whole(path: str) -> bool:
    return "://" in path or os.path.isabs(path)


def _matching(url: str, pattern: str) -> list[str]:
    """Folders or URLs with a mission.yaml that match a glob, the archive's own name taken as it is."""
    filesystem, path = connect(pattern if _is_whole(pattern) else url)
    parts = [part for part in (path if _is_whole(pattern) else pattern).split("/") if part not in ("", ".")]
    start = ("/" if path.startswith("/") else "") if _is_whole(pattern) else f"{path.rstrip('/')}/"
    fixed = next((i for i, part in enumerate(parts) if is_glob(part)), len(parts))
    found = _folders(filesystem, start + "/".join(parts[:fixed]), parts[fixed:], pattern)
    missions = [folder for folder in dict.fromkeys(found) if _is_mission(filesystem, folder)]
    if isinstance(filesystem, LocalFileSystem):
        return [absolute(one) for one in missions]
    return [filesystem.unstrip_protocol(one) for one in missions]


def _folders(filesystem: AbstractFileSystem, folder: str, parts: Sequence[str], pattern: str) -> Iterator[str]:
    """Folders below one that match the parts of a glob, also behind links; `**` does not follow these."""
    if not parts:
        yield folder
        return
    if parts[0] == "**":
        yield from _folders(filesystem, folder, parts[1:], pattern)
    try:
        found = entries(filesystem, folder, pattern)
    except (FileNotFoundError, NotADirectoryError):
        return
    for path, info in found.items():
        if parts[0] == "**":
            if info["type"] == "directory":
                yield from _folders(filesystem, path, parts, pattern)
        elif (info["type"] == "directory" or info.get("islink")) and fnmatchcase(path.rpartition("/")[2], parts[0]):
            yield from _folders(filesystem, path, parts[1:], pattern)


def _is_mission(filesystem: AbstractFileSystem, folder: str) -> bool:
    """Whether there is a mission.yaml; one that may not be read is said to be so where it is opened."""
    try:
        with asking(filesystem, folder):
            return filesystem.info(f"{folder}/{MISSION}")["type"] == "file"
    except (FileNotFoundError, NotADirectoryError):
        return False
    except PermissionError:
        return True


def _read(url: str, asked: str) -> bytes:
    filesystem, path = connect(url)
    try:
        with asking(filesystem, url):
            content = filesystem.cat_file(path)
    except ObjectStoreError:
        raise
    except OSError as error:
        remedy = f"An archive is a folder with {ARCHIVE}; docs/archive.md shows one."
        found = "nothing" if isinstance(error, FileNotFoundError) else str(error)
        raise InvalidInput([Problem(url, None, "", found, f"the file of {asked}", remedy)]) from error
    assert isinstance(content, bytes)
    return content
