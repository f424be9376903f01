"""Files read once: their SHA-256, and what an image's header and end tell."""

import hashlib
import io
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, BinaryIO, NamedTuple, cast

from fsspec import AbstractFileSystem

from .filesystems import ObjectStoreError, asking, open_parts
from .image_headers import HEADER_BYTES, TAIL_BYTES, Header, read_header

_BLOCK = 4 * 1024 * 1024
# Enough to hide the latency of an object store; a local disk is not made slower by it.
_THREADS = 8
_MODIFIED = ("mtime", "LastModified", "last_modified", "updated", "ETag", "created")


class Inspection(NamedTuple):
    """What one image file is.

    Attributes
    ----------
    sha256 : of its bytes; empty if it could not be read.
    header : its size, time and faults.
    """

    sha256: str
    header: Header


def sha256(content: bytes) -> str:
    """SHA-256 of bytes, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def inspect_images(
    fs: AbstractFileSystem, files: Sequence[tuple[str, Mapping[str, Any]]], known: MutableMapping[str, Any] | None
) -> list[Inspection]:
    """Read each file once, block by block; a file that is known already is not read.

    Parameters
    ----------
    files : path in the file system and its entry (`fs.info`), for each image.
    known : what earlier runs read, by path, size and time of change; added to. Keys are texts and values lists
        of plain values, so that it can be kept as JSON. None to read everything.
    """
    known = {} if known is None else known
    keys = [file_key(path, info) for path, info in files]
    unread = [i for i, key in enumerate(keys) if key is None or key not in known]
    read = dict(zip(unread, _all(_inspect, fs, [files[i][0] for i in unread]), strict=True))
    for i, inspection in read.items():
        key = keys[i]
        if key is not None and inspection.sha256:
            known[key] = [inspection.sha256, list(inspection.header)]
    return [read[i] if i in read else _recall(known[str(key)]) for i, key in enumerate(keys)]


def are_known(files: Sequence[tuple[str, Mapping[str, Any]]], known: Mapping[str, Any] | None) -> bool:
    """Whether `inspect_images` would have to read none of these files."""
    return all(file_key(path, info) in (known or {}) for path, info in files)


def peek_images(
    fs: AbstractFileSystem, files: Sequence[tuple[str, Mapping[str, Any]]], known: Mapping[str, Any] | None = None
) -> list[Inspection]:
    """Read only the first and last bytes of each file, and nothing of one that is known; the digests stay empty."""
    keys = [file_key(path, info) for path, info in files]
    found = {i: _recall(known[str(key)])._replace(sha256="") for i, key in enumerate(keys) if known and key in known}
    unread = [i for i in range(len(files)) if i not in found]
    found |= zip(unread, _all(_peek, fs, [files[i][0] for i in unread]), strict=True)
    return [found[i] for i in range(len(files))]


def _all(
    read: Callable[[AbstractFileSystem, str], Inspection], fs: AbstractFileSystem, paths: list[str]
) -> list[Inspection]:
    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(lambda path: read(fs, path), paths))


def _recall(value: Sequence[Any]) -> Inspection:
    return Inspection(value[0], Header(*value[1]))


def file_key(path: str, info: Mapping[str, Any]) -> str | None:
    """Path, size and time of change of a file; None if the file system does not tell the latter."""
    modified = next((info[name] for name in _MODIFIED if info.get(name) is not None), None)
    return None if modified is None else f"{path}|{info.get('size')}|{modified}"


def _inspect(fs: AbstractFileSystem, path: str) -> Inspection:
    digest, head, tail = hashlib.sha256(), b"", b""
    try:
        with asking(fs, path), cast(BinaryIO, fs.open(path, "rb")) as file:
            while block := file.read(_BLOCK):
                digest.update(block)
                head = head or block[:HEADER_BYTES]
                tail = (tail + block)[-TAIL_BYTES:]
            return Inspection(digest.hexdigest(), read_header(head, tail, file))
    except ObjectStoreError:
        raise
    except OSError as error:
        return _unreadable(error)


def _peek(fs: AbstractFileSystem, path: str) -> Inspection:
    try:
        with asking(fs, path), cast(BinaryIO, open_parts(fs, path)) as file:
            head = file.read(HEADER_BYTES)
            file.seek(max(0, file.seek(0, io.SEEK_END) - TAIL_BYTES))
            return Inspection("", read_header(head, file.read(TAIL_BYTES), file))
    except ObjectStoreError:
        raise
    except OSError as error:
        return _unreadable(error)


def _unreadable(error: OSError) -> Inspection:
    return Inspection("", Header(0, 0, "", f"file cannot be read ({error.strerror or error})"))
