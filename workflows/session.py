"""What the stages of a run share: the job, the executor, and the ledger of what was computed and what was reused."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from dask.delayed import Delayed

from ..catalog.missions import OpenedMission
from ..schemas.provenance import Step
from .executor import Executor
from .job import Done, Job
from .plan import Plan
from .progress import progress


class Ledger:
    """Counts what each step computed and reused, for provenance and for the summary."""

    def __init__(self) -> None:
        self._steps: dict[str, dict[str, Any]] = {}

    def begin(self, step: str) -> None:
        self._steps.setdefault(step, {"done": [], "started": datetime.now(UTC)})

    def end(self, step: str, done: Sequence[Done]) -> None:
        self._steps[step]["done"] += done
        self._steps[step]["ended"] = datetime.now(UTC)

    def steps(self, versions: dict[str, str]) -> tuple[Step, ...]:
        return tuple(
            Step(
                name=name,
                code_version=versions[name],
                count_total=len(made["done"]),
                count_computed=sum(done.computed for done in made["done"]),
                count_reused=sum(not done.computed for done in made["done"]),
                core_seconds=round(sum(done.seconds for done in made["done"] if done.computed), 3),
                started=made["started"],
                ended=made["ended"],
            )
            for name, made in self._steps.items()
        )


class Session(NamedTuple):
    """A run under way; its token is in the names of its tasks, so that runs on one cluster do not share them."""

    job: Job
    opened: OpenedMission
    plan: Plan
    executor: Executor
    ledger: Ledger
    token: str = ""

    def key(self, name: str, number: int = 0) -> str:
        """The name of a task for Dask, which computes it in this order."""
        return f"{name}-{self.token}-{number:06d}"


def compute(state: Session, step: str, tasks: Sequence[Delayed]) -> list[Any]:
    with progress(state.job.mission_id, step, len(tasks)) as advance:
        return state.executor.compute(tasks, advance)
