"""The main job: a mission folder to maps. Images, then pairs, then poses, then map tiles, then the products."""

import itertools
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
from dask.delayed import Delayed, delayed

from ..catalog import leases, memory, records
from ..catalog.filesystems import Folder, absolute, is_remote
from ..catalog.mission_files import no_access
from ..catalog.mission_inputs import MISSION
from ..catalog.missions import OpenedMission
from ..catalog.records import LastRun
from ..catalog.store import Store
from ..schemas.cluster import Cluster
from ..schemas.parameters import Parameters
from ..schemas.problems import InvalidInput, Problem
from ..schemas.products import Quality
from ..schemas.provenance import Request, Step
from ..tasks.navigation import NavigationPrior
from ..tasks.rings import rings
from . import (
    dense,
    extract,
    heap,
    layers,
    mapping,
    maps,
    maps_inputs,
    match,
    memory_need,
    meshing,
    mosaics,
    plan,
    products,
    request,
    results,
    solve,
)
from .executor import Executor, open_executor
from .footing import Footing, software
from .job import Done, Job, LostEntry, code_version, log
from .plan import Plan
from .results import Posed, Results
from .session import Ledger, Session, compute

_IMAGES_A_BATCH = 4
_PAIRS_A_BATCH = 16
_LOOP_ROUNDS = 3
_RENEW_S = 3600.0


class RunResult(NamedTuple):
    """What a run came to.

    Attributes
    ----------
    path : the version's folder. new : False when an earlier version stands for the same inputs and parameters.
    quality : every figure. steps : what was computed and what was reused; none where nothing had to be looked at.
    request : digest of what was asked for; None where an image could not be read, so that the next run looks again.
    """

    path: Folder
    new: bool
    quality: Quality
    steps: tuple[Step, ...]
    request: str | None = None


def run(
    mission_url: str,
    out: str | Path,
    parameters: Parameters,
    scheduler: str | None = None,
    workers: int | None = None,
    cluster: Cluster | None = None,
    *,
    leased: bool = False,
) -> RunResult:
    """Process a mission into OUT/<mission id>/vN.

    If the newest version is what would be made, nothing is done. Results of steps are kept in OUT/<mission id>/steps
    under their digests, so a run that was stopped goes on, and other parameters compute only what depends on them.

    Parameters
    ----------
    mission_url, out : folders, or URLs that fsspec reads and writes.
    scheduler, workers, cluster : where it runs; see `executor.open_executor`.
    leased : the caller holds the mission's lease; else one is taken, beside others that run, so that nobody prunes.

    Raises
    ------
    InvalidInput
        With everything that is wrong with the mission, OUT or the cluster.
    NothingToMap
        If no image gave a sounding or a match.
    """
    out, mission_url = absolute(out), absolute(mission_url)
    _refuse(out, mission_url)
    started = time.monotonic()
    with _reaching(out):
        known = memory.recall(mission_url, out)
    opened = memory.open_known(mission_url, out, known)
    mission_id = opened.mission.id
    log.info("mission=%s step=%s images=%d", mission_id, "open", opened.frames.sizes["image"])
    for image, status in zip(*(opened.frames[of].values.tolist() for of in ("image", "status")), strict=True):
        if status:
            log.warning("mission=%s step=%s image=%s %s", mission_id, "open", image, status)
    asked = request.ask(memory.inputs_digest(opened), parameters, CODE)
    with _reaching(out):
        newest = request.standing(out, mission_id, asked)
    if newest is not None:
        quality = Quality.model_validate_json((newest.path / "quality.json").read_text(encoding="utf-8"))
        return RunResult(newest.path, False, quality, ())
    store = Store(f"{out}/{mission_id}/steps")
    with (
        nullcontext() if leased else _lease(out, mission_id),
        _footing(store, opened, out) as footing,
        open_executor(scheduler, workers, cluster) as executor,
    ):
        job = Job(mission_url, mission_id, store, opened.calibration, parameters, footing)
        executor.check(job)
        result = _until_whole(job, opened, executor, asked, out)
    ended, seconds = datetime.now(UTC).isoformat(timespec="seconds"), round(time.monotonic() - started, 1)
    last = LastRun("done", result.request, int(result.path.name[1:]), ended, seconds)
    records.write_last_run(out, mission_id, last)
    return result


def _refuse(out: str, mission_url: str) -> None:
    """Refuse an OUT that cannot hold products."""
    if not is_remote(out) and Path(out).exists() and not Path(out).is_dir():
        remedy = "Give -o a folder, which need not exist."
        raise InvalidInput([Problem(out, None, "", "a file", "a folder", remedy)])
    if f"{out.rstrip('/')}/".startswith(f"{mission_url.rstrip('/')}/"):
        remedy = "Give -o a folder beside the mission; missions are never written to."
        raise InvalidInput([Problem(out, None, "", "a folder of the mission itself", "another folder", remedy)])


