"""Other parameters for missions of an archive, for good."""

from collections.abc import Sequence
from typing import Any

from ..catalog import archives, records
from ..catalog.archives import open_archive
from ..schemas.problems import InvalidInput, Problem
from .archive_states import MissionState, differences


def change_parameters(url: str, states: Sequence[MissionState], given: Sequence[str], dry_run: bool) -> dict[str, str]:
    """Write down parameters of the missions' own; they hold from now on, for scheduled runs too.

    Nothing is written unless all of them are valid.

    Returns
    -------
    dict
        What changes, in words, by mission id.

    Raises
    ------
    InvalidInput
        If one is not `key=value`, unknown, or out of bounds.
    """
    archive, new = open_archive(url), dict(_split(one) for one in given)
    merged, words = {}, {}
    for state in states:
        before = records.read_settings(archive.products, state.id)
        merged[state.id] = {**before, **new}
        old, after = (archives.parameters_of(archive, state.row, some) for some in (before, merged[state.id]))
        changes = differences(old.model_dump(mode="json"), after.model_dump(mode="json"))
        words[state.id] = ", ".join(f"{name} {a} → {b}" for name, a, b in changes) or "nothing changes"
    if not dry_run:
        for mission_id, settings in merged.items():
            records.write_settings(archive.products, mission_id, settings)
    return words


def _split(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        remedy = "Write it as --set grid.cell_m=0.05, without spaces around the equals sign."
        raise InvalidInput([Problem("--set", None, "", repr(text), "key=value", remedy)])
    return key.strip(), value
