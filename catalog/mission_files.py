"""The folder of a mission, local or in an object store: its files by relative path, and its images by pattern."""

import os
from collections.abc import Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, cast

from fsspec import AbstractFileSystem

from ..schemas.mission import Mission
from ..schemas.problems import InvalidInput, Problem
from ..schemas.yaml_document import Document
from .digests import file_key, sha256
from .filesystems import ObjectStoreError, absolute, asking, connect, entries, is_glob, is_remote


class ImageFile(NamedTuple):
    """An image of the mission.

    Attributes
    ----------
    image : path relative to the mission folder.
    role : combined, texture or laser.
    path : path in the file system.
    info : its entry there.
    """

    image: str
    role: str
    path: str
    info: dict[str, Any]


class MissionFiles:
    """Reads the files of a mission; remembers the digest of each text file read.

    Attributes
    ----------
    url : as the user gave it.
    fs, root : the file system and the folder in it.
    digests : SHA-256 of the text files read, by relative path.
    """

    def __init__(self, url: str):
        self.url = url
        self.fs, root = _connect(url)
        self.root = root.rstrip("/")
        self.digests: dict[str, str] = {}

    def read(self, name: str, asked: Problem | None, problems: list[Problem]) -> bytes | None:
        """The bytes of a text file, or None and a problem.

        Parameters
        ----------
        asked : a problem whose file, line and key say who asks for the file; its remedy is added.
        """
        try:
            with asking(self.fs, f"{self.url}/{name}"):
                content = cast(bytes, self.fs.cat_file(f"{self.root}/{name}"))
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            problem = asked or Problem(name, None, "", "", "", "Give the folder that holds it.")
            problems.append(problem._replace(found=f"no file {name} in {self.url}", expected="the file"))
            return None
        except ObjectStoreError:
            raise
        except OSError as error:
            remedy = "Check its permissions and the connection."
            problems.append(Problem(name, None, "", f"an unreadable file ({error})", "the file", remedy))
            return None
        self.digests[name] = sha256(content)
        return content

    def has(self, name: str) -> bool:
        try:
            with asking(self.fs, f"{self.url}/{name}"):
                return self.fs.info(f"{self.root}/{name}")["type"] == "file"
        except (FileNotFoundError, NotADirectoryError):
            return False

    def matching(self, pattern: str) -> dict[str, tuple[str, dict[str, Any]]]:
        """Files that match a glob (`*`, `?`, `[…]`, `**` for folders): relative path to path and entry, sorted.

        The folder's own name may hold such characters, which fsspec's glob would expand; so we match ourselves.
        """
        parts = pattern.split("/")
        fixed = next((i for i, part in enumerate(parts) if is_glob(part)), len(parts) - 1)
        found = self._files("/".join(parts[:fixed]), None if "**" in parts else len(parts) - fixed)
        return {name: entry for name, entry in sorted(found.items()) if _matches(name.split("/"), parts)}

    def keys(self) -> dict[str, str | None]:
        """Path, size and time of change of every file, as of now, by relative path.

        None where that is not told, and for a folder that may not be looked into.
        """
        closed: list[str] = []
        keys = {name: file_key(path, info) for name, (path, info) in self._files("", None, closed).items()}
        return keys | dict.fromkeys(closed)

    def folder_of(self, pattern: str) -> list[str]:
        """Names of the files in the folder in which a pattern looks, for a message."""
        folder = pattern.rpartition("/")[0]
        if is_glob(folder):
            folder = ""
        return sorted(self._files(folder, 1))

    def _files(
        self, folder: str, depth: int | None, closed: list[str] | None = None, through: tuple[str, ...] = ()
    ) -> dict[str, tuple[str, dict[str, Any]]]:
        """Files below a folder; without a depth also behind links to folders, but for those they were come through.

        closed : is given the folders that may not be looked into; without it, such a folder is an error.
        """
        base = f"{self.root}/{folder}".rstrip("/")
        through, start = (*through, os.path.realpath(base)), len(self.root) + 1
        files: dict[str, tuple[str, dict[str, Any]]] = {}
        waiting = [(base, 1)]
        while waiting:
            place, level = waiting.pop()
            for path, entry in self._entries(place, place == base, closed).items():
                info = self._behind(path, entry) if entry.get("islink") else entry
                if info["type"] != "directory":
                    files[path[start:]] = (path, info)
                elif not entry.get("islink"):
                    waiting += [(path, level + 1)] if depth is None or level < depth else []
                elif depth is None and os.path.realpath(path) not in through:
                    files |= self._files(path[start:], None, closed, through)
        return files

    def _entries(self, folder: str, base: bool, closed: list[str] | None) -> dict[str, dict[str, Any]]:
        """What is in a folder; nothing if it does not exist and is the base, where files are looked for."""
        try:
            return entries(self.fs, folder, self.url)
        except (FileNotFoundError, NotADirectoryError):
            if not base:
                raise
        except PermissionError:
            if closed is None:
                raise
            closed.append(folder[len(self.root) + 1 :])
        return {}

    def _behind(self, path: str, link: dict[str, Any]) -> dict[str, Any]:
        """The entry of what a link of a local disk leads to, which changes while the link does not."""
        behind = dict(self.fs.info(os.path.realpath(path))) if self.fs.exists(path) else link
        return {**behind, "name": path}


