"""A cluster file: where the workers of a run come from."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .base import Model
from .problems import inconsistent

_OF_JOBS = ("queue", "account", "walltime", "interface", "setup", "directives")


class Adapt(Model):
    """A number of workers that follows the work."""

    min: Annotated[int, Field(ge=0, description="workers that are always there")] = 0
    max: Annotated[int, Field(ge=1, description="workers at most")]

    @model_validator(mode="after")
    def _in_order(self) -> "Adapt":
        if self.min > self.max:
            raise inconsistent("min", str(self.min), f"at most max, {self.max}", "Swap or correct the two.")
        return self


class Cluster(Model):
    """A cluster.yaml: processes of this machine, or jobs of Slurm or PBS, each with one worker a core."""

    kind: Annotated[Literal["local", "slurm", "pbs"], Field(description="local: processes of this machine")]
    workers: Annotated[int | None, Field(ge=1, description="worker processes in all; default: one")] = None
    adapt: Annotated[Adapt | None, Field(description="instead of workers: as many as the work needs")] = None
    cores: Annotated[int, Field(ge=1, description="of a job: as many workers, each with its share of memory")] = 1
    memory: Annotated[
        str | None, Field(pattern=r"^[0-9.]+ ?[kMGT]i?B$", description="of a job, or of a local worker: 16 GiB")
    ] = None
    queue: Annotated[str | None, Field(description="queue or partition")] = None
    account: Annotated[str | None, Field(description="account or project that pays")] = None
    walltime: Annotated[
        str | None, Field(pattern=r"^([0-9]+-)?[0-9]+:[0-9]{2}:[0-9]{2}$", description="of a job: '02:00:00'")
    ] = None
    interface: Annotated[str | None, Field(description="network that workers and scheduler talk over: ib0")] = None
    setup: Annotated[tuple[str, ...], Field(description="shell lines of a job before its workers start")] = ()
    directives: Annotated[tuple[str, ...], Field(description="more options of a job: '--gres=scratch:50G'")] = ()
    scratch: Annotated[str | None, Field(description="folder of a node for what workers put aside")] = None

    @model_validator(mode="after")
    def _complete(self) -> "Cluster":
        if self.workers is not None and self.adapt is not None:
            raise inconsistent("workers", "workers and adapt", "one of the two", "Remove one of them.")
        if self.kind != "local" and self.memory is None:
            raise inconsistent("memory", "nothing", "the memory of a job, such as '16 GiB'", "Add the key memory.")
        if self.kind == "local":
            for name in _OF_JOBS:
                if getattr(self, name):
                    raise inconsistent(name, "a value", "none for kind: local", "Remove it, or correct kind.")
            if self.cores != 1:
                raise inconsistent("cores", str(self.cores), "none for kind: local", "Write workers instead.")
        return self
