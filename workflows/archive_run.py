"""Processes what is new or stale in an archive: each mission once, whoever else is at it, and each on its own.

A mission is processed in a process of its own, so that whatever befalls it leaves the others alone; this process
keeps the leases. If it is killed, its children end, and the leases lapse.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from multiprocessing.connection import Connection, wait
from typing import Any, Final, NamedTuple

from ..catalog import leases, pruning, records, stac
from ..catalog.archives import OpenedArchive
from ..catalog.pruning import Pruned
from ..catalog.records import LastRun
from ..schemas.cluster import Cluster
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput
from . import archive_states
from .archive_states import CURRENT, FAILED, INVALID, RUNNING, TO_DO, MissionState
from .job import log
from .progress import log_to_stderr

MADE: Final = "made"
_WAIT_S: Final = 1.0
_PATIENCE_S: Final = 30.0  # for a process that is to end, and its cluster with it
_GIGABYTE: Final = 1e9
# Forked from a process that has imported all there is to import: spawning takes seconds for each mission
_METHOD: Final = "forkserver" if sys.platform == "linux" else "spawn"


class Options(NamedTuple):
    """How missions are processed: as for `run.run`, and how the log is written, as for `progress.log_to_stderr`."""

    scheduler: str | None = None
    workers: int | None = None
    cluster: Cluster | None = None
    verbose: bool = False
    log_json: bool = False
    bars: bool = False


class Outcome(NamedTuple):
    """What became of a mission.

    Attributes
    ----------
    outcome : made, current, failed, invalid, running (elsewhere) or left out. why : in words.
    version : number of the newest. computed, reused : results of steps. seconds : that it took.
    """

    id: str
    url: str
    outcome: str
    why: str = ""
    version: int = 0
    computed: int = 0
    reused: int = 0
    seconds: float = 0.0


class Summary(NamedTuple):
    """A run over an archive. pruned : None where no limit is set."""

    archive: str
    started: str
    ended: str
    missions: tuple[Outcome, ...]
    pruned: Pruned | None

    @property
    def failed(self) -> bool:
        return any(one.outcome in (FAILED, INVALID) for one in self.missions)


def run_archive(
    archive: OpenedArchive, options: Options, wanted: Callable[[MissionState], bool] = lambda state: True
) -> Summary:
    """Process every mission that is new, stale or failed before, some at a time.

    Parameters
    ----------
    wanted : missions to look at; the others are left out.
    """
    started = _now()
    states = archive_states.assess_all(archive)
    todo = [state for state in states if state.state in TO_DO and wanted(state)]
    settled = [_settled(archive, state) for state in states if state not in todo and wanted(state)]
    log.info("archive=%s step=%s missions=%d to_do=%d", archive.url, "status", len(states), len(todo))
    made = _process_all(archive, todo, options)
    limit, pruned = archive.config.keep_gb, None
    if limit is not None:
        pruned = _prune(archive, limit * _GIGABYTE)
    _publish_all(archive)
    order = {url: number for number, url in enumerate(archive.missions)}
    outcomes = tuple(sorted([*settled, *made], key=lambda one: order[one.url]))
    return Summary(archive.url, started, _now(), outcomes, pruned)


def _prune(archive: OpenedArchive, keep_bytes: float) -> Pruned | None:
    """Missions are made by now, whatever cannot be freed."""
    try:
        pruned = pruning.prune(archive.products, keep_bytes, term_s=archive.config.lease_s)
    except OSError as error:
        log.warning("archive=%s step=%s intermediate results were not freed: %s", archive.url, "prune", error)
        return None
    for why in pruned.failed:
        log.warning("archive=%s step=%s not freed: %s", archive.url, "prune", why)
    return pruned


def _publish_all(archive: OpenedArchive) -> None:
    """The catalogue once more as a whole: without missions that are gone, and with those of runs at the same time."""
    try:
        stac.update_catalog(archive.products, archive.config.title)
    except OSError as error:
        log.warning("archive=%s step=%s the catalogue was not written: %s", archive.url, "catalogue", error)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _settled(archive: OpenedArchive, state: MissionState) -> Outcome:
    """A mission that there is nothing to do for, but that a run may have ended before it was in the catalogue."""
    try:
        if state.state == CURRENT and stac.latest(archive.products, state.id) != state.version:
            _publish(archive, state)
    except OSError as error:
        return _failed(state, f"the catalogue could not be written: {error}")
    return Outcome(state.id, state.url, state.state, state.why, state.version)


def _publish(archive: OpenedArchive, state: MissionState) -> None:
    assert state.look is not None
    look = state.look
    entry = stac.MissionEntry(look.id, look.title, look.platform, look.start, look.end)
    stac.update_mission(archive.products, entry, archive.config.title)


class _Child:
    """A mission being processed. held : what is given back when it ends."""

    def __init__(self, archive: OpenedArchive, state: MissionState, options: Options, lease: leases.Lease):
        assert state.parameters is not None
        context = multiprocessing.get_context(_METHOD)
        self.state, self.lease, self.held, self._archive = state, lease, ExitStack(), archive
        self._started = time.monotonic()
        self._answers, sender = context.Pipe(duplex=False)
        given = (sender, state.url, archive.products, state.parameters, options, dict(os.environ))
        self.process = context.Process(target=_work, args=given, name=state.id)  # type: ignore[attr-defined]
        try:
            self.process.start()
        except BaseException:  # a signal, as starting the first takes seconds
            if self.process.pid is not None:
                self.process.terminate()
            raise
        sender.close()

    def stop(self) -> None:
        self.process.terminate()
        self._end()
        self.held.close()

    def _end(self) -> None:
        self.process.join(_PATIENCE_S)
        self.process.kill()
        self.process.join()

    def outcome(self) -> Outcome:
        """What became of it, once its process has ended or is about to; written down and published."""
        self._end()
        seconds = round(time.monotonic() - self._started, 1)
        try:
            answer = self._answers.recv()
        except EOFError:
            answer = (FAILED, _fate(self.process.exitcode))
        self._answers.close()
        if self.lease.lost.is_set() and answer[0] != "done":
            answer = (FAILED, self.lease.why)
        with self.held:
            try:
                return self._settle(answer, seconds)
            except OSError as error:
                return _failed(self.state, f"what became of it could not be written: {error}", seconds)

    def _settle(self, answer: Sequence[Any], seconds: float) -> Outcome:
        state, out = self.state, self._archive.products
        if answer[0] != "done":
            outcome, why = answer
            asked = archive_states.assess(self._archive, state.url, ours=True).request
            records.write_last_run(out, state.id, LastRun("failed", asked, None, _now(), seconds, why))
            return _failed(state, why, seconds, outcome)
        _, number, new, computed, reused = answer
        _publish(self._archive, state)
        why = "" if new else "nothing changed"
        done = MADE if new else CURRENT
        log.info("mission=%s step=%s version=%d computed=%d reused=%d", state.id, done, number, computed, reused)
        return Outcome(state.id, state.url, done, why, number, computed, reused, seconds)


def _failed(state: MissionState, why: str, seconds: float = 0.0, outcome: str = FAILED) -> Outcome:
    log.error("mission=%s step=%s %s", state.id, outcome, why)
    return Outcome(state.id, state.url, outcome, why, state.version, seconds=seconds)


def _fate(code: int | None) -> str:
    if code is not None and code < 0:
        hint = "; out of memory is the usual reason" if -code == signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{hint}"
    return f"its process ended with code {code}"


def _process_all(archive: OpenedArchive, todo: Iterable[MissionState], options: Options) -> list[Outcome]:
    queue, children, outcomes = list(todo), list[_Child](), list[Outcome]()
    if _METHOD == "forkserver" and queue:
        multiprocessing.set_forkserver_preload([f"{__package__}.run"])
    try:
        while queue or children:
            while queue and len(children) < archive.config.concurrency:
                begun = _begin(archive, queue.pop(0), options)
                (children if isinstance(begun, _Child) else outcomes).append(begun)  # type: ignore[arg-type]
            wait([child.process.sentinel for child in children], timeout=_WAIT_S)
            for child in [one for one in children if not one.process.is_alive() or one.lease.lost.is_set()]:
                child.process.terminate()  # if it is alive, it has lost its lease
                children.remove(child)
                outcomes.append(child.outcome())
    finally:
        for child in children:
            child.stop()
    return outcomes


def _begin(archive: OpenedArchive, state: MissionState, options: Options) -> _Child | Outcome:
    """Start a mission, unless somebody else is at it or has just done it."""
    with ExitStack() as held:
        try:
            lease = held.enter_context(leases.take(archive.products, state.id, term_s=archive.config.lease_s))
        except leases.Busy as busy:
            return Outcome(state.id, state.url, RUNNING, str(busy), state.version)
        except OSError as error:
            return _failed(state, f"no lease could be taken: {error}")
        now = archive_states.assess(archive, state.url, ours=True)
        if now.id and now.id != state.id:  # under another lease; and its twins were not looked for
            return _failed(state, f"its id has become {now.id} meanwhile; the next run takes it")
        if now.state not in TO_DO:
            return _settled(archive, now)
        child = _Child(archive, now, options, lease)
        child.held = held.pop_all()  # only now: whatever happens before gives the lease back
        return child


def _work(
    answers: Connection, url: str, products: str, parameters: Parameters, options: Options, environment: dict[str, str]
) -> None:
    """Process one mission; the answer is ("done", version, new, computed, reused) or (failed or invalid, why)."""
    os.environ.update(environment)  # the server that forks has that of its start
    from . import run as runner

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # a cluster is taken down on the way
    threading.Thread(target=_end_with_parent, daemon=True).start()
    log_to_stderr(options.verbose, options.log_json, options.bars)
    try:
        where = options.scheduler, options.workers, options.cluster
        result = runner.run(url, products, parameters, *where, leased=True)
        computed = sum(step.count_computed for step in result.steps)
        reused = sum(step.count_reused for step in result.steps)
        answers.send(("done", int(result.path.name[1:]), result.new, computed, reused))
    except InvalidInput as error:
        answers.send((INVALID, "; ".join(map(str, error.problems[:3]))))
    except KeyboardInterrupt:
        answers.send((FAILED, "it was stopped"))
    except Exception as error:
        log.debug("failed", exc_info=True)
        answers.send((FAILED, f"{error or type(error).__name__}"))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_PATIENCE_S)  # for what is being written: until then another run may have begun
        os._exit(1)
