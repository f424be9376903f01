"""The main job: a mission folder to maps. Images, then pairs, then poses, then map tiles, then the products."""

import json
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dask.delayed import Delayed, delayed

from ..catalog.missions import OpenedMission, open_mission
from ..catalog.store import Store
from ..schemas.parameters import Parameters
from ..schemas.products import Quality
from ..schemas.provenance import Step
from ..tasks import camera as cameras
from ..tasks import grids, pairs
from ..tasks.grids import Grid
from . import extract, maps, match, plan, products, solve
from .executor import Executor, open_executor
from .job import Done, Job, log
from .maps import Image, MapJob, Pair, Tile
from .plan import Plan
from .progress import progress
from .solve import Solution

_IMAGES_A_BATCH = 4
_PAIRS_A_BATCH = 16
_LIGHTING_IMAGES = 200
_GROWTH_TILES = 6


class NothingToMap(RuntimeError):
    """No image of the mission gave a sounding or a match."""


class RunResult(NamedTuple):
    """What a run came to.

    Attributes
    ----------
    path : the version's folder. new : False when an earlier version stands for the same inputs and parameters.
    quality : every figure. steps : what was computed and what was reused.
    """

    path: Path
    new: bool
    quality: Quality
    steps: tuple[Step, ...]


class _Ledger:
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
                core_seconds=round(sum(done.seconds for done in made["done"]), 3),
                started=made["started"],
                ended=made["ended"],
            )
            for name, made in self._steps.items()
        )


class _Run(NamedTuple):
    """The state that the stages share."""

    job: Job
    opened: OpenedMission
    plan: Plan
    executor: Executor
    ledger: _Ledger


def run(
    mission_url: str,
    out: Path,
    parameters: Parameters,
    scheduler: str | None = None,
    workers: int | None = None,
) -> RunResult:
    """Process a mission into OUT/<mission id>/vN.

    Results of steps are kept in OUT/<mission id>/steps under their digests, so a second run, or one that was
    stopped, computes only what is not there.

    Raises
    ------
    InvalidInput
        With everything that is wrong with the mission.
    NothingToMap
        If no image gave a sounding or a match.
    """
    opened = _open(mission_url, out)
    store = Store(str(Path(out).resolve() / opened.mission.id / "steps"))
    url = mission_url if "://" in mission_url else str(Path(mission_url).resolve())
    job = Job(url, opened.mission.id, store, opened.calibration, parameters)
    log.info("mission=%s step=open images=%d", opened.mission.id, opened.frames.sizes["image"])
    with open_executor(scheduler, workers) as executor:
        state = _Run(job, opened, plan.plan(opened, parameters), executor, _Ledger())
        posed = _poses(state)
        mapped = _maps(state, posed)
    steps = state.ledger.steps(_VERSIONS)
    path, new, quality = products.write(products.Results(job, opened, state.plan, Path(out), steps, posed, mapped))
    return RunResult(path, new, quality, steps)


_VERSIONS = {
    extract.STEP: extract.VERSION,
    match.STEP: match.VERSION,
    solve.STEP: solve.VERSION,
    **maps.VERSIONS,
}


def _open(mission_url: str, out: Path) -> OpenedMission:
    """Open a mission, remembering the images' digests between runs."""
    memory = Path(out) / ".image-digests.json"
    known: dict[str, Any] = {}
    with suppress(OSError, ValueError):
        known = json.loads(memory.read_text())
    before = len(known)
    opened = open_mission(mission_url, known)
    if len(known) != before:
        memory.parent.mkdir(parents=True, exist_ok=True)
        temporary = memory.with_name(f"{memory.name}.{os.getpid()}")
        temporary.write_text(json.dumps(known))
        temporary.replace(memory)
    return opened


def _compute(state: _Run, step: str, tasks: Sequence[Delayed]) -> list[Any]:
    with progress(state.job.mission_id, step, len(tasks)) as advance:
        return state.executor.compute(tasks, advance)


