"""What a run asks for, known before anything is computed, and whether the newest version is just that."""

from collections.abc import Mapping
from typing import Any

from ..catalog import (
    coordinate_systems,
    digests,
    frames_table,
    image_times,
    interpolation,
    json_files,
    memory,
    mission_files,
    mission_inputs,
    missions,
    records,
    tiff_directory,
    versions,
)
from ..catalog.store import digest
from ..catalog.versions import Version
from ..schemas import csv_input, mission, navigation, timestamps, yaml_document, yaml_input
from ..schemas.parameters import Parameters
from ..schemas.provenance import Request
from .job import code_version

# what decides how a mission's files are read
DECIDING = (
    *(coordinate_systems, digests, frames_table, image_times, interpolation, memory, mission_files, mission_inputs),
    *(missions, tiff_directory, csv_input, mission, navigation, timestamps, yaml_document, yaml_input),
)
OPENING = code_version(*DECIDING)


def ask(inputs: str, parameters: Parameters, code: Mapping[str, str]) -> Request:
    """The request of a run.

    Parameters
    ----------
    inputs : digest of the mission's files, as `memory.inputs_digest` gives it.
    code : versions of all parts of the software that decide the products, by name.
    """
    given = parameters.model_dump(mode="json")
    whole = digest("run", "1", [inputs], [given, dict(code)])
    return Request(digest=whole, inputs=inputs, parameters=given, code=dict(code))


def provenance(version: Version) -> dict[str, Any]:
    """provenance.json of a version; empty if it cannot be read."""
    found = json_files.read_json(f"{version.path}/{versions.PROVENANCE}")
    return found if isinstance(found, dict) else {}


def standing(out: str, mission_id: str, request: Request) -> Version | None:
    """The newest version, if it is what the request would make.

    Either it was made on this very request, or the last run came to it on this request: software may change
    without changing what a mission comes to.
    """
    newest = versions.newest_version(out, mission_id)
    if newest is None:
        return None
    last = records.read_last_run(out, mission_id)
    if last is not None and last.outcome == "done" and (last.version, last.request) == (newest.number, request.digest):
        return newest
    made = provenance(newest).get("request") or {}
    return newest if made.get("digest") == request.digest else None
