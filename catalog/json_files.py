"""Small JSON files, local or in an object store: they appear whole or not at all."""

import contextlib
import errno
import json
import os
import threading
from typing import Any
from uuid import uuid4

from fsspec.implementations.local import LocalFileSystem

from .filesystems import ObjectStoreError, asking, connect, create, settle

# file systems without hard links: exFAT, some network shares
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


def read_json(url: str, *, strict: bool = False) -> Any | None:
    """What the file holds; None if there is none or it is damaged, or may not or cannot be read.

    strict : raise what keeps it from being read, as it may be there.

    Raises
    ------
    ObjectStoreError
        If the store does not answer.
    """
    filesystem, path = connect(url)
    try:
        with asking(filesystem, url):
            return json.loads(filesystem.cat_file(path))  # type: ignore[arg-type]
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    except OSError as error:
        if strict or isinstance(error, ObjectStoreError):
            raise
        return None


def write_json(url: str, value: Any, new: bool = False) -> None:
    """Write the file whole.

    Parameters
    ----------
    new : only if there is none yet: of several that write at once, one succeeds. The value is like no one else's.

    Raises
    ------
    FileExistsError
        If it has to be new and is not.
    """
    filesystem, path = connect(url)
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    data = text.encode("utf-8", "backslashreplace")  # names that are no UTF-8 have escapes, in JSON too
    if isinstance(filesystem, LocalFileSystem):
        _write_local(path, data, new)
    elif not new:  # an object is put whole
        with asking(filesystem, url):
            filesystem.pipe_file(path, data)
    elif not create(filesystem, path, data):
        raise FileExistsError(url)


def _write_local(path: str, data: bytes, new: bool) -> None:
    folder, name = os.path.split(path)
    temporary = os.path.join(folder, f".{name}.{os.getpid()}-{threading.get_ident()}-{uuid4().hex[:8]}.tmp")
    for _ in range(3):  # whoever takes the last file out of a folder takes the folder with it
        os.makedirs(folder, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            _put(temporary, path, data, new)
            return
    _put(temporary, path, data, new)


def _put(temporary: str, path: str, data: bytes, new: bool) -> None:
    try:
        with open(temporary, "wb") as file:
            file.write(data)
        settle(temporary)
        if new:
            _link(temporary, path, data)
        else:
            os.replace(temporary, path)
        settle(os.path.dirname(path))
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(temporary)


def _link(temporary: str, path: str, data: bytes) -> None:
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        with open(path, "xb") as file:
            file.write(data)
        settle(path)


def remove(url: str) -> None:
    """Remove a file, if it is there; locally also its folder, if nothing else is in it."""
    filesystem, path = connect(url)
    with asking(filesystem, url), contextlib.suppress(FileNotFoundError):
        filesystem.rm_file(path)
    if isinstance(filesystem, LocalFileSystem):
        with contextlib.suppress(OSError):
            os.rmdir(os.path.dirname(path))


def exists(url: str) -> bool:
    """Whether there is such a file."""
    filesystem, path = connect(url)
    try:
        with asking(filesystem, url):
            return filesystem.info(path)["type"] == "file"
    except (FileNotFoundError, NotADirectoryError):
        return False


def names(url: str) -> list[str]:
    """Names of the files and folders in a folder, sorted; none if it does not exist. Hidden ones are left out."""
    filesystem, path = connect(url)
    try:
        with asking(filesystem, url):
            found = filesystem.ls(path, detail=False)
    except (FileNotFoundError, NotADirectoryError):
        return []
    listed = (one.rstrip("/").rpartition("/")[2] for one in found)
    return sorted(name for name in listed if name and not name.startswith("."))
