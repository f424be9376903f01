"""metadata/provenance.json: what a version was made from, by what, and how."""

from datetime import datetime
from typing import Annotated, Any

from pydantic import Field

from .base import Model

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class InputFile(Model):
    """A file of the mission, as it was read."""

    sha256: Sha256
    size: Annotated[int, Field(ge=0, description="bytes")]


class Step(Model):
    """One stage of the workflow: what was computed now and what was taken from an earlier run."""

    name: str
    code_version: str
    count_total: Annotated[int, Field(ge=0)]
    count_computed: Annotated[int, Field(ge=0)]
    count_reused: Annotated[int, Field(ge=0)]
    core_seconds: Annotated[float, Field(ge=0, description="processor time of what was computed")]
    started: datetime | None = None
    ended: datetime | None = None


class Host(Model):
    """The kind of machine; nothing that tells which one."""

    platform: str
    cpu_count: Annotated[int, Field(ge=1)]


class Request(Model):
    """What was asked for, as it is known before anything is computed.

    A run that asks for the same as the newest version did has nothing to do.
    """

    digest: Sha256
    inputs: Annotated[Sha256, Field(description="of every file of the mission that counts, in its place and role")]
    parameters: Annotated[dict[str, Any], Field(description="as they were given, automatic values not resolved")]
    code: Annotated[dict[str, str], Field(description="part of the software to the version of its code")]


class Provenance(Model):
    """A provenance.json.

    `digest` stands for everything that determines the products (inputs, parameters, code versions): a run
    that comes to the same digest as the newest version makes no new one.
    """

    format: int = 1
    digest: Annotated[str, Field(min_length=1)]
    mission_id: str
    created: datetime
    software: Annotated[dict[str, str], Field(description="name to version")]
    host: Host
    inputs: Annotated[dict[str, InputFile], Field(description="path relative to the mission folder")]
    parameters: Annotated[dict[str, Any], Field(description="every parameter, defaults and automatic values resolved")]
    steps: tuple[Step, ...] = ()
    request: Annotated[
        Request | None, Field(description="absent where an image could not be read just then: the next run looks again")
    ] = None
    parts: Annotated[
        dict[str, Sha256], Field(description="group of files to what it was made from; the next version may share it")
    ] = Field(default_factory=dict)
    outputs: dict[str, Sha256] = Field(default_factory=dict, description="path in the version's folder to SHA-256")
