"""Numbered versions of a mission's products: OUT/<mission id>/v1, v2, ...

A version is written in a hidden folder beside them and renamed when it is whole: a version that exists is complete
and is never written again. Two runs at once each get a number of their own.
"""

import json
import os
import re
import shutil
import socket
import time
from pathlib import Path
from typing import Final, NamedTuple, Self
from uuid import uuid4

PROVENANCE: Final = Path("metadata") / "provenance.json"
LEASE_S: Final = 24 * 3600.0
_VERSION: Final = re.compile(r"v([1-9][0-9]*)")
_UNFINISHED: Final = re.compile(r"\.new-(?P<host>[^ ]*)-(?P<pid>[0-9]+)-[0-9a-f]{8}")


class Version(NamedTuple):
    """A finished version."""

    number: int
    path: Path

    @property
    def digest(self) -> str | None:
        """What it was made from, by its provenance; None if that cannot be read."""
        try:
            found = json.loads((self.path / PROVENANCE).read_text(encoding="utf-8"))["digest"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return found if isinstance(found, str) else None


def list_versions(out_dir: str | os.PathLike[str], mission_id: str) -> list[Version]:
    """Finished versions, oldest first."""
    folder = Path(out_dir) / mission_id
    if not folder.is_dir():
        return []
    found = [(match, path) for path in folder.iterdir() if (match := _VERSION.fullmatch(path.name)) and path.is_dir()]
    return sorted(Version(int(match[1]), path) for match, path in found)


def newest_version(out_dir: str | os.PathLike[str], mission_id: str) -> Version | None:
    """The version with the highest number."""
    found = list_versions(out_dir, mission_id)
    return found[-1] if found else None


class VersionWriter:
    """A version in the making; use as a context manager and write into `folder`.

    Leaving the context gives it the next number, after which `path` says where it is; after an exception the
    folder is removed. If another run finished the same version meanwhile, this one is dropped for it.

    Attributes
    ----------
    folder : where to write, until the context is left.
    path : the finished version, None before.
    """

    def __init__(self, out_dir: str | os.PathLike[str], mission_id: str, digest: str):
        self._out, self._mission, self._digest = Path(out_dir), mission_id, digest
        name = f".new-{socket.gethostname()}-{os.getpid()}-{uuid4().hex[:8]}"
        self.folder = self._out / mission_id / name
        self.path: Path | None = None

    def __enter__(self) -> Self:
        (self.folder / PROVENANCE.parent).mkdir(parents=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.path = self._commit()
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _commit(self) -> Path:
        written = Version(0, self.folder).digest
        if written != self._digest:
            raise ValueError(f"{PROVENANCE} gives the digest {written}, but this version is {self._digest}")
        newest = newest_version(self._out, self._mission)
        if newest is not None and newest.digest == self._digest:
            return newest.path
        number = newest.number + 1 if newest else 1
        while True:
            path = self._out / self._mission / f"v{number}"
            try:
                self.folder.rename(path)
                return path
            except OSError:
                if not path.exists():
                    raise
            # another run took the number between the look and the rename
            if Version(number, path).digest == self._digest:
                return path
            number += 1


def new_version(out_dir: str | os.PathLike[str], mission_id: str, digest: str) -> Path | VersionWriter:
    """The newest version's folder if it was made from the same digest, else a writer for the next one.

    Leftovers of runs that died are removed on the way.
    """
    remove_unfinished(Path(out_dir) / mission_id)
    newest = newest_version(out_dir, mission_id)
    if newest is not None and newest.digest == digest:
        return newest.path
    return VersionWriter(out_dir, mission_id, digest)


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished versions whose run is dead: its process is gone from this host, or, on any host,
    nothing was written for the length of the lease."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _UNFINISHED.fullmatch(path.name)
        if match and (_is_dead(match["host"], int(match["pid"])) or _quiet_s(path) > LEASE_S):
            shutil.rmtree(path, ignore_errors=True)


def _is_dead(host: str, pid: int) -> bool:
    if os.name != "posix" or host != socket.gethostname():  # elsewhere signal 0 is not a question
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass
    return False


def _quiet_s(folder: Path) -> float:
    """Seconds since anything in the folder was written; 0 for one that vanishes while we look."""
    newest = 0.0
    try:
        for path in (folder, *folder.rglob("*")):
            newest = max(newest, path.stat().st_mtime)
    except FileNotFoundError:
        return 0.0
    return time.time() - newest