def _until_whole(job: Job, opened: OpenedMission, executor: Executor, asked: Request, out: str) -> RunResult:
    """Go over the steps, again where a stored result turns out to be damaged, which makes it anew."""
    made, lost = plan.plan(opened, job.parameters), set()
    typical = float(np.median(made.range_m))
    rings(job.parameters.terrain, memory_need.planned_cell_m(opened.calibration.camera, job.parameters, typical))
    found = memory_need.needs(
        opened.calibration.camera, job.parameters, len(made.images), typical, int(opened.frames["size"].max())
    )
    memory_need.refuse_what_cannot_fit(found, executor.memory_bytes())
    while True:
        try:
            return _process(Session(job, opened, made, executor, Ledger(), uuid4().hex[:8]), asked, out)
        except LostEntry as error:
            if str(error) in lost:  # made anew and damaged again: the disk is to blame
                raise
            lost.add(str(error))
            log.warning("mission=%s step=%s %s", job.mission_id, "repair", error)


def _process(state: Session, asked: Request, out: str) -> RunResult:
    posed = poses(state)
    mapped = mapping.map_tiles(state, posed)
    steps = state.ledger.steps(_VERSIONS)
    remembered = asked if all(done.key for done in posed.extracted.values()) else None
    made = Results(state.job, state.opened, state.plan, out, steps, posed, mapped, remembered)
    path, new, quality = products.write(made)
    return RunResult(path, new, quality, steps, remembered.digest if remembered else None)


def _lease(out: str, mission_id: str) -> leases.Lease:
    with _reaching(out):
        return leases.take(out, mission_id, shared=True)


@contextmanager
def _footing(store: Store, opened: OpenedMission, out: str) -> Iterator[Footing]:
    """The run's mark in the store, by which workers tell that they see it; leftovers of dead runs are removed."""
    with _reaching(out):
        store.clean()
        mark = store.mark()
    ended = threading.Event()
    renewing = threading.Thread(target=_renew, args=(store, mark, ended), daemon=True)
    renewing.start()
    try:
        yield Footing(software(), opened.input_digests[MISSION], mark)
    finally:
        ended.set()
        renewing.join()
        with suppress(OSError):
            store.unmark(mark)


def _renew(store: Store, mark: str, ended: threading.Event) -> None:
    """Other runs take a mark that is a day old for that of a dead run."""
    while not ended.wait(_RENEW_S):
        with suppress(OSError):
            store.mark(mark)


@contextmanager
def _reaching(out: str) -> Iterator[None]:
    try:
        yield
    except (PermissionError, FileNotFoundError) as error:
        raise InvalidInput([no_access(out, error, "a folder that can be written")]) from error


_VERSIONS = {
    extract.STEP: extract.VERSION,
    match.STEP: match.VERSION,
    solve.STEP: solve.VERSION,
    **dense.VERSIONS,
    **maps.VERSIONS,
    **layers.VERSIONS,
    **mosaics.VERSIONS,
    **meshing.VERSIONS,
}
DECIDING = (sys.modules[__name__], plan, mapping, maps_inputs, results)
# all that decides what a request comes to
CODE = {
    **_VERSIONS,
    "products": products.VERSION,
    "opening": request.OPENING,
    "workflow": code_version(*DECIDING),
}


