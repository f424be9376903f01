"""What is written down of a mission beside its versions: how its last run ended, and parameters of its own."""

from typing import Any, Final, NamedTuple

from ..schemas.problems import InvalidInput, Problem
from . import json_files

_LAST: Final = "last-run.json"
_SETTINGS: Final = "settings.json"


class LastRun(NamedTuple):
    """How the last run of a mission ended.

    Attributes
    ----------
    outcome : done or failed. request : digest of what was asked for; None where the next run has to look again.
    version : number of the version that stands for it; None after a failure. ended : ISO 8601, UTC.
    seconds : how long it took. error : why it failed.
    """

    outcome: str
    request: str | None
    version: int | None
    ended: str
    seconds: float
    error: str = ""


def read_last_run(out: str, mission_id: str) -> LastRun | None:
    found: Any = json_files.read_json(_url(out, mission_id, _LAST))
    try:
        return LastRun(**found)
    except TypeError:
        return None


def write_last_run(out: str, mission_id: str, last: LastRun) -> None:
    json_files.write_json(_url(out, mission_id, _LAST), last._asdict())


def read_settings(out: str, mission_id: str) -> dict[str, Any]:
    """Parameters that were given to this mission alone, by dotted name.

    Raises
    ------
    InvalidInput
        If the file is there and cannot be read: defaults in their place would make another map.
    """
    url = _url(out, mission_id, _SETTINGS)
    found = json_files.read_json(url)
    if isinstance(found, dict):
        return found
    if not json_files.exists(url):
        return {}
    remedy = "Correct the file, or remove it."
    raise InvalidInput([Problem(url, None, "", "no JSON object, or no access", "parameters by dotted name", remedy)])


def write_settings(out: str, mission_id: str, settings: dict[str, Any]) -> None:
    json_files.write_json(_url(out, mission_id, _SETTINGS), settings)


def _url(out: str, mission_id: str, name: str) -> str:
    return f"{out.rstrip('/')}/{mission_id}/{name}"
