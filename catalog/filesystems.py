"""Files wherever they are: a folder of this machine, or a prefix of an object store, through fsspec.

The endpoint and the credentials of an object store are fsspec's and the store's own configuration (docs/clusters.md).
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, cast

import fsspec
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from upath import UPath

from .runs import run_name

Folder = Path | UPath

# What a busy object store needs: more tries than botocore's own five, and no eternal waits
_PATIENCE: Final = {"retries": {"mode": "standard", "max_attempts": 7}, "connect_timeout": 10, "read_timeout": 60}
_S3: Final = ("s3", "s3a")
# Told apart by those who asked; everything else is the store's trouble
_ANSWERS: Final = (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError, NotADirectoryError)
_FOREIGN: Final = (("botocore.exceptions", "BotoCoreError"), ("aiohttp", "ClientError"))


_REMEDY: Final = "Check that the object store runs, AWS_ENDPOINT_URL, and the credentials (docs/clusters.md)."
# the directory of a stored result and its record are at its end: one read
_PART_BYTES: Final = 64 * 1024


class ObjectStoreError(OSError):
    """An object store did not answer, or with an error of its own, however often it was asked."""


def is_remote(url: str | os.PathLike[str]) -> bool:
    """Whether it is the URL of something that is no folder of this machine."""
    protocol = fsspec.core.split_protocol(str(url))[0]
    return protocol not in (None, "file", "local")


def connect(url: str) -> tuple[AbstractFileSystem, str]:
    """The file system of a URL and the path in it."""
    fs, path = fsspec.url_to_fs(url, **_options(url))
    return fs, cast(str, path)


def absolute(url: str | os.PathLike[str]) -> str:
    """A URL or path in the one spelling by which it is known: of this machine a path, absolute and without links."""
    return str(url).rstrip("/") if is_remote(url) else os.path.realpath(connect(str(url))[1])


def place(url: str | os.PathLike[str]) -> Folder:
    """A URL as a path, to join names to and to read from; a Path where it is of this machine."""
    if isinstance(url, Path | UPath):
        return url
    if not is_remote(url):
        return Path(cast(str, connect(str(url))[1])) if "://" in str(url) else Path(url)
    return UPath(url, **_options(str(url)))


def _options(url: str) -> dict[str, Any]:
    if not is_remote(url):
        return {}
    options: dict[str, Any] = {"use_listings_cache": False}  # other runs write there too
    if fsspec.core.split_protocol(url)[0] in _S3:
        chosen = fsspec.config.conf.get("s3", {}).get("config_kwargs", {})
        # a variable of botocore's that is set counts, which it would not beside these
        ours = {} if {"AWS_MAX_ATTEMPTS", "AWS_RETRY_MODE"} & set(os.environ) else _PATIENCE
        options["config_kwargs"] = {**ours, **chosen}
    return options


@contextmanager
def asking(fs: AbstractFileSystem, what: str) -> Iterator[None]:
    """Around every access: what an object store's client raises becomes an OSError that says so.

    Raises
    ------
    ObjectStoreError
        For what is neither "no such file" nor "access denied": the store is unwell or out of reach.
    """
    if isinstance(fs, LocalFileSystem):
        yield
        return
    try:
        yield
    except (ObjectStoreError, *_ANSWERS):
        raise
    except Exception as error:
        if isinstance(error, (OSError, *_foreign())):
            reason = (str(error) or type(error).__name__).rstrip(".")
            raise ObjectStoreError(f"{what}: {reason}. {_REMEDY}") from error
        raise


def _foreign() -> tuple[type[BaseException], ...]:
    """The bases of what the clients raise that is no OSError, of those clients that are loaded."""
    return tuple(getattr(sys.modules[module], name) for module, name in _FOREIGN if module in sys.modules)


def settle(path: str | os.PathLike[str]) -> None:
    """Have a file or folder of this machine written to its disk, so that a power cut leaves it whole."""
    try:
        handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError:
        if os.path.isfile(path):  # not every file system does that for a folder
            raise


def is_glob(text: str) -> bool:
    """Whether a path, or a part of one, has signs that a glob expands."""
    return any(sign in text for sign in "*?[")


def entries(fs: AbstractFileSystem, folder: str, what: str) -> dict[str, dict[str, Any]]:
    """What is in a folder, by path. One request; every trouble is raised, which fsspec's find and glob pass over."""
    with asking(fs, what):
        found: list[dict[str, Any]] = fs.ls(folder, detail=True)
    named = ((info["name"].rstrip("/"), info) for info in found)
    return {path: info for path, info in named if path != folder}


def open_parts(fs: AbstractFileSystem, path: str) -> Any:
    """A file to read parts of: nothing else of it is fetched from an object store."""
    if isinstance(fs, LocalFileSystem):
        return fs.open(path, "rb")
    return fs.open(path, "rb", block_size=_PART_BYTES, cache_type="blockcache")


def write_whole(url: str, data: bytes, scratch: str) -> None:
    """Write a file so that it is there whole or not at all.

    scratch : on this machine, the folder for what is not whole yet; on the same disk.
    """
    fs, path = connect(url)
    if not isinstance(fs, LocalFileSystem):
        with asking(fs, url):
            fs.pipe_file(path, data)
        return
    temporary = f"{connect(scratch)[1]}/{run_name()}"
    for folder in (path, temporary):
        os.makedirs(os.path.dirname(folder), exist_ok=True)
    try:
        with open(temporary, "wb") as file:
            file.write(data)
        os.replace(temporary, path)
    except OSError as error:  # of a write it does not name the file
        raise type(error)(error.errno, error.strerror, path) from error
    finally:
        if os.path.exists(temporary):
            os.remove(temporary)


def _another_was_first(error: OSError) -> bool:
    """Whether a store says that an object is there already, or that two came at once: not all in s3fs's words."""
    answer: Any = getattr(error.__cause__, "response", None) or {}
    code = str(answer.get("Error", {}).get("Code", ""))
    conflicts = "ConditionalRequestConflict", "PreconditionFailed"
    return code in (*conflicts, "412") or any(name in str(error) for name in conflicts)


def create(fs: AbstractFileSystem, path: str, data: bytes) -> bool:
    """Write a file unless it is there; whether it is now the one that we wrote.

    Asked for by If-None-Match where the store knows it. It is read back, because an answer may have been lost on the
    way, and for stores that overwrite all the same.

    data : like no one else's.
    """
    with asking(fs, path):
        try:
            fs.pipe_file(path, data, mode="create")
        except FileExistsError:
            pass
        except OSError as error:
            if not _another_was_first(error):
                raise
        try:
            return fs.cat_file(path) == data
        except FileNotFoundError:
            return False
