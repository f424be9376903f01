"""Versions of products on an object store, where nothing can be renamed.

A version exists from the moment when its provenance does, which is uploaded last and never over another one. Before,
its number is claimed by an object beside the versions, `.claims/vN`, that only one run can create. The claim is renewed
while the upload lasts and removed after it; that of a dead run is removed, with what it had uploaded, by the next run.
"""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from upath import UPath

from .filesystems import Folder, ObjectStoreError, asking, create
from .runs import is_dead, run_name

PROVENANCE: Final = "metadata/provenance.json"
_CLAIMS: Final = ".claims"
RENEW_S, SILENCE_S, _LOOK_S = 20.0, 120.0, 1.0


class LostClaim(ObjectStoreError):
    """The number of a version was given to another run while this one was uploading it."""


def digest_of(folder: Folder) -> str | None:
    """What a version was made from, by its provenance; None if that cannot be read."""
    try:
        with asking(UPath(folder).fs, str(folder)):
            found = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))["digest"]
    except ObjectStoreError:
        raise
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if isinstance(found, str) else None


def finished(folder: UPath) -> list[int]:
    """Numbers of the versions in a mission's prefix that are whole, unsorted."""
    with asking(folder.fs, str(folder)):
        return [number for number in _numbers(folder) if _is_whole(folder / f"v{number}")]


def _is_whole(version: UPath) -> bool:
    try:
        return bool(version.fs.info((version / PROVENANCE).path))
    except FileNotFoundError:  # `exists` takes any trouble for a no
        return False


def _numbers(folder: UPath) -> list[int]:
    """Numbers of what is named like a version in a prefix; none if there is no such prefix."""
    try:
        entries = folder.fs.ls(folder.path, detail=False)
    except FileNotFoundError:
        return []
    names = [str(path).rstrip("/").rpartition("/")[2] for path in entries]
    return [int(name[1:]) for name in names if name[:1] == "v" and name[1:].isdigit() and name[1:2] != "0"]


class _Claim(NamedTuple):
    """Who uploads a version: what it is made from, by which run, and how often the claim was renewed."""

    digest: str
    run: str
    beat: int = 0

    def bytes(self) -> bytes:
        return json.dumps(self._asdict()).encode()


def publish(made: Path, folder: UPath, digest: str) -> UPath:
    """Upload a version that is whole in a local folder, under the next number of the mission's prefix.

    If another run has finished the same, or is uploading it, that one counts.
    """
    claim = _Claim(digest, run_name())
    while True:
        with asking(folder.fs, str(folder)):
            claims = _numbers(folder / _CLAIMS)  # before the versions: one that ends meanwhile is among these
        known = sorted(finished(folder))
        if known and digest_of(folder / f"v{known[-1]}") == digest:
            return folder / f"v{known[-1]}"
        if any(_is_at_work(folder, number, digest) for number in claims if number not in known):
            continue
        number = max([0, *known, *claims]) + 1
        if create(folder.fs, _path(folder, number), claim.bytes()):
            if not _is_whole(folder / f"v{number}"):
                break
            _remove(folder, number)  # of another run that began and ended since we looked
    with _kept(folder, number, claim) as check:
        _upload(made, folder / f"v{number}", check)
    return folder / f"v{number}"


def _path(folder: UPath, number: int) -> str:
    return (folder / _CLAIMS / f"v{number}").path


def _read(folder: UPath, number: int) -> _Claim | None:
    with asking(folder.fs, str(folder)), suppress(FileNotFoundError, ValueError, TypeError):
        return _Claim(**json.loads(folder.fs.cat_file(_path(folder, number))))
    return None


def _is_at_work(folder: UPath, number: int, digest: str) -> bool:
    """Wait while another run uploads what is made from the same; False if it does not, or has fallen silent."""
    seen = _read(folder, number)
    if seen is None or seen.digest != digest or is_dead(seen.run, 0.0):
        return False
    since = time.monotonic()
    while time.monotonic() - since < SILENCE_S:
        time.sleep(_LOOK_S)
        now = _read(folder, number)
        if now is None:
            return True
        if now != seen:
            seen, since = now, time.monotonic()
    return False


@contextmanager
def _kept(folder: UPath, number: int, claim: _Claim) -> Iterator[Any]:
    """Renew a claim as long as the context lasts, and take it off after; gives a function that checks it."""
    ended, fs = threading.Event(), folder.fs

    def check() -> None:
        now = _read(folder, number)
        if now is None or now.run != claim.run:
            raise LostClaim(f"{folder / f'v{number}'} was taken by another run; run again")

    def renew() -> None:
        beat = 0
        while not ended.wait(RENEW_S):
            beat += 1
            with suppress(OSError):  # the upload itself will say what is wrong
                check()
                with asking(fs, str(folder)):
                    fs.pipe_file(_path(folder, number), claim._replace(beat=beat).bytes())

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield check
    except LostClaim:
        raise
    except BaseException:
        ended.set()
        thread.join()
        with suppress(OSError):
            _remove(folder, number)
        raise
    else:
        ended.set()
        thread.join()
        with asking(fs, str(folder)), suppress(FileNotFoundError):
            fs.rm_file(_path(folder, number))
    finally:
        ended.set()


def _upload(made: Path, version: UPath, check: Any) -> None:
    """Every file of a version, its provenance last."""
    files = sorted(path for path in made.rglob("*") if path.is_file())
    for path in files:
        name = path.relative_to(made).as_posix()
        if name != PROVENANCE:
            check()
            with asking(version.fs, f"{version}/{name}"):
                version.fs.put_file(str(path), (version / name).path)
    check()
    if not create(version.fs, (version / PROVENANCE).path, (made / PROVENANCE).read_bytes()):
        raise LostClaim(f"{version} was finished by another run; run again")


def remove_unfinished(folder: UPath) -> None:
    """Remove the claims of dead runs and what they had uploaded."""
    with asking(folder.fs, str(folder)):
        claims = _numbers(folder / _CLAIMS)
    for number in claims:
        claim = _read(folder, number)
        if claim is not None and is_dead(claim.run, _quiet_s(folder, number)):
            _remove(folder, number)


def _remove(folder: UPath, number: int) -> None:
    """Take a claim off, and what was uploaded under it if the version is not whole."""
    version = folder / f"v{number}"
    with asking(folder.fs, str(version)):
        if not _is_whole(version):
            with suppress(FileNotFoundError):
                folder.fs.rm(version.path, recursive=True)
        with suppress(FileNotFoundError):
            folder.fs.rm_file(_path(folder, number))


def _quiet_s(folder: UPath, number: int) -> float:
    with asking(folder.fs, str(folder)), suppress(FileNotFoundError, NotImplementedError):
        changed = folder.fs.modified(_path(folder, number))
        return (datetime.now(UTC) - changed.replace(tzinfo=changed.tzinfo or UTC)).total_seconds()
    return 0.0
