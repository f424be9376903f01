"""What stands in an archive: every mission, its newest version, whether it is what would be made now, and why not."""

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any, Final, NamedTuple

from ..catalog import archives, json_files, leases, memory, records, versions
from ..catalog.archives import OpenedArchive
from ..catalog.memory import Look
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput
from ..schemas.provenance import Request
from . import request
from .job import log
from .run import CODE

NEW, STALE, CURRENT, RUNNING = "new", "stale", "current", "running"
FAILED, INVALID, LEFT_OUT = "failed", "invalid", "left out"
TO_DO: Final = (NEW, STALE, FAILED)
_SHOWN: Final = 4


class MissionState(NamedTuple):
    """A mission of an archive.

    Attributes
    ----------
    url : its folder. id : empty if mission.yaml cannot be read. look : None if it is invalid.
    state : new, stale, current, running, failed, invalid or left out. why : in words; empty where there is nothing
        to say. would : what the next run does. version : number of the newest, 0 without.
    figures : of the newest version: the names of `expressions.VERSION_NAMES` that it has.
    parameters : that the mission would be run with. request : digest of what would be asked for; None if images
        have to be read first.
    """

    url: str
    id: str
    look: Look | None
    state: str
    why: str
    would: str
    version: int = 0
    figures: Mapping[str, Any] = {}
    parameters: Parameters | None = None
    request: str | None = None

    @property
    def row(self) -> dict[str, Any]:
        """Values by name, for expressions."""
        return {**(_row(self.look) if self.look else {}), **self.figures}


def assess_all(archive: OpenedArchive) -> list[MissionState]:
    """Every mission of an archive; two with one id are both invalid, as they would share their versions."""
    states = [assess(archive, url) for url in archive.missions]
    places: dict[str, list[str]] = {}
    for state in states:
        if state.id:
            places.setdefault(state.id, []).append(state.url)
    return [_unless_twice(state, places.get(state.id, [])) for state in states]


def _unless_twice(state: MissionState, places: list[str]) -> MissionState:
    others = [url for url in places if url != state.url]
    if not others:
        return state
    why = f"its id, {state.id}, is that of {others[0]} too; give each mission.yaml an id of its own"
    return state._replace(state=INVALID, why=why, would="nothing", look=None)


def assess(archive: OpenedArchive, url: str, ours: bool = False) -> MissionState:
    """One mission, without reading images that were read before and without computing anything.

    Parameters
    ----------
    ours : its lease is held by us, so that nobody else is asked for.
    """
    try:
        look = memory.look(url, archive.products)
    except InvalidInput as error:
        return _invalid(url, "", None, error)
    except Exception as error:  # an object store that does not answer for this one; the others are not to suffer
        log.debug("mission=%s step=%s failed", url, "look", exc_info=True)
        return MissionState(url, "", None, INVALID, f"it cannot be read: {error or type(error).__name__}", "nothing")
    try:
        return _assess(archive, url, look, ours)
    except OSError as error:  # its versions may not be read; the other missions are not to suffer
        return MissionState(url, look.id, look, INVALID, f"its products cannot be read: {error}", "nothing")


def _assess(archive: OpenedArchive, url: str, look: Look, ours: bool) -> MissionState:
    out = archive.products
    if not archive.selects(_row(look)):
        return MissionState(url, look.id, look, LEFT_OUT, "archive.yaml does not select it", "nothing")
    try:
        parameters = archives.parameters_of(archive, _row(look), records.read_settings(out, look.id))
    except InvalidInput as error:
        return _invalid(url, look.id, look, error)
    asked = request.ask(look.inputs, parameters, CODE) if look.inputs else None
    newest = versions.newest_version(out, look.id)
    number = newest.number if newest else 0
    made = request.provenance(newest) if newest else {}
    state, why, would = _judge(out, look, asked, parameters, number, made, ours)
    figures = dict(_figures(number, str(newest.path), made)) if newest else {}
    digest = asked.digest if asked else None
    return MissionState(url, look.id, look, state, why, would, number, figures, parameters, digest)


