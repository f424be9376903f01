"""Results of steps, kept under the digest of what they were made from (DESIGN, "How data flows").

A digest that exists is never computed again; there is no other notion of freshness. An entry is one .npz file of
named arrays and a JSON text; it appears whole or not at all, and one that cannot be read counts as absent.
"""

import contextlib
import hashlib
import io
import json
import os
import threading
import zipfile
import zlib
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import fsspec
import numpy as np
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray

_INFO, _ARRAY = "info.json", ".npy"
_UNREADABLE = (FileNotFoundError, zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError)


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
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        try:
            with filesystem.open(path, "rb") as file:
                if names is None:  # at one go, as object stores like it
                    return _unpack(io.BytesIO(file.read()), None)
                return _unpack(file, names)
        except _UNREADABLE:
            return None

    def info(self, step: str, key: str) -> dict[str, Any] | None:
        """The record of a result without its arrays, or None when there is none or its directory is damaged."""
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        try:
            with filesystem.open(path, "rb") as file, zipfile.ZipFile(file) as archive:
                return json.loads(archive.read(_INFO))
        except _UNREADABLE:
            return None

    def touch(self, step: str, key: str) -> None:
        """Note that a result was used, for `pruning`; an object store knows only when it was made."""
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        if isinstance(filesystem, LocalFileSystem):
            with contextlib.suppress(OSError):
                os.utime(path)

    def remove(self, step: str, key: str) -> None:
        """Forget a result, so that the next run makes it again."""
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        with contextlib.suppress(FileNotFoundError):
            filesystem.rm_file(path)

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
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        data = _pack(arrays, info, compress)
        if isinstance(filesystem, LocalFileSystem):
            temporary = f"{path}.{os.getpid()}-{threading.get_ident()}.tmp"
            os.makedirs(os.path.dirname(path), exist_ok=True)
            try:
                with open(temporary, "wb") as file:
                    file.write(data)
                os.replace(temporary, path)
            finally:
                if os.path.exists(temporary):
                    os.remove(temporary)
        else:
            filesystem.pipe_file(path, data)


def _pack(arrays: Mapping[str, NDArray], info: Mapping[str, Any], compress: bool | Collection[str]) -> bytes:
    buffer = io.BytesIO()
    squeezed = compress if not isinstance(compress, bool) else arrays if compress else ()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(_INFO, json.dumps(dict(info)))
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
            method = zipfile.ZIP_DEFLATED if name in squeezed else zipfile.ZIP_STORED
            archive.writestr(f"{name}{_ARRAY}", member.getbuffer(), method, compresslevel=1)
    return buffer.getvalue()


def _unpack(file: Any, names: Collection[str] | None) -> Entry:
    with zipfile.ZipFile(file) as archive:
        info = json.loads(archive.read(_INFO))
        known = [name.removesuffix(_ARRAY) for name in archive.namelist() if name != _INFO]
        arrays = {
            name: np.lib.format.read_array(io.BytesIO(archive.read(f"{name}{_ARRAY}")), allow_pickle=False)
            for name in known
            if names is None or name in names
        }
    return Entry(arrays, info)
