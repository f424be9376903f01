"""Results of steps, kept under the digest of what they were made from (DESIGN, "How data flows").

A digest that exists is never computed again; there is no other notion of freshness. An entry is one .npz file of
named arrays and a JSON text; it appears whole or not at all, and one that cannot be read counts as absent.
"""

import contextlib
import errno
import hashlib
import io
import json
import os
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray

from .filesystems import ObjectStoreError, asking, connect, open_parts, write_whole
from .runs import is_dead, run_name

R = TypeVar("R")

_INFO, _ARRAY, _SCRATCH = "info.json", ".npy", ".tmp"
_UNREADABLE = (
    *(FileNotFoundError, zipfile.BadZipFile, zlib.error, struct.error),
    *(ValueError, KeyError, EOFError, RuntimeError, OverflowError),  # of damaged sizes, names and flags
)


def digest(step: str, code_version: str, inputs: Iterable[str], parameters: Any) -> str:
    """SHA-256 (hex) that names the result of a step.

    inputs : digests of what the step reads, in the order in which it matters.
    parameters : anything JSON can hold, exactly what the step reads of the parameters and the calibration.
    """
    text = json.dumps([step, code_version, list(inputs), parameters], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


class Entry(NamedTuple):
    """A stored result: named arrays and a small JSON-like record."""

    arrays: dict[str, NDArray]
    info: dict[str, Any]


class Store(NamedTuple):
    """A folder or object-store prefix (any fsspec URL) of step results."""

    url: str

    def path(self, step: str, key: str) -> str:
        return f"{self.url}/{step}/{key[:2]}/{key}.npz"

    def get(self, step: str, key: str, names: Collection[str] | None = None) -> Entry | None:
        """The result, or None when there is none or it is damaged.

        names : arrays that are wanted, of those that it has; nothing else is read. None: all.
        """
        fs, path = connect(self.path(step, key))

        def read() -> Entry:
            if names is None or not isinstance(fs, LocalFileSystem):  # at one go, as object stores like it
                return _unpack(io.BytesIO(cast(bytes, fs.cat_file(path))), names)
            with fs.open(path, "rb") as file:
                return _unpack(file, names)

        return _unless_damaged(fs, path, read)

    def info(self, step: str, key: str) -> dict[str, Any] | None:
        """The record of a result without its arrays, or None when there is none or its directory is damaged."""
        fs, path = connect(self.path(step, key))

        def read() -> dict[str, Any]:
            with open_parts(fs, path) as file, zipfile.ZipFile(file) as archive:
                return _read_info(archive)[1]

        return _unless_damaged(fs, path, read)

    def touch(self, step: str, key: str) -> None:
        """Note that a result was used, for `pruning`; an object store knows only when it was made."""
        fs, path = connect(self.path(step, key))
        if isinstance(fs, LocalFileSystem):
            with contextlib.suppress(OSError):
                os.utime(path)

    def remove(self, step: str, key: str) -> None:
        """Forget a result, so that the next run makes it again."""
        fs, path = connect(self.path(step, key))
        with asking(fs, path), contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    def clean(self) -> None:
        """Remove what dead runs had not finished writing, and their marks."""
        fs, folder = connect(f"{self.url}/{_SCRATCH}")
        with asking(fs, folder), contextlib.suppress(FileNotFoundError):
            for path in fs.ls(folder, detail=False):
                with contextlib.suppress(FileNotFoundError):  # finished meanwhile
                    if is_dead(path.rpartition("/")[2], time.time() - fs.modified(path).timestamp()):
                        fs.rm_file(path)

    def mark(self, name: str = "") -> str:
        """Leave a mark by which other processes tell that they see the same store, or renew it; its name."""
        name = name or run_name()
        write_whole(self._mark(name), name.encode(), f"{self.url}/{_SCRATCH}")
        return name

    def is_marked(self, name: str) -> bool:
        fs, path = connect(self._mark(name))
        try:
            with asking(fs, path):
                return fs.cat_file(path) == name.encode()
        except ObjectStoreError:
            raise
        except OSError:
            return False

    def unmark(self, name: str) -> None:
        fs, path = connect(self._mark(name))
        with asking(fs, path), contextlib.suppress(FileNotFoundError):
            fs.rm_file(path)

    def _mark(self, name: str) -> str:
        return f"{self.url}/{_SCRATCH}/{name}"

    def put(
        self,
        step: str,
        key: str,
        arrays: Mapping[str, NDArray],
        info: Mapping[str, Any],
        compress: bool | Collection[str] = False,
    ) -> None:
        """Store a result whole, under its final name only when all of it is written.

        compress : all arrays, none, or the names of those that are worth it.
        """
        write_whole(self.path(step, key), _pack(arrays, info, compress), f"{self.url}/{_SCRATCH}")


def _unless_damaged(fs: AbstractFileSystem, path: str, read: Callable[[], R]) -> R | None:
    """What is read, or None if there is nothing or it is damaged."""
    try:
        with asking(fs, path):
            return read()
    except _UNREADABLE:
        return None
    except OSError as error:
        if error.errno != errno.EINVAL:  # of a place before the file's beginning
            raise
        return None


def _pack(arrays: Mapping[str, NDArray], info: Mapping[str, Any], compress: bool | Collection[str]) -> bytes:
    buffer = io.BytesIO()
    squeezed = compress if not isinstance(compress, bool) else arrays if compress else ()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
            method = zipfile.ZIP_DEFLATED if name in squeezed else zipfile.ZIP_STORED
            archive.writestr(f"{name}{_ARRAY}", member.getbuffer(), method, compresslevel=1)
        archive.writestr(_INFO, json.dumps({"arrays": list(arrays), "info": dict(info)}))
    return buffer.getvalue()


def _unpack(file: Any, names: Collection[str] | None) -> Entry:
    with zipfile.ZipFile(file) as archive:
        known, info = _read_info(archive)
        arrays = {
            name: np.lib.format.read_array(io.BytesIO(archive.read(f"{name}{_ARRAY}")), allow_pickle=False)
            for name in known
            if names is None or name in names
        }
    return Entry(arrays, info)


def _read_info(archive: zipfile.ZipFile) -> tuple[list[str], dict[str, Any]]:
    """Names of the arrays, and the record; a name damaged in the archive's directory would be an absent array."""
    found = json.loads(archive.read(_INFO))
    if [*(f"{name}{_ARRAY}" for name in found["arrays"]), _INFO] != archive.namelist():
        raise zipfile.BadZipFile("its directory and its record disagree")
    return found["arrays"], found["info"]
