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
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import fsspec
import numpy as np
from fsspec.implementations.local import LocalFileSystem
from numpy.typing import NDArray

_INFO = "info.json"
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

    def get(self, step: str, key: str) -> Entry | None:
        """The result, or None when there is none or it is damaged."""
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        try:
            with filesystem.open(path, "rb") as file:
                return _unpack(file.read())
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

    def remove(self, step: str, key: str) -> None:
        """Forget a result, so that the next run makes it again."""
        filesystem, path = fsspec.url_to_fs(self.path(step, key))
        with contextlib.suppress(FileNotFoundError):
            filesystem.rm_file(path)

    def put(
        self, step: str, key: str, arrays: Mapping[str, NDArray], info: Mapping[str, Any], compress: bool = False
    ) -> None:
        """Store a result whole, under its final name only when all of it is written."""
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


def _pack(arrays: Mapping[str, NDArray], info: Mapping[str, Any], compress: bool) -> bytes:
    buffer = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", method, compresslevel=1) as archive:
        archive.writestr(_INFO, json.dumps(dict(info)))
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def _unpack(data: bytes) -> Entry:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        info = json.loads(archive.read(_INFO))
        arrays = {
            name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(archive.read(name)), allow_pickle=False)
            for name in archive.namelist()
            if name != _INFO
        }
    return Entry(arrays, info)