def _poses(state: _Run) -> products.Posed:
    """One graph over batches of images, then pairs, then the adjustment; without navigation, loops after it."""
    job, made = state.job, state.plan
    for step in (extract.STEP, match.STEP, solve.STEP):
        state.ledger.begin(step)
    wanted = plan.first_pairs(made, state.opened, job.parameters)
    extracts = [
        delayed(extract.extract_batch)(job, batch, dask_key_name=f"extract-{k}")
        for k, batch in enumerate(plan.batches(made.images, _IMAGES_A_BATCH))
    ]
    batch_of = {image.row: k // _IMAGES_A_BATCH for k, image in enumerate(made.images)}
    matches = _match_tasks(state, wanted, extracts, batch_of, "match")
    last = _adjust_task(state, matches, "adjust")
    *parts, adjusted = _compute(state, "poses", [*extracts, *matches, last])
    extracted = _by_row(made, parts[: len(extracts)])
    matched = [pair for part in parts[len(extracts) :] for pair in part]
    if made.prior is None:
        solution = solve.solution(_entry(job, adjusted))
        known = [(pair.i, pair.j) for pair in wanted]
        ranges = np.array([_range(extracted.get(k), made.range_m[k]) for k in range(len(made.range_m))])
        loops = plan.loop_pairs(made, state.opened, job.parameters, solution.poses, ranges, known)
        if loops:
            more = _match_tasks(state, loops, extracts, batch_of, "match-loops")
            found = [pair for part in _compute(state, "loops", more) for pair in part]
            matched += found
            (adjusted,) = _compute(state, "adjust", [_adjust_task(state, [matched], "adjust-loops")])
    state.ledger.end(extract.STEP, list(extracted.values()))
    state.ledger.end(match.STEP, [done for _, _, done in matched])
    state.ledger.end(solve.STEP, [adjusted])
    return products.Posed(extracted, matched, adjusted, solve.solution(_entry(job, adjusted)))


def _match_tasks(
    state: _Run, wanted: Sequence[match.PairTask], extracts: Sequence[Delayed], batch_of: dict[int, int], name: str
) -> list[Delayed]:
    tasks = []
    for k, batch in enumerate(plan.batches(wanted, _PAIRS_A_BATCH)):
        rows = {row for pair in batch for row in (pair.i, pair.j)}
        needed = sorted({batch_of[row] for row in rows})
        first_rows = [
            [i.row for i in state.plan.images[n * _IMAGES_A_BATCH : (n + 1) * _IMAGES_A_BATCH]] for n in needed
        ]
        chosen = [extracts[n] for n in needed]
        tasks.append(delayed(_match_batch)(state.job, batch, first_rows, chosen, dask_key_name=f"{name}-{k}"))
    return tasks


def _match_batch(job: Job, batch: Sequence[match.PairTask], rows: list[list[int]], extracted: list[list[Done]]):
    by_row = {
        row: done
        for row_list, part in zip(rows, extracted, strict=True)
        for row, done in zip(row_list, part, strict=True)
    }
    return match.match_batch(job, batch, by_row)


def _adjust_task(state: _Run, matches: Sequence[Any], name: str) -> Delayed:
    count = state.opened.frames.sizes["image"]
    return delayed(_adjust)(state.job, count, list(matches), state.plan.prior, state.plan.R_first, dask_key_name=name)


def _adjust(job: Job, count: int, parts: list, prior: Any, R_first: np.ndarray) -> Done:
    return solve.adjust_all(job, count, [pair for part in parts for pair in part], prior, R_first)


def _entry(job: Job, done: Done):
    from .job import load

    return load(job, done.step, done.key)


def _by_row(made: Plan, parts: Sequence[list[Done]]) -> dict[int, Done]:
    done = [one for part in parts for one in part]
    return {image.row: one for image, one in zip(made.images, done, strict=True)}


def _range(done: Done | None, fallback: float) -> float:
    value = done.info.get("range_m") if done else None
    return float(value) if value else float(fallback)


def _maps(state: _Run, posed: products.Posed) -> products.Mapped:
    """Tiles: cells, surface, mosaics."""
    job, p = state.job, state.job.parameters
    images = _images(state, posed)
    if not images:
        raise NothingToMap("no image has a pose: there is nothing to map")
    ranges = np.array([_range(posed.extracted.get(k), state.plan.range_m[k]) for k in range(len(state.plan.range_m))])
    typical = float(np.median(ranges[[image.row for image in images]]))
    gsd = cameras.ground_sample_distance(job.calibration.camera, typical)
    cell = grids.bathymetry_cell_m(gsd) if p.grid.cell_m == "auto" else float(p.grid.cell_m)
    mosaic_cell = grids.mosaic_cell_m(gsd) if p.mosaic.cell_m == "auto" else float(p.mosaic.cell_m)
    reach = max(1.0, typical / 3) if p.grid.max_interpolation_m == "auto" else float(p.grid.max_interpolation_m)
    m = MapJob(job, state.plan.frame, posed.adjusted.key, reach)
    outlines = _outlines(state, posed.solution, ranges)
    surface_tiles = _surface(state, m, posed, images, outlines, cell)
    textured = [image for image in images if image.texture]
    light = _lighting(state, textured)
    ortho, planar = _mosaics(state, m, textured, outlines, surface_tiles, mosaic_cell, light, posed)
    return products.Mapped(m, cell, mosaic_cell, surface_tiles, ortho, planar, outlines)


def _images(state: _Run, posed: products.Posed) -> list[Image]:
    """Images with a pose whose extraction went well."""
    known = posed.solution.poses.known
    return [
        Image(image.row, image.path, image.sha256, posed.extracted[image.row].key, image.role != "laser")
        for image in state.plan.images
        if known[image.row] and not posed.extracted[image.row].info["status"]
    ]


def _outlines(state: _Run, solution: Solution, ranges: np.ndarray) -> np.ndarray:
    """Footprints (n, M, 2) in map coordinates, NaN without pose."""
    poses = solution.poses
    local = pairs.footprints(state.job.calibration.camera, poses, ranges)
    shape = local.shape
    ground = np.repeat((poses.C_local[:, 2] - ranges)[:, None], shape[1], axis=1)
    points = np.dstack([local, ground]).reshape(-1, 3)
    known = np.isfinite(points).all(1)
    result = np.full((len(points), 2), np.nan)
    result[known] = state.plan.frame.map_from_local(points[known])[:, :2]
    return result.reshape(shape)


def _touching(outlines: np.ndarray, images: Sequence[Image], grid: Grid, margin_m: float) -> tuple[Image, ...]:
    west, south, east, north = grid.bounds
    low, high = np.nanmin(outlines, axis=1), np.nanmax(outlines, axis=1)
    return tuple(
        image
        for image in images
        if (low[image.row] <= (east + margin_m, north + margin_m)).all()
        and (high[image.row] >= (west - margin_m, south - margin_m)).all()
    )


def _bounds(outlines: np.ndarray, images: Sequence[Image]) -> grids.Bounds:
    points = outlines[[image.row for image in images]].reshape(-1, 2)
    (west, south), (east, north) = points.min(0), points.max(0)
    return grids.Bounds(float(west), float(south), float(east), float(north))


def _pairs_of(posed: products.Posed, rows: set[int]) -> tuple[Pair, ...]:
    keys = {(i, j): done.key for i, j, done in posed.matched}
    return tuple(
        Pair(int(i), int(j), keys[int(i), int(j)]) for i, j in posed.solution.pairs if int(i) in rows or int(j) in rows
    )


def _surface(
    state: _Run, m: MapJob, posed: products.Posed, images: Sequence[Image], outlines: np.ndarray, cell: float
) -> products.Tiles:
    """Bathymetry: cells of each tile, the law of interpolation, then the surface of each tile."""
    size = state.job.parameters.grid.tile_cells
    margin = 0.3 * float(np.nanmedian(np.nanmax(outlines, axis=1) - np.nanmin(outlines, axis=1)))
    bounds = _bounds(outlines, images)
    grid = grids.pad(grids.grid_around(bounds, cell), 2)
    steps = (maps.CELLS, maps.GROWTH, maps.SURFACE)
    for step in steps:
        state.ledger.begin(step)
    tiles = list(grids.tiles(grid, size))
    cell_tasks = []
    for k, tile in enumerate(tiles):
        touching = _touching(outlines, images, tile, margin)
        described = Tile(tile, touching, _pairs_of(posed, {image.row for image in touching}))
        cell_tasks.append(delayed(maps.cells_tile)(m, described, dask_key_name=f"cells-{k}"))
    cells: list[Done] = _compute(state, maps.CELLS, cell_tasks)
    if not any(done.info["sounded"] for done in cells):
        raise NothingToMap("no image gave a laser sounding or a match with another: there is nothing to map")
    order = sorted(range(len(tiles)), key=lambda k: -cells[k].info["sounded"])[:_GROWTH_TILES]
    sampled = [(tiles[k], cells[k]) for k in sorted(order)]
    (growth,) = _compute(state, maps.GROWTH, [delayed(maps.fit_growth)(m, sampled, dask_key_name="growth")])
    halo = maps.surface.halo_cells(m.max_interpolation_m, cell)
    surface_tasks = []
    for k, tile in enumerate(tiles):
        around = grids.pad(tile, halo)
        near = [(t, done) for t, done in zip(tiles, cells, strict=True) if grids.intersection(around, t)]
        surface_tasks.append(delayed(maps.surface_tile)(m, tile, near, growth, dask_key_name=f"surface-{k}"))
    surfaces: list[Done] = _compute(state, maps.SURFACE, surface_tasks)
    for step, done in zip(steps, (cells, [growth], surfaces), strict=True):
        state.ledger.end(step, done)
    return products.Tiles(grid, tuple(zip(tiles, surfaces, strict=True)))


def _lighting(state: _Run, images: Sequence[Image]) -> Done | None:
    if state.job.parameters.mosaic.colour == "none" or not images:
        return None
    state.ledger.begin(maps.LIGHTING)
    every = max(1, len(images) // _LIGHTING_IMAGES)
    task = delayed(maps.lighting)(state.job, list(images[::every]), dask_key_name="lighting")
    (light,) = _compute(state, maps.LIGHTING, [task])
    state.ledger.end(maps.LIGHTING, [light])
    return light


def _mosaics(
    state: _Run,
    m: MapJob,
    images: Sequence[Image],
    outlines: np.ndarray,
    ground: products.Tiles,
    cell: float,
    light: Done | None,
    posed: products.Posed,
) -> tuple[products.Tiles, products.Tiles]:
    """Orthomosaic and planar mosaic on one grid."""
    shown = images or _images(state, posed)
    grid = grids.grid_around(_bounds(outlines, shown), cell)
    steps = (maps.ORTHOMOSAIC, maps.ALIGN, maps.PLANAR)
    for step in steps:
        state.ledger.begin(step)
    align_task = delayed(maps.align_planar)(
        m, list(images), _pairs_of(posed, {image.row for image in images}), _ground(posed), dask_key_name="planar-align"
    )
    (aligned,) = _compute(state, maps.ALIGN, [align_task])
    tiles = list(grids.tiles(grid, state.job.parameters.mosaic.tile_cells))
    margin = 0.3 * float(np.nanmedian(np.nanmax(outlines, axis=1) - np.nanmin(outlines, axis=1)))
    ortho_tasks, planar_tasks = [], []
    for k, tile in enumerate(tiles):
        described = Tile(tile, _touching(outlines, images, tile, margin))
        around = grids.pad(
            grids.grid_around(tile.bounds, ground.grid.cell_m), round(m.max_interpolation_m / ground.grid.cell_m)
        )
        near = [(t, done) for t, done in ground.tiles if grids.intersection(around, t)]
        ortho_tasks.append(delayed(maps.orthomosaic_tile)(m, described, near, light, dask_key_name=f"orthomosaic-{k}"))
        planar_tasks.append(delayed(maps.planar_tile)(m, described, aligned, light, dask_key_name=f"planar-{k}"))
    done = _compute(state, "mosaics", [*ortho_tasks, *planar_tasks])
    ortho, planar = done[: len(tiles)], done[len(tiles) :]
    for step, results in zip(steps, (ortho, [aligned], planar), strict=True):
        state.ledger.end(step, results)
    return (
        products.Tiles(grid, tuple(zip(tiles, ortho, strict=True))),
        products.Tiles(grid, tuple(zip(tiles, planar, strict=True))),
    )


def _ground(posed: products.Posed) -> dict[int, float]:
    """Range by the laser of the images that have one."""
    return {row: float(done.info["range_m"]) for row, done in posed.extracted.items() if done.info.get("range_m")}


def reasons(extracted: dict[int, Done]) -> dict[str, int]:
    """Why images gave no soundings, with counts."""
    return dict(Counter(done.info["reason"] for done in extracted.values() if done.info.get("reason")))