def _connect(url: str) -> tuple[AbstractFileSystem, str]:
    found = "nothing"
    try:
        fs, root = connect(absolute(url))
        with suppress(FileNotFoundError, NotADirectoryError), asking(fs, url):
            if fs.isdir(root) or fs.info(root)["type"] == "directory":  # isdir takes any trouble for a no
                return fs, root
            found = "a file"
    except (ImportError, ValueError) as error:
        remedy = "Give a folder, or a URL that fsspec reads; its driver has to be installed."
        raise InvalidInput([Problem(url, None, "", f"no access ({error})", "a mission folder", remedy)]) from None
    except ObjectStoreError:
        raise
    except OSError as error:
        raise InvalidInput([no_access(url, error, "a mission folder")]) from None
    raise InvalidInput([Problem(url, None, "", found, "a mission folder", "Give the folder that holds mission.yaml.")])


def no_access(url: str, error: OSError, expected: str) -> Problem:
    """Why a folder cannot be used, or a place in an object store that answers, and what to look at."""
    if isinstance(error, FileNotFoundError) and is_remote(url):
        remedy = "Make the bucket, or correct its name."
    elif is_remote(url):
        remedy = "Check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, and what they may do there (docs/clusters.md)."
    else:
        remedy = "Check its permissions and the connection."
    return Problem(url, None, "", f"no access ({error})", expected, remedy)


def _matches(parts: Sequence[str], patterns: Sequence[str]) -> bool:
    """Whether the parts of a path match those of a glob; as in a shell, hidden files only if asked for."""
    if not patterns:
        return not parts
    if patterns[0] == "**":
        return any(_matches(parts[i:], patterns[1:]) for i in range(len(parts) + 1))
    if not parts or (parts[0].startswith(".") and not patterns[0].startswith(".")):
        return False
    return fnmatchcase(parts[0], patterns[0]) and _matches(parts[1:], patterns[1:])


def find_images(files: MissionFiles, mission: Mission, document: Document) -> tuple[list[ImageFile], list[Problem]]:
    """The images of all sets, sorted by path; a set without images and an image in two sets are problems."""
    problems: list[Problem] = []
    images: dict[str, ImageFile] = {}
    owner: dict[str, str] = {}
    for i, image_set in enumerate(mission.images):
        line = document.line(("images", i, "path"))
        matching = files.matching(image_set.path)
        if not matching:
            remedy = _no_match_remedy(files, image_set.path)
            expected = f"images that match {image_set.path!r}"
            problems.append(Problem(document.file, line, f"images.{i}.path", "no such file", expected, remedy))
        twice = sorted(images.keys() & matching.keys())
        if twice:
            found = f"{len(twice)} images that {owner[twice[0]]!r} matches too, such as {twice[0]}"
            remedy = "Make the patterns exclude each other."
            expected = "each image in one set"
            problems.append(Problem(document.file, line, f"images.{i}.path", found, expected, remedy))
        for name, (path, info) in matching.items():
            images.setdefault(name, ImageFile(name, image_set.role, path, info))
            owner.setdefault(name, image_set.path)
        nameless = [name for name in matching if not _is_text(name)]
        if nameless:
            found = f"{len(nameless)} images whose names are no text in UTF-8, such as {nameless[0]!a}"
            problems.append(
                Problem(
                    document.file, line, f"images.{i}.path", found, "names in UTF-8", "Rename them, e.g. with convmv."
                )
            )
    return [images[name] for name in sorted(images)], problems


def _is_text(name: str) -> bool:
    """Whether a file's name is text: one of another encoding comes with surrogates in it."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _no_match_remedy(files: MissionFiles, pattern: str) -> str:
    names = files.folder_of(pattern)
    if not names:
        return "There is no file in that folder: check its name and that the images were copied."
    alike = [name for name in names if _matches(name.lower().split("/"), pattern.lower().split("/"))]
    if alike:
        return f"Names are case-sensitive: there is {alike[0]}."
    return f"Correct the pattern; in that folder there is {', '.join(names[:3])}{', …' if len(names) > 3 else ''}."
