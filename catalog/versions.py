"""Numbered versions of a mission's products: OUT/<mission id>/v1, v2, ...

On a disk a version is written in a hidden folder beside them and renamed when it is whole. For an object store it is
written in a temporary folder of this machine and then uploaded, its provenance last (`publishing`). A version that
exists is complete and is never written again. Two runs at once each get a number of their own.
"""

import os
import re
import shutil
import tempfile
import time
from pathlib import Path
from typing import Final, NamedTuple, Self

from . import publishing
from .filesystems import Folder, place, settle
from .publishing import PROVENANCE, digest_of
from .runs import LEASE_S, is_dead, run_name

__all__ = [
    "LEASE_S",
    "PROVENANCE",
    "Version",
    "VersionWriter",
    "list_versions",
    "new_version",
    "newest_version",
    "next_number",
]

_VERSION: Final = re.compile(r"v([1-9][0-9]*)")
_UNFINISHED, _STAGED = ".new-", "seamosaic-new-"


class Version(NamedTuple):
    """A finished version; its path is a `Path`, or on an object store a `UPath`, which is used in the same way."""

    number: int
    path: Folder

    @property
    def digest(self) -> str | None:
        """What it was made from, by its provenance; None if that cannot be read."""
        return digest_of(self.path)


def list_versions(out_dir: str | os.PathLike[str], mission_id: str) -> list[Version]:
    """Finished versions of OUT, a folder or URL, oldest first."""
    folder = place(out_dir) / mission_id
    if not isinstance(folder, Path):
        return sorted(Version(number, folder / f"v{number}") for number in publishing.finished(folder))
    if not folder.is_dir():
        return []
    found = [(match, path) for path in folder.iterdir() if (match := _VERSION.fullmatch(path.name)) and path.is_dir()]
    return sorted(Version(int(match[1]), path) for match, path in found)


def newest_version(out_dir: str | os.PathLike[str], mission_id: str) -> Version | None:
    """The version with the highest number."""
    found = list_versions(out_dir, mission_id)
    return found[-1] if found else None


def next_number(out_dir: str | os.PathLike[str], mission_id: str) -> int:
    """The number that the next version gets, unless another run is faster."""
    newest = newest_version(out_dir, mission_id)
    return newest.number + 1 if newest else 1


class VersionWriter:
    """A version in the making; use as a context manager and write into `folder`.

    Leaving the context gives it the next number, after which `path` says where it is; after an exception the
    folder is removed. If another run finished the same version meanwhile, this one is dropped for it.

    Attributes
    ----------
    folder : where to write, on this machine, until the context is left.
    path : the finished version, None before.
    """

    def __init__(self, out_dir: str | os.PathLike[str], mission_id: str, digest: str):
        self._out, self._mission, self._digest = out_dir, mission_id, digest
        self._place = place(out_dir) / mission_id
        if isinstance(self._place, Path):
            self.folder = self._place / f"{_UNFINISHED}{run_name()}"
        else:
            self.folder = Path(tempfile.gettempdir()) / f"{_STAGED}{run_name()}"
        self.path: Folder | None = None

    def __enter__(self) -> Self:
        self.folder.mkdir(mode=0o777 if isinstance(self._place, Path) else 0o700, parents=True)
        (self.folder / PROVENANCE).parent.mkdir()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.path = self._commit()
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _commit(self) -> Folder:
        written = digest_of(self.folder)
        if written != self._digest:
            raise ValueError(f"{PROVENANCE} gives the digest {written}, but this version is {self._digest}")
        if not isinstance(self._place, Path):
            return publishing.publish(self.folder, self._place, self._digest)
        return self._rename(self._place)

    def _rename(self, folder: Path) -> Path:
        newest = newest_version(self._out, self._mission)
        if newest is not None and newest.digest == self._digest:
            return Path(str(newest.path))
        number = next_number(self._out, self._mission)
        for written in (*self.folder.rglob("*"), self.folder):  # else a power cut may leave a version of empty files
            settle(written)
        while True:
            path = folder / f"v{number}"
            try:
                self.folder.rename(path)
                settle(folder)
                return path
            except OSError:
                if not path.exists():
                    raise
            # another run took the number between the look and the rename
            if Version(number, path).digest == self._digest:
                return path
            number += 1


def new_version(out_dir: str | os.PathLike[str], mission_id: str, digest: str) -> Folder | VersionWriter:
    """The newest version's folder if it was made from the same digest, else a writer for the next one.

    Leftovers of runs that died are removed on the way.
    """
    remove_unfinished(place(out_dir) / mission_id)
    newest = newest_version(out_dir, mission_id)
    if newest is not None and newest.digest == digest:
        return newest.path
    return VersionWriter(out_dir, mission_id, digest)


def remove_unfinished(folder: Folder) -> None:
    """Remove the unfinished versions whose run is dead: its process is gone from this host, or, on any host,
    nothing was written for the length of the lease."""
    if isinstance(folder, Path):
        _remove_dead(folder, _UNFINISHED)
        return
    _remove_dead(Path(tempfile.gettempdir()), _STAGED)
    publishing.remove_unfinished(folder)


def _remove_dead(folder: Path, prefix: str) -> None:
    for path in folder.glob(f"{prefix}*"):
        if is_dead(path.name.removeprefix(prefix), _quiet_s(path)):
            shutil.rmtree(path, ignore_errors=True)


def _quiet_s(folder: Path) -> float:
    """Seconds since anything in the folder was written; 0 for one that vanishes while we look."""
    newest = 0.0
    try:
        for path in (folder, *folder.rglob("*")):
            newest = max(newest, path.stat().st_mtime)
    except OSError:
        return 0.0
    return time.time() - newest
