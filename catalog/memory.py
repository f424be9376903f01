"""What earlier runs learnt of a mission's files, so that one that did not change is known without reading it.

Kept in OUT/.missions/<digest of the mission's place>.json: the images' digests by path, size and time of change, and
a look at the mission as a whole. It may be deleted at any time; the next run then reads every image again.
"""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

from ..schemas.problems import InvalidInput
from . import json_files
from .digests import sha256
from .filesystems import absolute
from .mission_files import MissionFiles
from .missions import OpenedMission, open_mission, span
from .store import digest

FOLDER: Final = ".missions"
_NAMED_BY: Final = ("image", "role", "time", "status", "sha256")


class Look(NamedTuple):
    """A mission as far as it is known without reading its images.

    Attributes
    ----------
    id, title, platform : of mission.yaml. start, end : first and last exposure, ISO 8601, UTC; empty if unknown.
    images : how many. unread : how many of them are new or were changed since they were last read whole.
    texts : SHA-256 of the text files, by name. inputs : digest of all that a run reads, of unread images that they
        could not be read; None if there are no others.
    """

    id: str
    title: str
    platform: str
    start: str
    end: str
    images: int
    unread: int
    texts: dict[str, str]
    inputs: str | None


def inputs_digest(opened: OpenedMission) -> str:
    """SHA-256 of everything that a run reads of a mission: text files, and images in their places and roles."""
    texts = sorted(f"{name}:{sha}" for name, sha in opened.input_digests.items())
    rows = zip(*(opened.frames[name].values for name in _NAMED_BY), strict=True)
    return digest("inputs", "1", [*texts, *map(str, rows)], None)


def open_known(url: str, out: str, memory: "Memory | None" = None) -> OpenedMission:
    """Open a mission; images that earlier runs with this output folder read are not read again.

    memory : if it was recalled before.

    Raises
    ------
    InvalidInput
        With everything that is wrong with the mission.
    """
    memory, keys = memory or recall(url, out), _keys(url)
    opened = open_mission(url, memory.images)
    _remember(url, out, memory, opened, keys)
    return opened


def look(url: str, out: str) -> Look:
    """A mission at a glance: from memory if none of its files changed, else from headers and text files.

    Raises
    ------
    InvalidInput
        With everything that is wrong with the mission.
    """
    memory, keys = recall(url, out), _keys(url)
    same = memory.state is not None and memory.state == _state(keys)
    known = memory.look if same else None
    # images that could not be read when others were may be readable now, and look the same from outside
    if known and not (known.inputs and known.unread) and _texts_same(url, known.texts):
        return known
    opened = open_mission(url, dict(memory.images), hashed=None)
    if recall(url, out) != memory:  # a run has read the images meanwhile
        return look(url, out)
    return _remember(url, out, memory, opened, keys)


class Memory(NamedTuple):
    """What the file holds. images : as `open_mission` takes and adds to. state : of all files at the last look."""

    images: dict[str, Any]
    state: str | None
    look: Look | None


def _place(url: str, out: str) -> str:
    name = hashlib.sha256(absolute(url).encode("utf-8", "surrogateescape")).hexdigest()[:24]
    return f"{out.rstrip('/')}/{FOLDER}/{name}.json"


def recall(url: str, out: str) -> Memory:
    """What is known of a mission; nothing if there is no file, or a damaged one."""
    found: Any = json_files.read_json(_place(url, out))
    with suppress(TypeError, KeyError):
        return Memory(found["images"], found["state"], Look(**found["look"]))
    return Memory({}, None, None)


def _keys(url: str) -> dict[str, str | None]:
    """Sizes and times before the files are read: what changes meanwhile is looked at again."""
    with suppress(InvalidInput):  # is said better on opening
        return MissionFiles(url).keys()
    return {}


def _state(keys: Mapping[str, str | None]) -> str | None:
    if None in keys.values():
        return None
    # files that are none of the mission's may have any name
    return sha256("\n".join(sorted(map(str, keys.values()))).encode("utf-8", "surrogateescape"))


def _texts_same(url: str, texts: Mapping[str, str]) -> bool:
    """Whether the text files, which are quickly read, still are what they were: an edit may keep size and second."""
    files = MissionFiles(url)
    for name in texts:
        files.read(name, None, [])
    return files.digests == texts


def _remember(url: str, out: str, memory: Memory, opened: OpenedMission, keys: Mapping[str, str | None]) -> Look:
    mission, frames = opened.mission, opened.frames
    names, read = frames["image"].values.tolist(), bool((frames["sha256"].values != "").any())
    seen = Look(
        *(mission.id, mission.title, mission.platform, *_span(opened), len(names)),
        unread=sum(keys.get(name) not in memory.images for name in names),
        texts=dict(opened.input_digests),
        inputs=inputs_digest(opened) if read else None,
    )
    present = set(keys.values())
    images = {key: known for key, known in memory.images.items() if key in present}
    value = {"images": images, "state": _state(keys), "look": seen._asdict()}
    with suppress(OSError):  # a folder that may only be read, or a full disk: then it is looked at again
        json_files.write_json(_place(url, out), value)
    return seen


def _span(opened: OpenedMission) -> tuple[str, str]:
    found = span(opened.frames)
    if found is None:
        return "", ""
    start, end = (f"{time.astype('datetime64[s]')}Z" for time in found)
    return start, end