def poses(state: Session) -> Posed:
    """One graph over batches of images, then pairs, then the adjustment; then what that shows to overlap besides."""
    job, made = state.job, state.plan
    for step in (extract.STEP, match.STEP, solve.STEP):
        state.ledger.begin(step)
    wanted = plan.first_pairs(made, state.opened, job.parameters)
    extracts = [
        delayed(extract.extract_batch)(job, batch, dask_key_name=state.key("extract", k))
        for k, batch in enumerate(plan.batches(made.images, _IMAGES_A_BATCH))
    ]
    batch_of = {image.row: k // _IMAGES_A_BATCH for k, image in enumerate(made.images)}
    matches = _match_tasks(state, wanted, made.prior, extracts, batch_of, "match")
    last = _adjust_task(state, matches, extracts, "adjust")
    *parts, adjusted = compute(state, "poses", [*extracts, *matches, last])
    extracted = _by_row(made, parts[: len(extracts)])
    for image in made.images:
        if status := extracted[image.row].info["status"]:
            log.warning("mission=%s step=%s image=%s %s", job.mission_id, extract.STEP, image.path, status)
    matched = [pair for part in parts[len(extracts) :] for pair in part]
    adjustments = [adjusted]
    matched = _close_loops(state, parts[: len(extracts)], matched, adjustments, batch_of)
    state.ledger.end(extract.STEP, list(extracted.values()))
    state.ledger.end(match.STEP, [done for _, _, done in matched])
    state.ledger.end(solve.STEP, adjustments)
    return Posed(extracted, matched, adjustments[-1], _solution(job, adjustments[-1]))


def _close_loops(
    state: Session,
    extracts: Sequence[list[Done]],
    matched: list[tuple[int, int, Done]],
    adjustments: list[Done],
    batch_of: dict[int, int],
) -> list[tuple[int, int, Done]]:
    """Match what overlaps by the poses so far and adjust again, until nothing new overlaps.

    With navigation that is nothing, unless the poses contradict it, and then once, and adjusted only if that tells
    anything new. All matches; the adjustments are added to those given.
    """
    job, made = state.job, state.plan
    extracted = _by_row(made, extracts)
    ranges = mapping.heights(state, extracted, matched, _solution(job, adjustments[-1]))
    more = plan.chained_pairs if made.prior is None else plan.misplaced_pairs
    known = [(i, j) for i, j, done in matched if made.prior is None or done.info["model"]]
    for turn in range(_LOOP_ROUNDS if made.prior is None else 1):
        poses, turned = _solution(job, adjustments[-1]).poses, _solution(job, adjustments[-1]).turned.tolist()
        wanted = more(made, state.opened, job.parameters, poses, ranges, known)
        if not wanted:
            break
        if made.prior is not None:  # matched by the adjusted poses
            wanted = [pair._replace(turned=(turned[pair.i], turned[pair.j])) for pair in wanted]
        tasks = _match_tasks(state, wanted, plan.adjusted_prior(made, poses), extracts, batch_of, f"match-{turn}")
        again = [pair for part in compute(state, "loops", tasks) for pair in part]
        tried = {(i, j) for i, j, _ in again}
        known += tried
        matched = [pair for pair in matched if pair[:2] not in tried] + again
        linked = sum(bool(done.info["model"]) for _, _, done in again)
        log.info("mission=%s step=%s later_pairs=%d linked=%d", job.mission_id, match.STEP, len(again), linked)
        if made.prior is not None:
            typical = float(np.median(ranges))
            if not solve.would_change(job, adjustments[-1], again, made.prior, typical):
                break
        pairs = delayed(matched, name=state.key(f"matched-{turn}"), traverse=False)
        images = delayed(list(extracts), name=state.key(f"extracted-{turn}"), traverse=False)
        adjustments += compute(state, "adjust", [_adjust_task(state, [pairs], images, f"adjust-{turn}")])
    return matched


def _match_tasks(
    state: Session,
    wanted: Sequence[match.Wanted],
    prior: NavigationPrior | None,
    extracts: Sequence[Any],
    batch_of: dict[int, int],
    name: str,
) -> list[Delayed]:
    tasks = []
    shared = delayed(prior, name=state.key(f"{name}-prior"), traverse=False)  # once, and not with every task
    for k, batch in enumerate(plan.batches(wanted, _PAIRS_A_BATCH)):
        rows = {row for pair in batch for row in pair.rows if row in batch_of}
        needed = sorted({batch_of[row] for row in rows})
        first_rows = [
            [i.row for i in state.plan.images[n * _IMAGES_A_BATCH : (n + 1) * _IMAGES_A_BATCH]] for n in needed
        ]
        chosen = [extracts[n] for n in needed]
        given = (state.job, batch, first_rows, chosen, shared)
        tasks.append(delayed(_match_batch)(*given, dask_key_name=state.key(name, k)))
    return tasks


def _match_batch(
    job: Job,
    batch: Sequence[match.Wanted],
    rows: list[list[int]],
    extracted: list[list[Done]],
    prior: NavigationPrior | None,
) -> list[tuple[int, int, Done]]:
    by_row = {
        row: done
        for row_list, part in zip(rows, extracted, strict=True)
        for row, done in zip(row_list, part, strict=True)
    }
    return match.match_batch(job, batch, by_row, prior)


def _adjust_task(state: Session, matches: list[Any], extracts: Any, name: str) -> Delayed:
    count, made = state.opened.frames.sizes["image"], state.plan
    rows = [image.row for image in made.images]
    given = (count, rows, matches, extracts, made.prior, made.R_first)
    return delayed(_adjust)(state.job, *given, dask_key_name=state.key(name))


def _adjust(
    job: Job, count: int, rows: list[int], matched: list, extracted: list, prior: Any, R_first: np.ndarray
) -> Done:
    by_row = dict(zip(rows, itertools.chain.from_iterable(extracted), strict=True))
    heap.give_back()
    try:
        return solve.adjust_all(job, count, list(itertools.chain.from_iterable(matched)), by_row, prior, R_first)
    finally:
        heap.give_back()


def _solution(job: Job, done: Done) -> solve.Solution:
    return solve.solution(job, done.key)


def _by_row(made: Plan, parts: Sequence[list[Done]]) -> dict[int, Done]:
    done = [one for part in parts for one in part]
    return {image.row: one for image, one in zip(made.images, done, strict=True)}
