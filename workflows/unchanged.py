"""Files that a new version has in common with the newest: copied from it instead of made again."""

import hashlib
from fnmatch import fnmatch
from pathlib import Path
from typing import Final, NamedTuple

from upath import UPath

from ..catalog import versions
from ..catalog.filesystems import Folder, ObjectStoreError, asking
from ..schemas.products import Quality
from ..schemas.provenance import Provenance

# costly to write and often the same; what stands in them is named by Provenance.parts
PARTS: Final = {"mosaics": "mosaic*.tif", "soundings": "soundings.laz", "mesh": "mesh*"}
_CHUNK: Final = 2**22


class Newest(NamedTuple):
    """The newest version: where it is, what it was made from and its figures."""

    folder: Folder
    provenance: Provenance
    quality: Quality


def newest(out: str, mission_id: str) -> Newest | None:
    """None without a version, or where its records are unreadable or of another seamosaic."""
    found = versions.newest_version(out, mission_id)
    if found is None:
        return None
    try:
        texts = [_text(found.path / name) for name in (versions.PROVENANCE, "quality.json")]
        return Newest(found.path, Provenance.model_validate_json(texts[0]), Quality.model_validate_json(texts[1]))
    except ObjectStoreError:
        raise
    except (OSError, ValueError):
        return None


def _text(path: Folder) -> str:
    with asking(UPath(path).fs, str(path)):
        return path.read_text(encoding="utf-8")


def take(before: Newest | None, folder: Path, part: str, made_from: str) -> dict[str, str]:
    """Copy a part's files from the newest version, if it has them whole and made from the same.

    Parameters
    ----------
    part : one of PARTS. made_from : the digest that stands for it.

    Returns
    -------
    SHA-256 of the files that were copied, by name; none if they have to be made.
    """
    if before is None or before.provenance.parts.get(part) != made_from:
        return {}
    outputs = before.provenance.outputs.items()
    files = {name: sha for name, sha in outputs if fnmatch(name, PARTS[part]) and _is_inside(name)}
    if all(_copy(before.folder / name, folder / name, sha) for name, sha in files.items()):
        return files
    for name in files:
        (folder / name).unlink(missing_ok=True)
    return {}


def _is_inside(name: str) -> bool:
    """Whether a name leads nowhere but into the version's folder; the file that gives it may have been edited."""
    return not (name.startswith("/") or ".." in name.replace("\\", "/").split("/"))


def _copy(source: Folder, target: Path, sha256: str) -> bool:
    """Whether the file was there and whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    found = hashlib.sha256()
    try:
        with asking(UPath(source).fs, str(source)), source.open("rb") as old, target.open("wb") as new:
            while chunk := old.read(_CHUNK):
                found.update(chunk)
                new.write(chunk)
    except FileNotFoundError:
        return False
    return found.hexdigest() == sha256