def _row(look: Look) -> dict[str, Any]:
    return {name: getattr(look, name) for name in ("id", "title", "platform", "start", "end", "images")}


def _invalid(url: str, mission_id: str, look: Look | None, error: InvalidInput) -> MissionState:
    more = len(error.problems) - 1
    why = f"{error.problems[0]}" + (f" (and {more} more: seamosaic check {url})" if more else "")
    return MissionState(url, mission_id, look, INVALID, why, "nothing")


def _judge(
    out: str,
    look: Look,
    asked: Request | None,
    parameters: Parameters,
    number: int,
    made: Mapping[str, Any],
    ours: bool,
) -> tuple[str, str, str]:
    """State, why, and what the next run does."""
    holder = None if ours else leases.holder(out, look.id)
    if holder is not None and holder.purpose == "run":
        return RUNNING, str(holder), "left to that run"
    if asked is not None and number and request.standing(out, look.id, asked):
        return CURRENT, "", "nothing"
    last, make = records.read_last_run(out, look.id), f"make v{number + 1}"
    if last is not None and last.outcome == "failed" and (asked is None or last.request in (None, asked.digest)):
        return FAILED, f"{last.error} ({last.ended})", f"try again to {make}"
    if not number:
        return NEW, "", make
    return STALE, "; ".join(_reasons(look, asked, parameters, made)), make


def _reasons(look: Look, asked: Request | None, parameters: Parameters, made: Mapping[str, Any]) -> Iterator[str]:
    """Why the newest version, with its provenance, is not what would be made."""
    before = made.get("request")
    if not before:
        yield "an image could not be read when it was made"
        return
    if look.inputs is None:
        yield f"{look.unread} of {look.images} images are new or were changed"
    elif look.inputs != before["inputs"]:
        yield _other_files(look, made)
    changed = [
        f"{name} {'none' if old is None else old} → {new}"
        for name, old, new in differences(before["parameters"], parameters.model_dump(mode="json"))
    ]
    if changed:
        yield _some(changed)
    if asked is not None and asked.code != before["code"]:
        yield f"other software: {_some(sorted(name for name, _, _ in differences(before['code'], asked.code)))}"


def _other_files(look: Look, made: Mapping[str, Any]) -> str:
    read = made.get("inputs", {})
    texts = [name for name, sha in look.texts.items() if read.get(name, {}).get("sha256") != sha]
    if texts:
        return f"{_some(texts)} changed"
    count = len(read) - sum(name in read for name in look.texts)
    return "images changed" if count == look.images else f"{look.images} images instead of {count}"


def _some(words: list[str]) -> str:
    more = len(words) - _SHOWN
    return ", ".join(words[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def differences(old: Mapping[str, Any], new: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted name, old and new value of everything in which two mappings differ; None where one has nothing."""
    for name in (*old, *(name for name in new if name not in old)):
        a, b, dotted = old.get(name), new.get(name), f"{above}{name}"
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from differences(a, b, f"{dotted}.")
        elif a != b:
            yield dotted, a, b


def _figures(number: int, path: str, made: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Key figures of a version; those that it does not have are left out."""
    quality: Any = json_files.read_json(f"{path}/quality.json") or {}
    trajectory, bathymetry = (quality.get(name) or {} for name in ("trajectory", "bathymetry"))
    yield "version", number
    yield "created", str(made.get("created", ""))[:19]
    if trajectory:
        yield "placed", trajectory["adjusted"] + trajectory["navigation_only"]
    for name, key in (("cells",) * 2, ("cell_m",) * 2, ("area_m2",) * 2, ("sigma_m", "sigma_median_m")):
        if bathymetry.get(key) is not None:
            yield name, bathymetry[key]
    steps = made.get("steps") or []
    yield "core_s", round(sum(step["core_seconds"] for step in steps), 1)
    times = [datetime.fromisoformat(step[key]) for step in steps for key in ("started", "ended") if step.get(key)]
    if times:
        yield "seconds", round((max(times) - min(times)).total_seconds(), 1)
    yield "warnings", len(quality.get("warnings") or ())
